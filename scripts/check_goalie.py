#!/usr/bin/env python3
"""Let strikers of several checkpoints of a StrikersVsGoalie run play goalies of several others.

Prints a line for each pair: share of the matches in which the strikers scored, and decisions a match. The
first snapshot of a run with self-play lies in its folder pool/.

    python scripts/check_goalie.py FIRST.pt LATER.pt ... [--matches 200] [--seed 0]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from run_script import positive, run_script

from mappo_unity.policies.matches import find_sides, play_side
from mappo_unity.policies.policy import CheckpointPolicy, Policy
from mappo_unity.scenes.registry import make_scene


def main() -> None:
    """Play every pair."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoints", nargs="+", type=Path)
    parser.add_argument("--matches", type=positive, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    policies = [CheckpointPolicy(path, deterministic=False) for path in arguments.checkpoints]
    for strikers in policies:
        for goalie in policies:
            scored, decisions = play(strikers, goalie, arguments.matches, arguments.seed)
            print(
                f"strikers of {strikers.agent_steps:>10,} against the goalie of {goalie.agent_steps:>10,}: "
                f"scored in {100 * scored:5.1f} % of {arguments.matches} matches, {decisions:.0f} decisions",
                flush=True,
            )


def play(strikers: Policy, goalie: Policy, matches: int, seed: int) -> tuple[float, float]:
    """Return the share of the matches in which the strikers scored, and the mean decisions of a match."""
    torch.manual_seed(seed)  # the policies draw from it
    env = make_scene("StrikersVsGoalie", seed=seed)
    try:
        sides = find_sides(env)
        own = next(names for names in sides.values() if any(name.startswith("Striker") for name in names))
        others = [name for names in sides.values() for name in names if name not in own]
        policies = dict.fromkeys(own, strikers) | dict.fromkeys(others, goalie)
        score = play_side(env, policies, own, matches)
    finally:
        env.close()
    return score.wins / score.matches, score.decisions / score.matches


if __name__ == "__main__":
    run_script(main)
