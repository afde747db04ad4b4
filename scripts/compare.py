#!/usr/bin/env python3
"""Train variants of one environment under the same budget, one after the other, and print a table.

    python scripts/compare.py env=3DBall --steps 500000 -- default recipe=mlagents recipe=benchmarl
    python scripts/compare.py env=SoccerTwos --seconds 300 --matches 200 -- default model.critic=local

A variant is a list of overrides joined by '+' ("default" is none). Where an environment has two sides,
matches against a random side are played before and after.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
from pathlib import Path

from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.policies.evaluate import match_figures
from mappo_unity.policies.matches import play_matches
from mappo_unity.policies.policy import ActorPolicy, RandomPolicy
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.training.resume_check import describe_policies
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import TrainingSetup, set_up
from mappo_unity.training.trainer import train

QUIET = ["log.progress=false", "log.loggers=[]", "export_onnx=false", "checkpoint_interval=1000000000"]


def main() -> None:
    """Run all variants and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env", help="env=NAME and further overrides joined by '+'")
    parser.add_argument("--seconds", type=float, default=None, help="wall-clock budget of a variant")
    parser.add_argument("--steps", type=positive, default=None, help="agent decisions of a variant")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--goal", type=float, default=95.0, help="mean return whose first time is printed")
    parser.add_argument("--matches", type=int, default=0, help="matches against a random side at the end")
    parser.add_argument("variants", nargs="+")
    arguments = parser.parse_args()
    print(f"load average at the start: {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores")
    columns = "variant", "seed", "agent steps", "s", "steps/s", "mean return", "first at goal"
    print(f"| {' | '.join([*columns, 'explained variance', 'matches'])} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for variant in arguments.variants:
        for seed in arguments.seeds:
            print(run(arguments, variant, seed), flush=True)
    print(f"load average at the end: {os.getloadavg()[0]:.2f}")


def run(arguments: argparse.Namespace, variant: str, seed: int) -> str:
    """Train one variant; return its row of the table."""
    lines = [*arguments.env.split("+"), *([] if variant == "default" else variant.split("+"))]
    lines += [f"seed={seed}", *QUIET] + ([f"max_steps={arguments.steps}"] if arguments.steps else [])
    cfg = compose_config(lines).config
    with tempfile.TemporaryDirectory() as folder:
        before = after = "-"
        if arguments.matches:
            with set_up(cfg, Path(folder)) as setup:
                before = play(cfg, setup, arguments.matches)

        def watch(state: RunState) -> str | None:
            nonlocal after
            is_over = arguments.seconds is not None and state.wall_s >= arguments.seconds
            if arguments.matches and (is_over or state.agent_steps >= cfg.max_steps):
                after = play(cfg, state.setup, arguments.matches)
            return "finished" if is_over else None

        outcome = train(cfg, Path(folder), after_iteration=watch)
        matches = f"{before} -> {after}" if arguments.matches else "-"
        rows = read_metrics(Path(folder) / "metrics.csv")
    reached = next((row for row in rows if row["return_mean"] >= arguments.goal), None)
    first = f"{reached['agent_steps']:,} ({reached['wall_s']:.0f} s)" if reached else "-"
    variances = [row["explained_variance"] for row in rows[len(rows) // 2 :]]
    return (
        f"| {variant} | {seed} | {outcome.agent_steps:,} | {outcome.wall_s:.0f} | "
        f"{outcome.agent_steps / outcome.wall_s:,.0f} | {outcome.return_mean:.2f} | {first} | "
        f"{statistics.median(variances):.3f} | {matches} |"
    )


def play(cfg: Config, setup: TrainingSetup, count: int) -> str:
    """Play matches of the trained policy against a random side."""
    actors = {name: learner.actor for name, learner in setup.learners.items()}
    policy = ActorPolicy(describe_policies(setup.env), actors, False, "the policy")
    scores = play_matches(make_env_function(cfg.env), policy, RandomPolicy(1), count, seed=1)
    figures = match_figures(scores)
    return "; ".join(
        f"{name}: {side['wins']} won {side['losses']} lost {side['draws']} drawn"
        for name, side in figures["as"].items()
    )


if __name__ == "__main__":
    run_script(main)
