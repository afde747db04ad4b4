"""How torch computes in a process of a run: threads, and the precision of products of matrices."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import nn

from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError


def compute_as(cfg: Config, threads: int) -> None:
    """Set what holds for all of torch in this process.

    Args:
        cfg: the run's options; `matmul_precision` is the same wherever its policy acts or learns, so that
            the probabilities of actions are the same there.
        threads: at most, where there are as many cores.
    """
    torch.set_num_threads(min(threads, os.cpu_count() or 1))
    torch.set_float32_matmul_precision(cfg.matmul_precision.value)


@contextmanager
def exact_products() -> Iterator[None]:
    """Let torch multiply in float32, as other programs do, whatever a run's `matmul_precision` is."""
    precision, rnn = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(precision)
        torch.backends.cudnn.allow_tf32 = rnn


def cuda_number(device: str) -> int:
    """Return N of cuda:N, 0 of cuda."""
    return int(device.partition(":")[2] or 0)


def compiled(method: Callable, is_wanted: bool) -> Callable:
    """Return a network's method, compiled when it is called first (`ppo.compile`), or as it is.

    The method of a network, not the network: parameters and their names stay as they are.
    """
    # minibatches differ by a row or two: without dynamic shapes each size would be compiled
    return torch.compile(method, dynamic=True) if is_wanted else method


def check_compiles(name: str, actor: nn.Module, device: str) -> None:
    """Raise ConfigError where `ppo.compile` cannot compile a policy's networks for its update."""
    if getattr(actor, "is_recurrent", False):
        raise ConfigError(
            f"ppo.compile=true does not go with the memory of {name!r}, which is unrolled step by step; "
            f"leave it out, or behaviors.{name}.ppo.compile=false"
        )

    compiler = os.environ.get("CXX", "c++")
    if device == "cpu" and shutil.which(compiler) is None:
        raise ConfigError(
            f"ppo.compile=true needs a C++ compiler on the CPU, and there is no {compiler}: install one "
            "(Debian: g++), name it by the environment variable CXX, or leave ppo.compile out"
        )
