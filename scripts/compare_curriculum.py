#!/usr/bin/env python3
"""Train WallJump with ML-Agents' curriculum and without: decisions and minutes to both benchmarks.

Runs lie in OUT/NAME-SEED and are resumed after any interruption; what was measured is appended to
docs/benchmarks/curriculum.csv and is not run again. A run ends with its max_steps or when its minutes are
spent, then its best checkpoint is evaluated. The table stands in docs/scenes/WallJump.md.

    python scripts/compare_curriculum.py [--ways with without] [--seeds 0 1 2] [--minutes 120]
    python scripts/compare_curriculum.py --draw               # only the table
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

from decisions_to import Metrics, columns_of, in_last_lesson, reached_cells, with_value
from learn_scene import append, mappo_eval, read_rows
from run_script import positive, run_script
from score_measures import behavior_return
from score_page import BENCHMARKS, ROOT, put_between
from score_table import train

from mappo_unity.runs.metrics_csv import read_metrics

SCENE = "WallJump"
ROWS = BENCHMARKS / "curriculum.csv"
PAGE = ROOT / "docs/scenes/WallJump.md"
BEGIN, END = "<!-- curriculum -->\n", "<!-- end of curriculum -->\n"

BENCHMARK = 0.8  # ML-Agents' own, of both behaviors, mean of 100 episodes
BEHAVIORS = "SmallWallJump", "BigWallJump"
FULL_HEIGHT = "env.params.small_wall_height=4", "env.params.big_wall_height=8"  # Unity's own
LAST_LESSON = 3  # counted from 0: the walls have their full height


@dataclass(frozen=True)
class Way:
    """A way to train the scene.

    Attributes:
        key: short name, of folders and of the command line.
        label: of the table.
        options: of mappo-train, beside the preset.
    """

    key: str
    label: str
    options: tuple[str, ...] = ()


IN_TURNS = "collect.workers=0", "collect.overlap=false", "ppo.objective=clip"  # a curriculum needs it
WAYS = [
    Way("without", "without, the preset", IN_TURNS),
    Way("with", "with it, over 8 M", (*IN_TURNS, "parameters=WallJump_curriculum", "max_steps=8000000")),
]


def main() -> None:
    """Train what is missing, then write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    keys = [way.key for way in WAYS]
    parser.add_argument("--ways", nargs="+", default=keys, choices=keys)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--minutes", type=float, default=120.0, help="of collecting and learning, for a run")
    parser.add_argument("--episodes", type=positive, default=2000, help="of the evaluation of a run's best")
    parser.add_argument("--out", type=Path, default=Path("outputs/curriculum"))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    arguments = parser.parse_args()

    for way in [] if arguments.draw else [way for way in WAYS if way.key in arguments.ways]:
        for seed in arguments.seeds:
            measure(arguments, way, seed)

    write_page()


def measure(arguments: argparse.Namespace, way: Way, seed: int) -> None:
    """Train one seed and append what it came to, unless that has been done."""
    if any(row["seed"] == str(seed) for row in rows_of(way)):
        return

    folder, load = arguments.out / f"{SCENE}-{way.key}-{seed}", os.getloadavg()[0]
    train(SCENE, seed, folder, arguments.minutes, [*way.options, "update_threads=1"])

    metrics = read_metrics(folder / "metrics.csv")
    said = mappo_eval(f"run={folder}", f"episodes={arguments.episodes}", "deterministic=false", *FULL_HEIGHT)
    small, big = (behavior_return(behavior)(said) for behavior in BEHAVIORS)
    row = {
        "date": time.strftime("%Y-%m-%d"),
        "way": way.key,
        "seed": seed,
        **columns_of(metrics, first_at_both(metrics, BENCHMARK)),
        "small": f"{small[0]:.4g}",
        "small_stderr": f"{small[1]:.2g}",
        "big": f"{big[0]:.4g}",
        "big_stderr": f"{big[1]:.2g}",
        "episodes": arguments.episodes,
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    append(ROWS, row)
    print(row, flush=True)


def first_at_both(metrics: Metrics, goal: float) -> dict[str, int | float] | None:
    """Return the first row at which both behaviors stand at `goal`, walls at full height, if there is any.

    A return counts from the 100th episode on, as in decisions_to.
    """
    lessons = [name for name in metrics[0] if name.startswith("lesson/")]  # none without a curriculum
    full_height = in_last_lesson(metrics, dict.fromkeys(lessons, LAST_LESSON))
    return next((row for row in with_value(full_height, "return_mean") if stands_at(row, goal)), None)


def stands_at(row: dict[str, int | float], goal: float) -> bool:
    """Return whether both behaviors' mean returns are at least `goal`."""
    returns = [row.get(f"{behavior}?team=0/return_mean", math.nan) for behavior in BEHAVIORS]
    return all(value >= goal for value in returns)


def rows_of(way: Way) -> list[dict[str, str]]:
    """Return what was measured of a way, by seed."""
    return sorted((row for row in read_rows(ROWS) if row["way"] == way.key), key=lambda row: int(row["seed"]))


def write_page() -> None:
    """Put the table between the marks of the page."""
    names = "", "seed", f"decisions to {BENCHMARK:g}", "minutes", "at the end: small, big", "after"
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for way in WAYS:
        for place, row in enumerate(rows_of(way)):
            lines.append(f"| {' | '.join([way.label if place == 0 else '', *cells(row)])} |")

    PAGE.write_text(put_between(PAGE.read_text(), (BEGIN, END), lines))
    print("\n".join(lines))


def cells(row: dict[str, str]) -> list[str]:
    """Return a run's cells: seed, decisions and minutes to the benchmarks, returns, decisions in all."""
    return [
        row["seed"],
        *reached_cells(row),
        f"{float(row['small']):.3f}, {float(row['big']):.3f}",
        f"{int(row['decisions']) / 1e6:.2f} M",
    ]


if __name__ == "__main__":
    run_script(main)
