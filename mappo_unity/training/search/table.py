"""The trials of a search as rows, best first: for the table, trials.csv and the best one's command line."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mappo_unity.config.overrides import shell_word
from mappo_unity.config.schema import SearchObjective
from mappo_unity.training.search.checks import SearchPlan
from mappo_unity.training.search.space import to_line

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial

TRIALS = "trials.csv"
_FIGURES = ("value", "return_mean", "agent_steps", "wall_s", "error")
_STATUSES = {"COMPLETE": "complete", "PRUNED": "pruned", "FAIL": "failed", "RUNNING": "unfinished"}
_ORDER = (*_STATUSES.values(),)


@dataclass(frozen=True)
class Row:
    """A trial: its options as lines, its status, and figures that are None where there are none.

    `value` is the objective, the mean over its runs; `agent_steps` and `wall_s` those of its runs together.
    """

    number: int
    lines: tuple[str, ...]
    status: str
    value: float | None
    return_mean: float | None
    agent_steps: int | None
    wall_s: float | None
    error: str | None


def rows_of(trials: Iterable[FrozenTrial], plan: SearchPlan) -> list[Row]:
    """Return the trials, best first: complete ones by their value, then those pruned, failed, unfinished."""
    sign = -1.0 if plan.objective is SearchObjective.final_return else 1.0
    rows = [_row(trial) for trial in trials]

    def key(row: Row) -> tuple[int, float, int]:
        return _ORDER.index(row.status), 0.0 if row.value is None else sign * row.value, row.number

    return sorted(rows, key=key)


def write_csv(rows: list[Row], plan: SearchPlan) -> Path:
    """Write the trials to trials.csv in the search's folder; return the path."""
    path = plan.folder / TRIALS
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["trial", *plan.space, "status", *_FIGURES])
        for row in rows:
            options = dict(line.split("=", 1) for line in row.lines)
            values = [options.get(key, "") for key in plan.space]
            figures = ["" if getattr(row, name) is None else getattr(row, name) for name in _FIGURES]
            writer.writerow([row.number, *values, row.status, *figures])
    return path


def best_command(rows: list[Row], plan: SearchPlan) -> str | None:
    """Return mappo-train's command line with the options of the best trial; None where none is complete."""
    if not rows or rows[0].status != "complete":
        return None

    goal = [f"stop_at_return={plan.options.goal:.15g}"] if plan.options.goal is not None else []
    config = [] if plan.file is None else ["--config", str(plan.file)]
    lines = [line for line in plan.lines if line not in goal]
    return " ".join(["mappo-train", *map(shell_word, [*config, *lines, *rows[0].lines])])


def _row(trial: FrozenTrial) -> Row:
    attrs = trial.user_attrs
    status = _STATUSES[trial.state.name]
    return Row(
        trial.number,
        tuple(to_line(key, value) for key, value in trial.params.items()),
        status,
        trial.value if status == "complete" else None,  # Optuna gives a pruned one its last report
        attrs.get("return_mean"),
        attrs.get("agent_steps"),
        attrs.get("wall_s"),
        attrs.get("error"),
    )
