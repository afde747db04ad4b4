#!/usr/bin/env python3
"""Print the curves of runs as tables: a column each so many decisions.

Runs are named by their folders. Printed is a table in Markdown for each run: means of metrics, over all
rows of metrics.csv within each window of WINDOW decisions, and the minutes (of collecting and learning) at
its end. A row's return_mean is itself that of the last 100 episodes. What is left of a run beyond its last
whole window is one of its own from half a window on.

    python scripts/curve_table.py WINDOW RUN ... [--metrics return_mean episode_length_mean]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

from decisions_to import Metrics
from run_script import run_script

from mappo_unity.diagnosis.evidence import amount
from mappo_unity.runs.metrics_csv import read_metrics

METRICS = ("return_mean", "episode_length_mean")


def main() -> None:
    """Print a table for each run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("window", type=float, metavar="WINDOW", help="decisions, such as 1e6")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--metrics", nargs="+", default=METRICS, metavar="METRIC", help="columns")
    arguments = parser.parse_args()

    if not (math.isfinite(arguments.window) and arguments.window >= 1):
        parser.error(f"a window of {arguments.window:g} must be 1 decision or more")
    for run in arguments.runs:
        path = run / "metrics.csv"
        metrics = read_metrics(path) if path.is_file() else []
        if not metrics:
            parser.error(f"{run} does not exist, or holds no metrics yet")

        columns = list(dict.fromkeys(name for row in metrics for name in row))  # those of matches begin later
        unknown = [name for name in arguments.metrics if name not in columns]
        if unknown:
            parser.error(f"{path} has no column {', '.join(unknown)}; it has {', '.join(columns)}")

        print("\n".join(table(run.name, metrics, arguments.window, arguments.metrics)))


def windows(metrics: Metrics, size: float) -> list[Metrics]:
    """Return the rows of each window of `size` decisions that has any, in the order of the run."""
    last = metrics[-1]["agent_steps"]
    most = max(1, math.floor(last / size + 0.5))  # the number of the last one
    found: dict[int, Metrics] = {}

    for row in metrics:
        # a row stands for the decisions that end with it: the one at 1 M belongs to the first million
        found.setdefault(min(math.ceil(row["agent_steps"] / size), most), []).append(row)
    return list(found.values())


def mean(rows: Metrics, metric: str) -> float:
    """Return a metric's mean over those rows that have a value; nan: none has."""
    values = [row[metric] for row in rows if not math.isnan(row.get(metric, math.nan))]
    return fmean(values) if values else math.nan


def table(name: str, metrics: Metrics, size: float, columns: Sequence[str]) -> list[str]:
    """Return the lines of a run's table."""
    parts = windows(metrics, size)
    ends = [f"{rows[-1]['agent_steps'] / 1e6:.2f} M" for rows in parts]
    lines = [f"| {name} | {' | '.join(ends)} |", f"|---|{'---|' * len(ends)}"]

    for metric in columns:
        means = [mean(rows, metric) for rows in parts]
        cells = ["-" if math.isnan(value) else amount(value) for value in means]
        lines.append(f"| {metric} | {' | '.join(cells)} |")

    minutes = [f"{rows[-1]['wall_s'] / 60:.0f}" for rows in parts]
    return [*lines, f"| minutes | {' | '.join(minutes)} |"]


if __name__ == "__main__":
    run_script(main)
