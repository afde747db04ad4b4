"""How torch computes in a process of a run: threads, and the precision of products of matrices."""

from __future__ import annotations

import os

import torch

from mappo_unity.config.schema import Config


def compute_as(cfg: Config, threads: int) -> None:
    """Set what holds for all of torch in this process.

    Args:
        cfg: the run's options; `matmul_precision` is the same wherever its policy acts or learns, so that
            the probabilities of actions are the same there.
        threads: at most, where there are as many cores.
    """
    torch.set_num_threads(min(threads, os.cpu_count() or 1))
    torch.set_float32_matmul_precision(cfg.matmul_precision.value)


def cuda_number(device: str) -> int:
    """Return N of cuda:N, 0 of cuda."""
    return int(device.partition(":")[2] or 0)
