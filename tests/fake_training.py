"""A training that is over at once, in the place of mappo_unity.training.trainer: its return says its options.

Seed 13 fails, seed 15 is ended by SIGTERM; those above 90 wait for a signal, then a second for a checkpoint.
"""

from __future__ import annotations

import math
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

from mappo_unity.config.schema import Config
from mappo_unity.runs.progress import current_job


@dataclass
class Outcome:
    """What train returns."""

    status: str = "finished"
    signal: int | None = None
    agent_steps: int = 1000
    wall_s: float = 2.0
    return_mean: float = 12.5
    best_checkpoint: Path | None = None
    last_checkpoint: Path | None = None
    updates: dict[str, tuple[int, int]] = field(default_factory=dict)


def why_over(cfg: Config, path: Path) -> str | None:
    """Return None: every run goes on."""
    return None


def train(cfg: Config, folder: Path, resume_from: Path | None = None, *show: object) -> Outcome:
    """Return seed - 1000 x learning rate as the mean return."""
    if cfg.seed == 13:
        raise RuntimeError("unlucky")
    if cfg.seed > 90:
        return _wait_for_signal(folder)
    if cfg.seed == 15:
        return Outcome("interrupted", 15, 1, 1.0, math.nan)
    beside = " beside others" * current_job().is_beside_others
    # the end of the line goes with it: jobs share one output, and an unbuffered one writes each part at once
    print(f"{current_job().mark}half way{beside}\n", end="", flush=True)
    return Outcome(agent_steps=cfg.max_steps, wall_s=0.5, return_mean=cfg.seed - 1000 * cfg.ppo.lr)


def _wait_for_signal(folder: Path) -> Outcome:
    came: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *arguments: came.append(arguments[0])) for number in numbers]
    (folder / "metrics.csv").touch()
    deadline = time.monotonic() + 60
    while not came and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(1)
    (folder / "checkpoint").touch()
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
    return Outcome("interrupted", came[0], 1, 1.0, math.nan)
