#!/usr/bin/env python3
"""Compare runs on a parallel environment with random play, and draw their curves (needs matplotlib).

python scripts/curve_spread.py RUN ... [--episodes 300] [--out spread.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from run_script import positive, run_script

from mappo_unity.envs.backends import make_env_function
from mappo_unity.policies.episodes import play, summarize
from mappo_unity.policies.evaluate import open_policy
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.runs.options import config_to_play


def mean_return(run: Path, policy: str, episodes: int) -> float:
    """Play a policy in a run's environment, print its mean return, and return it."""
    env = make_env_function(config_to_play(run, None).env)(0)
    try:
        (rows,) = play(env, open_policy(policy, deterministic=True, seed=0), episodes).values()
    finally:
        env.close()

    figures = summarize(rows)
    print(
        f"{policy}: {figures['mean_return']:.2f} +- {figures['stderr']:.2f} in {figures['episodes']} episodes"
    )
    return float(figures["mean_return"])


def main() -> None:
    """Play, print and draw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--episodes", type=positive, default=300, help="agent episodes of each policy")
    parser.add_argument("--out", type=Path, default=Path("spread.png"))
    arguments = parser.parse_args()

    chance = mean_return(arguments.runs[0], "random", arguments.episodes)
    for run in arguments.runs:
        mean_return(run, str(run), arguments.episodes)

    from matplotlib import pyplot

    pyplot.figure(figsize=(6, 3.2))
    for run in arguments.runs:
        rows = read_metrics(run / "metrics.csv")
        pyplot.plot([r["agent_steps"] for r in rows], [r["return_mean"] for r in rows], label=run.name)
    pyplot.axhline(chance, color="grey", linestyle="--", label="random")
    pyplot.xlabel("agent steps")
    pyplot.ylabel("mean return of an agent")
    pyplot.legend()
    pyplot.tight_layout()
    pyplot.savefig(arguments.out, dpi=100)


if __name__ == "__main__":
    run_script(main)
