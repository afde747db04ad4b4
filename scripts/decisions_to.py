#!/usr/bin/env python3
"""Say after how many decisions runs reached a mean return, or another metric a value, and what they came to.

Runs are named by their folders, or by folders that hold some. Printed is a table in Markdown: each run's
decisions and minutes (of collecting and learning) until the metric, return_mean of the last 100 episodes
unless another column of metrics.csv is named, was VALUE for the first time (a dash: never), its best and its
last value, and the run's decisions. A return counts from the 100th episode on: the first few are luck; of a
run with a curriculum, from the 200th of the last lesson on.

    python scripts/decisions_to.py VALUE RUN ... [--metric COLUMN]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from run_script import run_script

from mappo_unity.config.compose import load_config
from mappo_unity.config.parameters.values import curricula
from mappo_unity.runs.metrics_csv import read_metrics

EPISODES = 100  # of a mean return

Metrics = list[dict[str, int | float]]
"""Rows of metrics.csv."""


def main() -> None:
    """Print a row for each run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("goal", type=float, metavar="VALUE")
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--metric", default="return_mean", help="column of metrics.csv")
    arguments = parser.parse_args()
    for given in arguments.runs:
        if not any(given.rglob("metrics.csv")):
            parser.error(f"{given} does not exist, or holds no run")

    print(f"| run | decisions to {arguments.goal:g} | minutes | best | last | decisions |")
    print("|---|---|---|---|---|---|")
    for given in arguments.runs:
        for path in sorted(given.rglob("metrics.csv")):
            print(row(path.parent, arguments.goal, arguments.metric))


def first_at(metrics: Metrics, goal: float, metric: str = "return_mean") -> dict[str, int | float] | None:
    """Return the first row of a run's metrics at which one is at least `goal`, if there is any."""
    return next((line for line in with_value(metrics, metric) if line[metric] >= goal), None)


def with_value(metrics: Metrics, metric: str) -> Metrics:
    """Return the rows that have a value: of matches few have, and a mean return needs its episodes."""
    needed = EPISODES if metric.endswith("return_mean") else 0
    return [
        line
        for line in metrics
        if line.get("episodes", 0) >= needed and not math.isnan(line.get(metric, math.nan))
    ]


def read_last_lesson(run: Path) -> Metrics:
    """Return the rows of a run's metrics.csv that are of its last lessons; without a curriculum all."""
    return in_last_lesson(read_metrics(run / "metrics.csv"), last_lessons(run))


def last_lessons(run: Path) -> dict[str, int]:
    """Return the numbers of a run's last lessons, by column of its metrics.csv."""
    parameters = load_config(run / "config.yaml").env.parameters
    return {f"lesson/{name}": len(found.lessons) - 1 for name, found in curricula(parameters).items()}


def in_last_lesson(metrics: Metrics, last: Mapping[str, int]) -> Metrics:
    """Return the rows whose mean returns are of the last lessons alone, `last` by column."""
    rows = settled(metrics, last)
    return [row for row in rows if all(row[name] == number for name, number in last.items())]


def settled(metrics: Metrics, lessons: Iterable[str]) -> Metrics:
    """Return the rows but for the first 200 episodes of each later lesson; `lessons`: columns.

    The first episodes to end there began before, or are short by luck (see RecentEpisodes.begin_anew).
    """
    rows: Metrics = []
    lesson, first = None, -math.inf  # of now, and the episodes that had ended when it began
    for row in metrics:
        now = [row[name] for name in lessons]
        if now != lesson:
            lesson, first = now, -math.inf if lesson is None else row["episodes"]
        if row["episodes"] - first >= 2 * EPISODES:
            rows.append(row)
    return rows


def columns_of(metrics: Metrics, reached: dict[str, int | float] | None) -> dict[str, object]:
    """Return what a CSV file says of a run: decisions and minutes until a row was reached, and in all."""
    return {
        "reached": int(reached["agent_steps"]) if reached else "",
        "reached_minutes": f"{reached['wall_s'] / 60:.1f}" if reached else "",
        "decisions": int(metrics[-1]["agent_steps"]),
        "minutes": f"{metrics[-1]['wall_s'] / 60:.1f}",
    }


def reached_cells(row: dict[str, str]) -> tuple[str, str]:
    """Return decisions and minutes until a row was reached, of a file with `columns_of`, for a table."""
    if not row["reached"]:
        return "never", "-"
    minutes = float(row["reached_minutes"])
    return f"{int(row['reached']) / 1e6:.2f} M", f"{minutes:.{0 if minutes > 2 else 1}f}"


def row(run: Path, goal: float, metric: str) -> str:
    """Return a run's row of the table."""
    every = read_metrics(run / "metrics.csv")
    metrics = in_last_lesson(every, last_lessons(run))
    reached = first_at(metrics, goal, metric)
    first = f"{reached['agent_steps']:,.0f} | {reached['wall_s'] / 60:.1f}" if reached else "- | -"
    known = [line[metric] for line in with_value(metrics, metric)]
    best, last = (f"{max(known):.2f}", f"{known[-1]:.2f}") if known else ("-", "-")
    return f"| {run.parent.name}/{run.name} | {first} | {best} | {last} | {every[-1]['agent_steps']:,.0f} |"


if __name__ == "__main__":
    run_script(main)
