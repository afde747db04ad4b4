#!/usr/bin/env python3
"""Train a scene with its preset from several seeds, and evaluate what each run ends with.

Runs lie in OUT/SCENE-seed; one that was cut off is resumed, one that is over is only evaluated. Each result
is printed and appended to OUT/results.csv: date, scene (of several behaviors the behavior), seed, decisions,
seconds, mean return and its standard error over the episodes evaluated.

    python scripts/learn_scene.py Hallway [--seeds 0 1 2] [--episodes 400] [--out outputs/learn]
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from run_script import positive, run_script

from mappo_unity.config.renamed import rename_lines
from mappo_unity.config.schema import Config
from mappo_unity.config.text_lines import literal_lines
from mappo_unity.errors import ConfigError
from mappo_unity.runs.checkpoint_file import checkpoints_in
from mappo_unity.runs.folder import OVERRIDES
from mappo_unity.runs.metrics_csv import read_metrics

Point = TypeVar("Point")

HERE = Path(sys.executable).parent


def main() -> None:
    """Train and evaluate every seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=positive, default=400)
    parser.add_argument("--out", type=Path, default=Path("outputs/learn"))
    parser.add_argument("options", nargs="*", help="further options of mappo-train")
    arguments = parser.parse_intermixed_args()  # options may stand anywhere

    for seed in arguments.seeds:
        print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores", flush=True)
        folder = arguments.out / f"{arguments.scene}-{seed}"
        train(arguments.scene, seed, folder, arguments.options)
        for row in evaluate(arguments.scene, seed, folder, arguments.episodes):
            print(row, flush=True)
            append(arguments.out / "results.csv", row)


def train(scene: str, seed: int, folder: Path, options: list[str]) -> None:
    """Train a seed, or resume it where a run folder stands already."""
    lines = begin_or_resume(scene, seed, folder, options)
    subprocess.run([HERE / "mappo-train", *lines], check=True)


def begin_or_resume(scene: str, seed: int, folder: Path, options: list[str]) -> list[str]:
    """Return the options with which mappo-train begins a run, or resumes it where it has checkpoints.

    A resumed run keeps its options, and would be noted with these: raises ConfigError if it was begun with
    others.
    """
    asked = [f"env={scene}", f"seed={seed}", f"hydra.run.dir={folder}", *options]
    if not (folder / "checkpoints").is_dir():
        return asked

    begun = begun_with(folder)
    asked = literal_lines(rename_lines(asked), Config)  # as mappo-train notes them
    if begun is not None and set(without_place(begun)) != set(without_place(asked)):
        here, there = (" ".join(without_place(lines)) for lines in (asked, begun))
        raise ConfigError(
            f"{folder} was begun with {there}, which a resumed run keeps, and not with {here}: give the same "
            "options or another --out"
        )
    return [f"resume={folder}"]


def begun_with(folder: Path) -> list[str] | None:
    """Return the options with which a run was begun; None: its record does not say."""
    path = folder / OVERRIDES
    entries = (yaml.safe_load(path.read_text()) if path.is_file() else None) or []
    calls: list[list[str]] = [entry["overrides"] for entry in entries]
    begins = [lines for lines in calls if not any(line.startswith("resume=") for line in lines)]
    return begins[-1] if begins else None


def without_place(lines: list[str]) -> list[str]:
    """Return options without those that say where a run lies."""
    return [line for line in lines if not line.startswith("hydra.")]


def evaluate(scene: str, seed: int, folder: Path, episodes: int) -> list[dict[str, object]]:
    """Evaluate the newest checkpoint, as it explores; return a row of results for each behavior."""
    newest = checkpoints_in(folder)[-1]
    result = mappo_eval(f"run={newest}", f"episodes={episodes}")
    behaviors = result.get("behaviors") or {scene: result}

    seconds = read_metrics(folder / "metrics.csv")[-1]["wall_s"]
    return [
        {
            "date": time.strftime("%Y-%m-%d"),
            "scene": name.split("?")[0],
            "seed": seed,
            "decisions": result["agent_steps"],
            "seconds": round(seconds),
            "mean_return": round(figures["mean_return"], 3),
            "stderr": round(figures["stderr"], 3),
            "episodes": figures["episodes"],
        }
        for name, figures in behaviors.items()
    ]


def mappo_eval(*options: str, timeout_s: float | None = None) -> dict[str, Any]:
    """Return what mappo-eval says, with these options; raise TimeoutExpired if it takes longer."""
    done = subprocess.run(
        [HERE / "mappo-eval", *options], check=True, capture_output=True, text=True, timeout=timeout_s
    )
    said: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return said


def results(out: Path) -> list[dict[str, str]]:
    """Return the rows of OUT/results.csv."""
    return read_rows(out / "results.csv")


def read_rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file; none if it is not there."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def thin(
    points: Sequence[Point], most: int, is_reached: Callable[[Point], bool] | None = None
) -> list[Point]:
    """Return some of a curve's points, evenly, about as many as `most`, and the last one.

    `is_reached`: whether a point is at the target; the first one that is stays, too, since a page says when
    that was.
    """
    step = max(1, math.ceil(len(points) / most))
    places = {*range(0, len(points), step), *range(len(points))[-1:]}
    if is_reached is not None:
        places |= set([place for place, point in enumerate(points) if is_reached(point)][:1])
    return [points[place] for place in sorted(places)]


def append(path: Path, *rows: dict[str, Any]) -> None:
    """Append rows to a CSV file, which gets a head if it is new.

    All at once: a curve of which a part stands there is not written again.
    """
    if not rows:
        return

    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    if not path.exists():
        writer.writeheader()
    writer.writerows(rows)
    with open(path, "ab", buffering=0) as file:
        file.write(text.getvalue().encode())


if __name__ == "__main__":
    run_script(main)
