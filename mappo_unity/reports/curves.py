"""Curves: a metric over decisions or time, and of several runs their mean and spread.

The spread is the standard deviation over runs, of a sample (n - 1). Runs end at different places: at each
place the runs that got there count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from mappo_unity.config.option_table import did_you_mean
from mappo_unity.config.schema import XAxis
from mappo_unity.errors import ConfigError
from mappo_unity.reports.reading import Run

COLUMNS = {XAxis.decisions: "agent_steps", XAxis.time: "wall_s"}
"""The column that an axis stands for: agent decisions, seconds of collecting and learning."""
PLACES = 300  # on the axis, where runs do not share theirs


@dataclass(frozen=True)
class Curve:
    """Mean and spread of a metric at places of an axis, each [places]; NaN spread: fewer than two runs."""

    x: np.ndarray
    mean: np.ndarray
    spread: np.ndarray


def metric_names(runs: Iterable[Run]) -> list[str]:
    """Return the metrics that some run has numbers of, but not the axes."""
    names = dict.fromkeys(name for run in runs for name in run.metrics)
    return [name for name in names if name not in ("iteration", *COLUMNS.values())]


def check_metric(name: str, runs: Sequence[Run]) -> None:
    """Raise ConfigError, with the choices, where no run has numbers of a metric."""
    names = metric_names(runs)
    if name not in names:
        raise ConfigError(
            f"metric={name}: no run has numbers of it{did_you_mean(name, names)}; choices: {', '.join(names)}"
        )


def curve_of(run: Run, metric: str, axis: XAxis) -> tuple[np.ndarray, np.ndarray]:
    """Return the places and values of a run's metric; rows without one are left out."""
    x, y = run.columns.get(COLUMNS[axis]), run.columns.get(metric)
    if x is None or y is None:
        return np.empty(0), np.empty(0)
    there = np.isfinite(x) & np.isfinite(y)
    return x[there], y[there]


def mean_curve(runs: Sequence[Run], metric: str, axis: XAxis) -> Curve:
    """Return the mean of a metric over runs, and its spread.

    Where the runs' places differ values between two of a run's own are taken from the line between these.
    """
    curves = [curve_of(run, metric, axis) for run in runs]
    curves = [(x, y) for x, y in curves if len(x)]
    if not curves:
        return Curve(np.empty(0), np.empty(0), np.empty(0))

    x = _places([x for x, _ in curves])
    values = np.stack([np.interp(x, *curve, left=np.nan, right=np.nan) for curve in curves])
    there = np.isfinite(values)
    count = there.sum(0)
    mean = np.where(there, values, 0).sum(0) / np.maximum(count, 1)
    squares = np.where(there, (values - mean) ** 2, 0).sum(0)

    # between the end of one run and the beginning of another may be none
    spread = np.where(count > 1, np.sqrt(squares / np.maximum(count - 1, 1)), np.nan)
    return Curve(x, np.where(count > 0, mean, np.nan), spread)


def _places(axes: Sequence[np.ndarray]) -> np.ndarray:
    first = axes[0]
    if all(np.array_equal(first, x) for x in axes[1:]):
        return first
    count = min(PLACES, max(len(x) for x in axes))
    return np.linspace(min(x[0] for x in axes), max(x[-1] for x in axes), max(2, count))
