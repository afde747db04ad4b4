#!/usr/bin/env python3
"""Train Pyramids and Hallway with each learning signal: decisions to the benchmark, return at the end.

Novelty (RND, curiosity), what an expert did (cloning, GAIL), and the environment's own rewards alone. Runs
lie in OUT/SCENE-SIGNAL-SEED and are resumed after any interruption; what was measured is appended to
docs/benchmarks/signals.csv and is not run again. The table stands in docs/rewards.md.

    python scripts/compare_signals.py --demos FOLDER [--scenes Pyramids] [--signals curiosity] [--seeds 0 1 2]
    python scripts/compare_signals.py --draw                  # only the table

FOLDER holds ML-Agents' recordings, ExpertPyramid.demo and ExpertHallway.demo.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

from decisions_to import columns_of, first_at, reached_cells
from learn_scene import append, mappo_eval, read_rows
from run_script import positive, run_script
from score_page import BENCHMARKS, ROOT, put_between
from score_table import train

from mappo_unity.runs.metrics_csv import read_metrics

ROWS = BENCHMARKS / "signals.csv"
PAGE = ROOT / "docs/rewards.md"
BEGIN, END = "<!-- signals -->\n", "<!-- end of signals -->\n"
BENCHMARK = {"Pyramids": 1.75, "Hallway": 0.7}  # ML-Agents' own, mean of 100 episodes


@dataclass(frozen=True)
class Signal:
    """What a scene is learnt from.

    Attributes:
        scene: the preset.
        key: short name, of folders and of the command line.
        label: of the table.
        options: of mappo-train, beside the preset; none: the preset itself.
        demos: the option that takes the scene's recording, where it is imitated. Such a run ends at the
            benchmark: how soon it comes there is what a recording is for.
    """

    scene: str
    key: str
    label: str
    options: tuple[str, ...] = ()
    demos: str | None = None

    def recording(self, folder: Path) -> Path:
        """Return the recording that is imitated."""
        return folder / RECORDING[self.scene]


RECORDING = {"Pyramids": "ExpertPyramid.demo", "Hallway": "ExpertHallway.demo"}

CURIOSITY = "rewards.curiosity.strength=0.1", "rewards.curiosity.steps=1500000", "max_steps=4000000"
CLONING = "bc.strength=0.5", "bc.steps=150000"
GAIL = ("rewards.gail.strength=0.01",)
NO_NOVELTY = "rewards.rnd.strength=0"
SHORT = "max_steps=2500000"  # over which the learning rate falls

SIGNALS = [
    Signal("Pyramids", "rnd", "RND, the preset"),
    Signal("Pyramids", "curiosity", "curiosity", (NO_NOVELTY, *CURIOSITY)),
    Signal("Pyramids", "none", "neither", (NO_NOVELTY,)),
    Signal("Pyramids", "cloning", "cloning beside PPO", (NO_NOVELTY, SHORT, *CLONING), "bc.demos"),
    Signal("Pyramids", "gail", "GAIL beside PPO", (NO_NOVELTY, SHORT, *GAIL), "rewards.gail.demos"),
    Signal("Hallway", "none", "PPO alone, the preset"),
    Signal("Hallway", "cloning", "cloning beside PPO", CLONING, "bc.demos"),
    Signal("Hallway", "gail", "GAIL beside PPO", GAIL, "rewards.gail.demos"),
]


def main() -> None:
    """Train what is missing, then write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    keys = sorted({signal.key for signal in SIGNALS})
    parser.add_argument("--scenes", nargs="+", default=list(BENCHMARK), choices=list(BENCHMARK))
    parser.add_argument("--signals", nargs="+", default=keys, choices=keys)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--demos", type=Path, help="folder of the recordings")
    parser.add_argument("--minutes", type=float, default=120.0, help="of collecting and learning, for a run")
    parser.add_argument("--episodes", type=positive, default=400, help="of the evaluation of a run's best")
    parser.add_argument("--out", type=Path, default=Path("outputs/signals"))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    arguments = parser.parse_args()

    wanted = [] if arguments.draw else SIGNALS
    wanted = [s for s in wanted if s.scene in arguments.scenes and s.key in arguments.signals]
    if any(s.demos for s in wanted) and arguments.demos is None:
        parser.error("--demos FOLDER is needed: cloning and GAIL imitate recordings")
    for path in {s.recording(arguments.demos) for s in wanted if s.demos}:
        if not path.is_file():
            parser.error(f"--demos {arguments.demos}: there is no {path.name} in it")

    for signal in wanted:
        for seed in arguments.seeds:
            measure(arguments, signal, seed)

    write_page()


def measure(arguments: argparse.Namespace, signal: Signal, seed: int) -> None:
    """Train one seed with a signal and append what it came to, unless that has been done."""
    if any(is_of(row, signal) and row["seed"] == str(seed) for row in read_rows(ROWS)):
        return

    folder, load = arguments.out / f"{signal.scene}-{signal.key}-{seed}", os.getloadavg()[0]
    learn(arguments, signal, seed, folder)

    metrics = read_metrics(folder / "metrics.csv")
    said = mappo_eval(f"run={folder}", f"episodes={arguments.episodes}", "deterministic=false")
    row = {
        "date": time.strftime("%Y-%m-%d"),
        "scene": signal.scene,
        "signal": signal.key,
        "seed": seed,
        **columns_of(metrics, first_at(metrics, BENCHMARK[signal.scene])),
        "value": f"{said['mean_return']:.4g}",
        "stderr": f"{said['stderr']:.2g}",
        "episodes": arguments.episodes,
        "options": " ".join(signal.options),
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    append(ROWS, row)
    print(row, flush=True)


def learn(arguments: argparse.Namespace, signal: Signal, seed: int, folder: Path) -> None:
    """Train, or resume, a run; one that imitates is over at the benchmark."""
    options, goal = [*signal.options, "update_threads=1"], BENCHMARK[signal.scene]
    if signal.demos is not None:
        metrics = folder / "metrics.csv"
        if metrics.is_file() and first_at(read_metrics(metrics), goal) is not None:
            return
        recording = signal.recording(arguments.demos).resolve()
        options += [f"{signal.demos}=[{recording}]", f"stop_at_return={goal}"]

    train(signal.scene, seed, folder, arguments.minutes, options)


def is_of(row: dict[str, str], signal: Signal) -> bool:
    """Return whether a row of signals.csv is of a signal."""
    return (row["scene"], row["signal"]) == (signal.scene, signal.key)


def rows_of(signal: Signal) -> list[dict[str, str]]:
    """Return what was measured of a signal, by seed."""
    return sorted((row for row in read_rows(ROWS) if is_of(row, signal)), key=lambda row: int(row["seed"]))


def write_page() -> None:
    """Put a table for each scene between the marks of the page."""
    lines = [line for scene in BENCHMARK for line in ("", *table(scene))][1:]
    PAGE.write_text(put_between(PAGE.read_text(), (BEGIN, END), lines))
    print("\n".join(lines))


def table(scene: str) -> list[str]:
    """Return the lines of a scene's table, a row for each signal that was measured."""
    names = scene, "seeds", f"decisions to {BENCHMARK[scene]:g}", "minutes", "return at the end", "after"
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for signal in SIGNALS:
        if signal.scene == scene and (rows := rows_of(signal)):
            lines.append(f"| {signal.label} | {' | '.join(cells(rows))} |")
    return lines


def cells(rows: list[dict[str, str]]) -> list[str]:
    """Return a signal's cells: seeds, decisions and minutes to the benchmark, return, decisions in all."""
    values = [float(row["value"]) for row in rows]
    mean = f"**{statistics.mean(values):.2f}** ({', '.join(f'{value:.2f}' for value in values)})"
    return [
        ", ".join(row["seed"] for row in rows),
        *map(", ".join, zip(*map(reached_cells, rows))),
        mean if len(values) > 1 else f"{values[0]:.2f}",
        ", ".join(f"{int(row['decisions']) / 1e6:.2f} M" for row in rows),
    ]


if __name__ == "__main__":
    run_script(main)
