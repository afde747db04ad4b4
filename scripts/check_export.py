#!/usr/bin/env python3
"""Check that exported policies earn in another client what mappo-eval says their checkpoints earn.

    python scripts/check_export.py RUN [RUN ...] [--episodes 2000] [--areas 4] [--run-policy run_policy.py]

RUN is a run folder (its best checkpoint plays, as in mappo-eval) or a checkpoint file. The checkpoint is
exported to a temporary folder; the files are played in the run's scene by run_policy.py's own `play` and
`OfficialPolicy`, which know ML-Agents' contract and nothing of this project; the checkpoint is played by the
code of mappo-eval. Both sides of a two-sided scene are played by the same policy. Printed is a row for each
behavior, play (sampled, deterministic) and kind of return: all (individual and group), and group alone where
there is any. Exit code 1 if a difference is larger than --allow standard errors: with 2, one comparison of
honest figures in 22 is.

The two count differently: mappo-eval the first episodes that begin, run_policy all that end before it stops,
so that each agent's last episode, which is rather a long one, is missing. Counting is left to each; the
bias of the second, -cov(return, length) / (mean length * episodes of an agent) by Wald's identity, is kept
small by many episodes of few areas and printed in standard errors: below 0.1 it does not matter.
Standard errors come from the means of batches of consecutive episodes, since team-mates earn the same.
Policies that play to the end of every episode take long: few episodes of many areas do for them.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from run_script import positive, run_script

from mappo_unity.envs.backends import MakeEnv, make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.policies.episodes import play, standard_error
from mappo_unity.policies.export import export_checkpoint
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.policies.policy_files import choose_checkpoint
from mappo_unity.runs.options import config_to_play

RUN_POLICY = Path(__file__).resolve().parents[2] / "shared" / "oracle" / "run_policy.py"
PLAYS = ["sampled", "deterministic"]
MAX_ENV_STEPS = 5_000_000
ROUNDING = 1e-5  # of a mean: sums of float32 rewards in another order
MAX_BIAS = 0.1  # standard errors


class Returns(NamedTuple):
    """Episodes of one behavior in the order of their ends."""

    individual: np.ndarray
    group: np.ndarray
    length: np.ndarray  # decisions


def main() -> int:
    """Play all runs and print the table; return the exit code."""
    arguments = _parser().parse_args()
    try:
        runner = load_run_policy(arguments.run_policy)
        print(
            f"{'run':20} {'agent_steps':>12} {'play':13} {'behavior':20} {'return':10} {'mappo-eval':>20} "
            f"{'run_policy':>20} {'difference':>10} {'bias':>6}   (the last two in standard errors)"
        )
        worst = max(check(Path(run), arguments, runner) for run in arguments.runs)
    except ConfigError as error:
        print(f"check_export: {error}", file=sys.stderr)
        return 2
    print(f"largest difference: {worst:.2f} standard errors, allowed {arguments.allow:g}")
    return int(worst > arguments.allow)


def check(run: Path, arguments: argparse.Namespace, runner: ModuleType) -> float:
    """Print the rows of one run; return its largest difference in standard errors."""
    cfg = config_to_play(run, None).env
    checkpoint = choose_checkpoint(run)
    steps = CheckpointPolicy(checkpoint, True).agent_steps
    make_env = make_env_function(replace(cfg, num_areas=arguments.areas))
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        files = {e.policy: str(e.path) for e in export_checkpoint(checkpoint, Path(folder))}
        for mode in arguments.plays:
            deterministic = mode == "deterministic"
            ours = play_checkpoint(make_env, checkpoint, arguments.episodes, deterministic, arguments.seed)
            theirs, agents = play_export(
                runner, make_env, files, arguments.episodes, deterministic, arguments.seed + 1
            )
            for behavior, found in ours.items():
                head = f"{run.name[-20:]:20} {steps:12,} {mode:13} {behavior[:20]:20}"
                worst = max(worst, compare(head, found, theirs[behavior], agents[behavior]))
    return worst


def play_checkpoint(
    make_env: MakeEnv, path: Path, episodes: int, deterministic: bool, seed: int
) -> dict[str, Returns]:
    """Play a checkpoint as mappo-eval does; return the episodes of each behavior."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    env = make_env(seed)
    try:
        done = play(env, CheckpointPolicy(path, deterministic), episodes)
    finally:
        env.close()
    return {
        name: _returns([(e.individual_return, e.group_return, e.length) for e in rows])
        for name, rows in done.items()
    }


def play_export(
    runner: ModuleType,
    make_env: MakeEnv,
    files: dict[str, str],
    episodes: int,
    deterministic: bool,
    seed: int,
) -> tuple[dict[str, Returns], dict[str, int]]:
    """Play ONNX files with run_policy's loop; return each behavior's episodes and number of agents."""
    rng = np.random.default_rng(seed)
    policies = {name: runner.OfficialPolicy(file, rng, deterministic) for name, file in files.items()}
    env = make_env(seed)
    try:
        done = runner.play(env, policies, episodes, MAX_ENV_STEPS)
        env.reset()
        agents = {name: max(1, len(env.get_steps(name)[0])) for name in env.behavior_specs}
    finally:
        env.close()
    return {name: _returns([row[:3] for row in rows]) for name, rows in done.items()}, agents


def compare(head: str, ours: Returns, theirs: Returns, agents: int) -> float:
    """Print the rows of one behavior; return the largest difference in standard errors."""
    kinds = {"all": (ours.individual + ours.group, theirs.individual + theirs.group)}
    if ours.group.any() or theirs.group.any():
        kinds["group"] = (ours.group, theirs.group)
    worst = 0.0
    for kind, (a, b) in kinds.items():
        errors = standard_error(a, teams=True), standard_error(b, teams=True)
        unit = math.hypot(*errors, ROUNDING * max(1.0, abs(a.mean())))
        difference = (b.mean() - a.mean()) / unit
        bias = counting_bias(b, theirs.length, agents) / unit
        note = "   bias not small: more --episodes, fewer --areas" if abs(bias) > MAX_BIAS else ""
        figures = [f"{x.mean():.4f} +- {error:.4f}" for x, error in zip((a, b), errors)]
        print(
            f"{head} {kind:10} {figures[0]:>20} {figures[1]:>20} {difference:10.2f} {bias:6.2f}{note}",
            flush=True,
        )
        worst = max(worst, abs(difference))
    return worst


def counting_bias(values: np.ndarray, length: np.ndarray, agents: int) -> float:
    """Return by how much the mean of the episodes that ended differs from the mean of those that begin.

    Wald's identity: the returns of an agent's first N + 1 episodes, N of them ended, have the mean
    E[N + 1] rho; the last one, under way when play stops, is met with a probability in proportion to its
    length, so that its mean return is rho + cov(return, length) / E[length], and it is not counted.
    """
    covariance = float(np.mean((values - values.mean()) * (length - length.mean())))
    return -covariance / (float(length.mean()) * len(values) / agents)


def load_run_policy(path: Path) -> ModuleType:
    """Import run_policy.py from where it lies.

    Raises:
        ConfigError: it is not there.
    """
    if not path.is_file():
        raise ConfigError(f"run_policy.py is not at {path}; say where it lies: --run-policy PATH")
    spec = importlib.util.spec_from_file_location("run_policy", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _returns(rows: list[tuple[float, float, int]]) -> Returns:
    return Returns(*(np.array(column, float) for column in zip(*rows)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folder or checkpoint")
    parser.add_argument("--episodes", type=positive, default=2000, help="agent episodes of each behavior")
    parser.add_argument(
        "--plays", nargs="+", choices=PLAYS, default=PLAYS, metavar="PLAY", help=" ".join(PLAYS)
    )
    parser.add_argument("--areas", type=positive, default=4, help="areas of the scene")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--allow", type=float, default=2.0, help="standard errors of difference")
    parser.add_argument("--run-policy", type=Path, default=RUN_POLICY, metavar="PATH")
    return parser


if __name__ == "__main__":
    run_script(main)
