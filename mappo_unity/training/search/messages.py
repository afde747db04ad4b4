"""What the driver of a search and its workers send each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mappo_unity.config.schema import SearchObjective

MARKS = 20
"""Into how many parts of `max_steps` a run is cut; at the end of each its mean return is compared."""

GO, PRUNE, STOP = "go", "pruned", "stopped"
"""The driver's answers to a report; all but the first end the run, and are its status."""


@dataclass(frozen=True)
class Run:
    """A run of a trial: its folder and its options."""

    folder: Path
    lines: list[str]


@dataclass(frozen=True)
class Task:
    """A trial for a worker: its runs, one for each seed; `file` holds options below theirs."""

    number: int
    runs: list[Run]
    objective: SearchObjective
    file: Path | None = None


@dataclass
class TrialResult:
    """What became of a trial.

    Attributes: `status`, complete, pruned, failed or stopped; `values`, the objective of each run;
    `return_mean`, over its runs; `agent_steps` and `wall_s`, decisions and seconds of its runs together.
    """

    status: str
    values: list[float] = field(default_factory=list)
    return_mean: float | None = None
    agent_steps: int = 0
    wall_s: float = 0.0
    error: str | None = None

    @property
    def value(self) -> float:
        """The mean over the trial's runs."""
        return sum(self.values) / len(self.values)
