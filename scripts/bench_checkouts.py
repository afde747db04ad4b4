#!/usr/bin/env python3
"""Compare the speed of a scene's code with that of another checkout, in short turns.

    scripts/bench_checkouts.py FOLDER [--scene CooperativePushBlock] [--num-areas 4] [--turns 150] [--forward]

On a machine whose speed changes from second to second, figures of two runs say little. Here a process of each
checkout steps its scene for 0.06 s of processor time in turn, as `bench_scenes.py` does (random actions,
observations included), and what counts is the median of the ratios of two turns that follow each other.

With `--forward` the agents of a scene of blocks go forward in three of four decisions, so that they push as
trained ones do: far more bodies touch then than in random play.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from pathlib import Path

from run_script import check_names, positive, run_script

from mappo_unity.scenes.registry import BUILT_IN

TURN_S = 0.06
FORWARD_SHARE = 0.75
STEPPER = """
import sys
sys.path.insert(0, "scripts")
import numpy as np
from mlagents_envs.base_env import ActionTuple
from bench_scenes import decisions_per_s, make_scene, random_policy

random, rng = random_policy(), np.random.default_rng(0)

def forward(spec, decisions):
    action = random(spec, decisions)
    ahead = rng.random((len(decisions), 1)) < {forward_share}
    return ActionTuple(action.continuous, np.where(ahead, 1, action.discrete))

env, policy = make_scene({scene!r}, num_areas={num_areas}), {play}
env.reset()
for _ in range({warm_up}):  # leave the start
    decisions_per_s(env, policy, 0.01)
for _ in sys.stdin:
    print(decisions_per_s(env, policy, {turn}), flush=True)
"""
WARM_UP = 20  # times at least 16 steps


def stepper(checkout: Path, scene: str, num_areas: int, play: str) -> subprocess.Popen[str]:
    """Start a process that answers each line with the decisions a second of its checkout."""
    program = STEPPER.format(
        scene=scene, num_areas=num_areas, play=play, forward_share=FORWARD_SHARE, warm_up=WARM_UP, turn=TURN_S
    )
    return subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=checkout,
        env=os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def rate(process: subprocess.Popen[str]) -> float:
    """Return the decisions a second of one turn."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def main() -> None:
    """Print both medians and the ratio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", type=Path, metavar="FOLDER", help="the other checkout, such as a git worktree"
    )
    parser.add_argument("--scene", default="CooperativePushBlock")
    parser.add_argument("--num-areas", type=positive, default=4)
    parser.add_argument("--turns", type=positive, default=150)
    parser.add_argument("--forward", action="store_true", help="push, in a scene of blocks")
    options = parser.parse_args()
    if not (options.folder / "scripts" / "bench_scenes.py").is_file():
        parser.error(f"FOLDER={options.folder} must be a checkout: it has no scripts/bench_scenes.py")
    check_names([options.scene], BUILT_IN, "scene")

    checkouts = Path(__file__).resolve().parent.parent, options.folder.resolve()
    play = "forward" if options.forward else "random"
    here, other = (stepper(checkout, options.scene, options.num_areas, play) for checkout in checkouts)
    turns = [(rate(here), rate(other)) for _ in range(options.turns)]
    for process in (here, other):
        process.terminate()

    for checkout, rates in zip(checkouts, zip(*turns, strict=True), strict=True):
        print(f"{statistics.median(rates):>10,.0f} decisions/s  {checkout}")
    ratio = statistics.median(mine / theirs for mine, theirs in turns)
    print(f"{ratio:>10.2f} times as fast ({options.scene}, {options.num_areas} areas, {play} play)")


if __name__ == "__main__":
    run_script(main)
