"""A training that is over at once, in the place of mappo_unity.train: its return says its options.

Seed 13 fails, seed 15 is ended by SIGTERM.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from mappo_unity.config import Config


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


def train(cfg: Config, folder: Path, resume_from: Path | None = None) -> Outcome:
    """Return seed - 1000 x learning rate as the mean return."""
    if cfg.seed == 13:
        raise RuntimeError("unlucky")
    if cfg.seed == 15:
        return Outcome("interrupted", 15, 1, 1.0, math.nan)
    return Outcome(agent_steps=cfg.max_steps, wall_s=0.5, return_mean=cfg.seed - 1000 * cfg.ppo.lr)
