#!/usr/bin/env python3
"""Train StrikersVsGoalie without the reward for touches, with novelty and without, and play both.

In Unity's scene only a goal earns something, and random strikers hardly ever score one: the preset's small
reward for touching the ball (`env.params.ball_touch`) is taken away, and RND stands in for it. Strikers play
against a random goalie; printed is a line for each seed, with the share of the matches in which they scored,
and the decisions of all of their play for each goal. Random strikers come first. Runs lie in OUT and are
resumed after any interruption.

    python scripts/check_novelty.py [--steps 3500000] [--seeds 0] [--matches 200] [--out outputs/novelty]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from learn_scene import mappo_eval
from run_script import positive, run_script
from score_measures import as_strikers
from score_table import train

SCENE = "StrikersVsGoalie"
NO_TOUCHES = "env.params.ball_touch=0"
SIGNALS = {"without novelty": [], "with RND": ["rewards.rnd.strength=0.1"]}


def main() -> None:
    """Measure random strikers, then train and measure a run of each kind for every seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=positive, default=3_500_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--matches", type=positive, default=200)
    parser.add_argument("--minutes", type=float, default=120.0, help="of collecting and learning, for a run")
    parser.add_argument("--out", type=Path, default=Path("outputs/novelty"))
    arguments = parser.parse_args()

    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores", flush=True)
    report("random strikers", ["run=random", f"env={SCENE}", NO_TOUCHES], arguments.matches)

    for seed in arguments.seeds:
        for label, options in SIGNALS.items():
            folder = arguments.out / f"{label.replace(' ', '-')}-{seed}"
            options = [NO_TOUCHES, *options, f"max_steps={arguments.steps}", "update_threads=1"]
            train(SCENE, seed, folder, arguments.minutes, options)
            report(f"{label}, seed {seed}", [f"run={folder}"], arguments.matches)


def report(label: str, policy: list[str], matches: int) -> None:
    """Let a policy's strikers play a random goalie, and print what came of it."""
    # each side of the scene is played in half of the matches
    said = mappo_eval(*policy, "opponent=random", f"episodes={2 * matches}", "deterministic=false")
    strikers = as_strikers(said)
    print(
        f"{label}: scored in {strikers['wins']} of {strikers['matches']} matches, "
        f"{strikers['mean_decisions']:.0f} decisions a match",
        flush=True,
    )


if __name__ == "__main__":
    run_script(main)
