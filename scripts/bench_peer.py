#!/usr/bin/env python3
"""Train scenes with recipe=mlagents and with the official mlagents-learn, and draw both curves.

Both trainers play the same player (mappo-player) under the official configuration, whose max_steps is
replaced by --steps, with one thread of torch each. The player itself writes down the returns, so that both
are counted alike: an episode is one agent's, its return the agent's own and its group's reward, and it stands
at the decisions that the player had been asked for when it ended.

    python scripts/bench_peer.py --peer VENV/bin/mlagents-learn --official ml-agents/config \\
        [--scenes 3DBall Basic] [--seeds 0 1 2] [--steps 300000] [--out outputs/peer]
    python scripts/bench_peer.py --draw [--out outputs/peer]      # only the curves of what has been run

A run that is over is kept, and not run again; OUT/results.csv has a row for each. The curves go to
docs/benchmarks/peer.csv, in the place of older ones of the same scenes, and peer.png (the picture needs
matplotlib).
"""

from __future__ import annotations

import argparse
import csv
import os
import shlex
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from learn_scene import append, results
from peer_command import add_peer_options, check_peer_options, their_command
from recorded_player import EPISODES, ROOT, make_player, noted
from run_script import positive, run_script

TRAINERS = "mlagents-learn", "mappo-unity"
COLORS = "tab:orange", "tab:blue"
BINS = 12  # points of a curve
LAST = 0.1  # share of a run whose episodes make its last return


def main() -> None:
    """Run what is missing, then draw everything."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_peer_options(parser)
    parser.add_argument("--scenes", nargs="+", default=["3DBall", "Basic", "DungeonEscape", "Hallway"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--trainers", nargs="+", choices=TRAINERS, default=TRAINERS)
    parser.add_argument("--steps", type=positive, default=300_000, help="agent decisions of a run")
    parser.add_argument("--out", type=Path, default=Path("outputs/peer"))
    parser.add_argument("options", nargs="*", help="further options of mappo-train")
    arguments = parser.parse_intermixed_args()
    check_peer_options(arguments, arguments.scenes)

    if not arguments.draw:
        for scene in arguments.scenes:
            for seed in arguments.seeds:
                for trainer in arguments.trainers:
                    run(arguments, scene, seed, trainer)

    curves = write_curves(arguments.out, ROOT / "docs/benchmarks/peer.csv")
    print(table(arguments.out))
    draw(curves, ROOT / "docs/benchmarks/peer.png")


def run(arguments: argparse.Namespace, scene: str, seed: int, trainer: str) -> None:
    """Train once, unless that has been done, and append the result."""
    folder = arguments.out.resolve() / f"{scene}-{trainer}-{seed}"
    if any(Path(row["folder"]) == folder for row in results(arguments.out)):
        return
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was cut off
    folder.mkdir(parents=True)

    player = make_player(scene, folder)
    if trainer == "mappo-unity":
        command = our_command(scene, seed, arguments.steps, player, folder) + arguments.options
    else:
        command = their_command(arguments, scene, seed, arguments.steps, player, folder)

    print(f"{time.strftime('%H:%M:%S')} {shlex.join(map(str, command))}", flush=True)
    load, start = os.getloadavg()[0], time.monotonic()
    with open(folder / "log", "w") as log:
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
    seconds = time.monotonic() - start
    if done.returncode:
        raise SystemExit(f"exit code {done.returncode}; the end of {folder / 'log'} says why")

    row = {
        "scene": scene,
        "trainer": trainer,
        "seed": seed,
        "limit": arguments.steps,
        "last_return": round(last_return(folder, arguments.steps), 3),
        "seconds": round(seconds),
        "load_before": round(load, 1),
        "load_after": round(os.getloadavg()[0], 1),
        "date": time.strftime("%Y-%m-%d"),
        "folder": folder,
    }
    append(arguments.out / "results.csv", row)
    print(row, flush=True)


def our_command(scene: str, seed: int, steps: int, player: Path, folder: Path) -> list[Any]:
    """Return the command line of mappo-train."""
    recipe = ["recipe=mlagents", f"env={scene}", "env.backend=player", f"env.file_name={player}"]
    run_ = [f"seed={seed}", f"max_steps={steps}", "env.no_graphics=true", f"hydra.run.dir={folder / 'run'}"]
    return [Path(sys.executable).parent / "mappo-train", *recipe, *run_, "matches.interval=null"]


def episodes(folder: Path) -> list[tuple[int, float]]:
    """Return the decisions at which each episode of a run ended, and its return."""
    return [(at, value) for at, value, _ in noted(folder / EPISODES)]


def last_return(folder: Path, limit: int) -> float:
    """Return the mean return of the episodes of a run's last tenth."""
    last = [value for at, value in episodes(folder) if (1 - LAST) * limit < at <= limit]
    return statistics.mean(last) if last else float("nan")


def curve(folder: Path, limit: int) -> list[tuple[int, float]]:
    """Return (decisions, mean return of the episodes that ended since the last such point)."""
    width = limit / BINS
    bins: list[list[float]] = [[] for _ in range(BINS)]
    for at, value in episodes(folder):
        if at < limit:
            bins[int(at / width)].append(value)
    return [(round((i + 1) * width), statistics.mean(values)) for i, values in enumerate(bins) if values]


Curves = dict[tuple[str, str, int], list[tuple[int, float]]]


def write_curves(out: Path, path: Path) -> Curves:
    """Write the curves of all finished runs to a file and return them by scene, trainer and seed.

    Curves of scenes that were not run stay as they stand in the file.
    """
    rows = results(out)
    curves = {run_: points for run_, points in read_curves(path).items() if run_[0] not in scenes_of(rows)}
    for row in rows:
        run_ = row["scene"], row["trainer"], int(row["seed"])
        curves[run_] = curve(Path(row["folder"]), int(row["limit"]))
    with open(path, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["scene", "trainer", "seed", "decisions", "mean_return"])
        for run_, points in curves.items():
            writer.writerows([*run_, at, f"{value:.4g}"] for at, value in points)
    return curves


def scenes_of(rows: list[dict[str, str]]) -> set[str]:
    """Return the scenes of which there are results."""
    return {row["scene"] for row in rows}


def read_curves(path: Path) -> Curves:
    """Return the curves that a file holds."""
    curves: Curves = {}
    if path.exists():
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                points = curves.setdefault((row["scene"], row["trainer"], int(row["seed"])), [])
                points.append((int(row["decisions"]), float(row["mean_return"])))
    return curves


def table(out: Path) -> str:
    """Return a Markdown table: a row for each scene and seed."""
    rows = {(row["scene"], row["seed"], row["trainer"]): row for row in results(out)}
    lines = ["| scene | decisions | seed | last return: " + " | ".join(TRAINERS) + " | s: "]
    lines[0] += " | ".join(TRAINERS) + " | load |"
    lines.append("|---" * 8 + "|")
    for scene, seed in sorted({(scene, seed) for scene, seed, _ in rows}):
        both = [rows.get((scene, seed, trainer)) for trainer in TRAINERS]
        limits = "/".join(dict.fromkeys(f"{int(row['limit']):,}" for row in both if row))
        loads = [float(row[name]) for row in both if row for name in ("load_before", "load_after")]
        cells = [row[name] if row else "-" for name in ("last_return", "seconds") for row in both]
        load = f"{min(loads):.1f} to {max(loads):.1f}"
        lines.append(f"| {scene} | {limits} | {seed} | {' | '.join(cells)} | {load} |")
    return "\n".join(lines)


def draw(curves: Curves, path: Path) -> None:
    """Draw a panel for each scene: every seed thin, the mean of a trainer's seeds thick."""
    try:
        import matplotlib
    except ImportError:
        raise SystemExit("the picture needs matplotlib: pip install matplotlib, then --draw") from None
    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = sorted({scene for scene, _, _ in curves})
    rows = -(-len(scenes) // 2)
    size = 9, 3 * rows
    figure, axes = pyplot.subplots(rows, 2, figsize=size, layout="constrained", squeeze=False)
    for axis, scene in zip(axes.flat, scenes):
        for trainer, color in zip(TRAINERS, COLORS):
            of_seeds = [dict(points) for (s, t, _), points in curves.items() if (s, t) == (scene, trainer)]
            for points in of_seeds:
                axis.plot(
                    list(points), list(points.values()), color=color, marker=".", linewidth=0.7, alpha=0.6
                )
            common = sorted(set.intersection(*map(set, of_seeds))) if of_seeds else []
            mean = [statistics.mean(points[at] for points in of_seeds) for at in common]
            axis.plot(common, mean, color=color, linewidth=2, label=f"{trainer} ({len(of_seeds)} seeds)")
        axis.set(title=scene, xlabel="agent decisions", ylabel="mean return of an episode")
        axis.grid(alpha=0.3)
        axis.legend()
    for axis in axes.flat[len(scenes) :]:
        axis.remove()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    run_script(main)
