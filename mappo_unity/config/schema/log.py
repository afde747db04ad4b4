"""Options of metrics and progress: `log.*`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Optional

from mappo_unity.config.schema.checks import at_least, within


class TagKind(Enum):
    """How curves are named on TensorBoard."""

    own = "own"
    mlagents = "mlagents"


class LoggerKind(Enum):
    """Where metrics go besides ``metrics.csv``."""

    csv = "csv"
    tensorboard = "tensorboard"
    wandb = "wandb"
    mlflow = "mlflow"


@dataclass
class LogConfig:
    """Metrics and progress."""

    loggers: list[LoggerKind] = field(default_factory=lambda: [LoggerKind.tensorboard])
    """Any of tensorboard, wandb, mlflow, csv (a file for each metric); metrics.csv is always written."""
    project: str = "mappo-unity"
    """Project (wandb) or experiment (mlflow) that the run is filed under."""
    return_window: int = 100
    """Finished episodes over which return_mean and its like are taken."""
    tags: TagKind = TagKind.own
    """Names of TensorBoard's curves: those of metrics.csv, by the run's agent decisions (own), or ML-Agents',
    in a folder for each behavior and by its own decisions (mlagents)."""
    summary_freq: int = 50_000
    """With tags=mlagents: decisions of a behavior between two points of its curves."""
    progress: bool = True
    """Show a live progress line on a terminal, and plain lines elsewhere."""
    dashboard: bool = False
    """Serve a page that follows the run to browsers on this machine; the address is printed at the start."""
    dashboard_port: Optional[int] = None
    """Port of the page; null: one that is free."""

    def __post_init__(self) -> None:
        at_least("log.return_window", self.return_window, 1)
        at_least("log.summary_freq", self.summary_freq, 1)
        if self.dashboard_port is not None:
            within("log.dashboard_port", self.dashboard_port, 1, 65535)
