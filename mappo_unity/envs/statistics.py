"""Statistics that an environment reports of itself, as columns of a run's metrics."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from mappo_unity.scenes.contract.statistics import HISTOGRAM, MOST_RECENT, SUM, Statistics

TAKEN = "environment/"
"""Before a statistic whose name is that of a metric of the trainer."""


def with_statistics(
    row: Mapping[str, float], statistics: Statistics
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Return a row of metrics with the environment's statistics behind it, and the values of histograms.

    As in ML-Agents (trainers/stats.py): values are averaged or added up, the most recent one counts, or all
    of them make a histogram, whose column is their mean. Which of these, the last value of a name says.

    Args:
        row: the trainer's own metrics, which keep their names.
        statistics: values by name, oldest first.
    """
    out, histograms = dict(row), {}
    for reported, values in statistics.items():
        if not values:
            continue

        name = _plain_name(reported)
        if name in row:
            name = TAKEN + name
        numbers, method = np.array([value for value, _ in values], float), values[-1][1]
        out[name] = _summed_up(numbers, method)

        finite = numbers[np.isfinite(numbers)]
        if method == HISTOGRAM and len(finite):
            histograms[name] = finite
    return out, histograms


def _summed_up(values: np.ndarray, method: str) -> float:
    if method == SUM:
        return float(values.sum())
    if method == MOST_RECENT:
        return float(values[-1])
    return float(values.mean())


def _plain_name(name: str) -> str:
    """Return a name that may stand in a table and in a path: loggers make file names of it."""
    parts: Sequence[str] = re.split(r"[/\\]+", "".join(c if c.isprintable() else "_" for c in name))
    return "/".join(part for part in parts if part.strip(". ")) or "_"
