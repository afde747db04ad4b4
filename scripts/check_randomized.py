#!/usr/bin/env python3
"""Train 3DBall with randomised balls and without, and play both on balls of the extremes.

python scripts/check_randomized.py [--steps 40000] [--seeds 0 1 2] [--episodes 200]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import tempfile
from pathlib import Path

from learn_scene import HERE, mappo_eval
from run_script import positive, run_script

BALLS = [
    (mass, scale) for mass in (0.5, 1, 10) for scale in (0.75, 1, 3)
]  # the sampler's ends, and Unity's ball


def main() -> None:
    """Train, play and print a line for each ball: the mean return of each seed, without and with."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=positive, default=40_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--episodes", type=positive, default=200)
    arguments = parser.parse_args()

    print(
        f"load average {os.getloadavg()[0]:.2f}; {arguments.steps:,} decisions, {arguments.episodes} episodes"
    )
    with tempfile.TemporaryDirectory() as out:
        for seed in arguments.seeds:
            for parameters in ("none", "3DBall_randomize"):
                train(Path(out) / f"{parameters}-{seed}", parameters, seed, arguments.steps)
        for mass, scale in BALLS:
            cells = [f"mass {mass:4} scale {scale:4}"]
            for parameters in ("none", "3DBall_randomize"):
                runs = [Path(out) / f"{parameters}-{seed}" for seed in arguments.seeds]
                returns = [evaluate(run, mass, scale, arguments.episodes) for run in runs]
                cells.append(f"{parameters}: {', '.join(f'{value:.1f}' for value in returns)}")
            print("  ".join(cells), flush=True)


def train(folder: Path, parameters: str, seed: int, steps: int) -> None:
    """Train a run that ends after so many decisions."""
    options = [f"parameters={parameters}", f"seed={seed}", f"max_steps={steps}", "stop_at_return=null"]
    lines = ["env=3DBall", *options, "log.progress=false", "log.loggers=[]", f"hydra.run.dir={folder}"]
    subprocess.run([HERE / "mappo-train", *lines], check=True, stdout=subprocess.DEVNULL)


def evaluate(run: Path, mass: float, scale: float, episodes: int) -> float:
    """Return the mean return of a run's best policy with one ball, most likely actions."""
    lines = [f"run={run}", "deterministic=true", f"episodes={episodes}"]
    lines += [f"env.params.mass={mass}", f"env.params.scale={scale}"]
    return float(mappo_eval(*lines)["mean_return"])


if __name__ == "__main__":
    run_script(main)
