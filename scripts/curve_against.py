#!/usr/bin/env python3
"""Play every checkpoint of runs against one opponent, and write the curve of the share of matches won.

Each result is printed and appended to OUT (date, run, decisions, minutes of training, matches, won, drawn,
lost, share of decided matches won and its 95 % interval); what stands there already is not played again.

    python scripts/curve_against.py OPPONENT.onnx RUN ... [--matches 100] [--every 1000000] [--out curve.csv]
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path

import torch
from learn_scene import append
from run_script import positive, run_script

from mappo_unity.envs.backends import make_env_function
from mappo_unity.policies.evaluate import open_policy
from mappo_unity.policies.matches import Score, play_matches
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.runs.checkpoint_file import checkpoints_in, step_of
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.runs.options import config_to_play


def main() -> None:
    """Play what is not in the file yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("opponent")
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--matches", type=positive, default=100)
    parser.add_argument("--every", type=int, default=1_000_000, help="decisions between two points")
    parser.add_argument("--out", type=Path, default=Path("curve.csv"))
    arguments = parser.parse_args()
    for run in arguments.runs:
        if not checkpoints_in(run):
            parser.error(f"{run} does not exist, or has no checkpoints")

    for run in arguments.runs:
        due = 0
        for path in checkpoints_in(run):
            if step_of(path) >= due:
                point(arguments, run, path)
                due = step_of(path) + int(0.9 * arguments.every)


def point(arguments: argparse.Namespace, run: Path, path: Path) -> None:
    """Play one checkpoint, unless it stands in the file."""
    steps, out = step_of(path), arguments.out
    if out.exists():
        with open(out) as file:
            if any(row["run"] == run.name and int(row["decisions"]) == steps for row in csv.DictReader(file)):
                return

    make_env = make_env_function(config_to_play(run, None).env)
    seed = steps % 2**31
    torch.manual_seed(seed)  # a checkpoint's policy draws from it
    policy = CheckpointPolicy(path, deterministic=False)
    opponent = open_policy(arguments.opponent, deterministic=False, seed=seed)
    scores = play_matches(make_env, policy, opponent, arguments.matches, seed=seed)
    total = sum(scores.values(), Score())

    figures = total.figures()
    row = {"date": time.strftime("%Y-%m-%d"), "run": run.name, "decisions": steps}
    row |= {"minutes": round(minutes_until(run, steps), 1), "matches": total.matches, "won": total.wins}
    row |= {"drawn": total.draws, "lost": total.losses}
    names = ("won_of_decided", "won_of_decided_low95", "won_of_decided_high95")
    row |= {name: round(figures[name], 3) for name in names}
    print(row, flush=True)

    append(out, row)


def minutes_until(run: Path, steps: int) -> float:
    """Return how long a run collected and learnt until it had made so many decisions."""
    rows = [row for row in read_metrics(run / "metrics.csv") if row["agent_steps"] <= steps]
    return float(rows[-1]["wall_s"]) / 60 if rows else 0.0


if __name__ == "__main__":
    run_script(main)
