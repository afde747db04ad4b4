"""Options of mappo-search."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Optional

from mappo_unity.config.schema.checks import at_least, not_empty, rule
from mappo_unity.errors import ConfigError


class SearchObjective(Enum):
    """What a search wants: a high return, or a goal with few decisions or in little time."""

    final_return = "final_return"
    decisions = "decisions"
    time = "time"


class Pruner(Enum):
    """Which trials of a search end early: those below the median, by successive halving, or none."""

    median = "median"
    hyperband = "hyperband"
    none = "none"


@dataclass
class SearchConfig:
    """Options of a search."""

    search: str = "???"
    """What is searched: a space in conf/search, or a YAML file of your own; must be given."""
    trials: int = 20
    """Trials in all, with those of earlier calls in the same folder."""
    workers: Optional[int] = None
    """Processes that run trials side by side, one each; null: one for each core."""
    out: Optional[str] = None
    """Folder of the search, new or that of the same search, which goes on; null: outputs/search."""
    seeds: int = 1
    """Runs of each trial, with seed, seed+1 ...; its value is their mean."""
    objective: Optional[SearchObjective] = None
    """The final mean return, or agent decisions or seconds to the goal; null: decisions, with goal."""
    goal: Optional[float] = None
    """Mean return that ends a run, for the objectives decisions and time; sets stop_at_return."""
    pruner: Pruner = Pruner.median
    """Which trials end early, by the returns of their first run (Optuna's MedianPruner, HyperbandPruner)."""

    def __post_init__(self) -> None:
        not_empty(search=self.search, out=self.out)
        for option, value in (("trials", self.trials), ("workers", self.workers), ("seeds", self.seeds)):
            at_least(option, value, 1)
        rule("goal", self.goal, True, "must be finite")

        needs_goal = self.objective not in (None, SearchObjective.final_return)
        if self.objective is not None and needs_goal and self.goal is None:
            raise ConfigError(f"objective={self.objective.name} needs the return that is the goal: goal=95")
        if self.objective is SearchObjective.final_return and self.goal is not None:
            raise ConfigError(
                f"goal={self.goal:g} goes with objective=decisions or objective=time; for the best final "
                "return leave it out"
            )
