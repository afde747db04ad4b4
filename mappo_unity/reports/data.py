"""What the page's script draws: runs with their metrics, groups with mean and spread, as JSON.

Numbers have seven significant digits, as float32 has; what is no number is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from mappo_unity.config.schema import XAxis
from mappo_unity.reports.curves import COLUMNS, PLACES, Curve, mean_curve, metric_names
from mappo_unity.reports.groups import Group, run_names
from mappo_unity.reports.reading import Run

ALL_ROWS = 60_000
"""Rows of all runs together that a page holds; of longer runs every second row, third row, ..."""
_FEWEST = 100  # rows of a run, however many there are
_MATCHES = ("Self-play/", "rating", "win_rate", "draw_rate", "points_vs", "pool_size", "match_decisions")
_COUNTS = (
    *("steps_per_s", "collect_s", "update_s", "episodes", "episodes_new"),
    *("restarts", "dropped_episodes", "dropped_steps"),
)
_STREAMS = ("extrinsic_", "curiosity_", "rnd_", "gail_", "bc_")
_EPISODES = ("return_mean", "group_return_mean", "episode_length_mean", "return_std")
_LEARNING = (
    *("explained_variance", "value_mean", "policy_loss", "value_loss", "entropy", "kl", "clip_fraction"),
    *("grad_norm", "rolled_back", "kl_last", "kl_stopped", "rollbacks", "lr", "clip_epsilon", "entropy_coef"),
)


_FIRST = ("Episodes", "Lessons", "Matches and self-play", "Reward streams", "Learning", "Speed and counts")
_CONSTANT = "Constant"
_SHOWN_FLAT = ("return_mean", "episode_length_mean")
"""Metrics that tell something where they do not move, too."""


def page_data(runs: Sequence[Run], groups: Sequence[Group]) -> dict[str, Any]:
    """Return the data of a page.

    ``charts`` has pairs of a heading and its metrics; ``runs`` name, group and columns; ``groups`` label and,
    where there are several runs, by metric and axis x, mean and spread.
    """
    metrics = metric_names(runs)
    names = run_names(runs)
    every = stride(runs)
    group_of = {id(run): number for number, group in enumerate(groups) for run in group.runs}

    return {
        "charts": chart_headings(metrics, _constant(runs, metrics)),
        "axes": {axis.name: column for axis, column in COLUMNS.items()},
        "runs": [
            {"name": name, "group": group_of[id(run)], "columns": _columns(run, metrics, every)}
            for run, name in zip(runs, names)
        ],
        "groups": [
            {"label": group.label, "curves": _curves(group, metrics, every) if len(group.runs) > 1 else {}}
            for group in groups
        ],
    }


def stride(runs: Sequence[Run]) -> int:
    """Return which rows of the runs a page holds: every row (1), every second one (2), ..."""
    most = max(_FEWEST, ALL_ROWS // len(runs))
    return math.ceil(max(len(run.columns["agent_steps"]) for run in runs) / most)


def chart_headings(metrics: Sequence[str], constant: Collection[str] = ()) -> list[tuple[str, list[str]]]:
    """Return the metrics under headings, constant ones last; the ends of an interval go with its middle."""
    headings: dict[str, list[str]] = {}
    for name in metrics:
        if not name.endswith(("_low", "_high")) or name.rpartition("_")[0] not in metrics:
            headings.setdefault(_CONSTANT if name in constant else _heading(name), []).append(name)

    known = [name for name in _FIRST if name in headings]
    others = [name for name in headings if name not in (*_FIRST, _CONSTANT)]
    if _FIRST[0] in headings:
        # a game's own statistics ("Episodes/...") may stand here, too: behind ours
        ranks = {name: rank for rank, name in enumerate(_EPISODES)}
        headings[_FIRST[0]].sort(key=lambda name: ranks.get(name, len(ranks)))

    last = [_CONSTANT] if _CONSTANT in headings else []
    return [(name, headings[name]) for name in [*known, *others, *last]]


def as_json(data: Any) -> str:
    """Return data as JSON that may stand in a page: no text of the user's ends the element around it."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _constant(runs: Sequence[Run], metrics: Sequence[str]) -> set[str]:
    """Return the metrics that are one number in all rows; none while there is a single row."""
    if max(len(run.columns["agent_steps"]) for run in runs) < 2:
        return set()
    columns = {name: np.concatenate([run.columns.get(name, np.empty(0)) for run in runs]) for name in metrics}
    spans = {name: np.ptp(column[np.isfinite(column)]) for name, column in columns.items()}
    return {name for name in metrics if spans[name] == 0 and name not in _SHOWN_FLAT}


def _heading(name: str) -> str:
    if name in _EPISODES:
        return "Episodes"
    if name.startswith("lesson/"):
        return "Lessons"
    if name.startswith(_MATCHES):
        return "Matches and self-play"
    if name in _COUNTS:
        return "Speed and counts"
    if name in _LEARNING:
        return "Learning"
    if name.startswith(_STREAMS):
        return "Reward streams"
    return name.rpartition("/")[0] or "Environment"


def _columns(run: Run, metrics: Sequence[str], every: int) -> dict[str, list[float | None]]:
    kept = [*COLUMNS.values(), *metrics]
    return {name: _numbers(run.columns[name], every) for name in kept if name in run.columns}


def _numbers(column: np.ndarray, every: int) -> list[float | None]:
    places = np.arange(len(column))
    # the last row always: it says where the run is
    kept = column[(places % every == 0) | (places == len(column) - 1)]
    return [_number(value) for value in kept.tolist()]


def _number(value: float) -> float | None:
    if not math.isfinite(value):
        return None
    return int(value) if value.is_integer() and abs(value) < 2**53 else float(f"{value:.7g}")


def _curves(
    group: Group, metrics: Sequence[str], every: int
) -> dict[str, dict[str, dict[str, list[float | None]]]]:
    def parts(curve: Curve) -> dict[str, list[float | None]]:
        # where the runs share no places there are few, chosen for the whole axis
        step = every if len(curve.x) > PLACES else 1
        return {part: _numbers(getattr(curve, part), step) for part in ("x", "mean", "spread")}

    return {
        metric: {axis.name: parts(mean_curve(group.runs, metric, axis)) for axis in XAxis}
        for metric in metrics
    }
