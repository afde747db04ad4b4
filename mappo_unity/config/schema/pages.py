"""Options of the commands that show runs: mappo-plot and mappo-report."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Optional

from mappo_unity.config.schema.checks import not_empty
from mappo_unity.errors import ConfigError


class XAxis(Enum):
    """What curves are drawn over."""

    decisions = "decisions"
    time = "time"


@dataclass
class PlotConfig:
    """Options of a picture of curves."""

    runs: list[str] = field(default_factory=list)
    """What is drawn: run folders, sweep folders, folders of runs; words before options."""
    metric: str = "return_mean"
    """Column of metrics.csv; several with commas between them are drawn below one another."""
    x: XAxis = XAxis.decisions
    """The axis: agent decisions, or seconds of collecting and learning."""
    out: str = "curves.png"
    """Picture to write, NAME.png or NAME.svg."""

    def __post_init__(self) -> None:
        _check_shown(self.runs, "mappo-plot")
        not_empty(metric=self.metric, out=self.out)


@dataclass
class ReportConfig:
    """Options of a page about runs."""

    runs: list[str] = field(default_factory=list)
    """What the page is about: run folders, sweep folders, folders of runs; words before options."""
    out: Optional[str] = None
    """Page to write; null: report.html in the folder."""

    def __post_init__(self) -> None:
        _check_shown(self.runs, "mappo-report")
        not_empty(out=self.out)


def _check_shown(runs: list[str], command: str) -> None:
    if not runs:
        raise ConfigError(f"no run is named: name run folders before the options, {command} RUN")
    if "" in runs:
        raise ConfigError("a run is empty: give run folders, or folders of runs")
