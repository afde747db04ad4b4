#!/usr/bin/env python3
"""Measure 3DBall: collection, updates, time to a mean return of 95, memory - with ratios.

Collection and updates are measured side by side with hand-written loops of the same networks and
shapes (no TorchRL), in one process, in turns, so that the ratios hold on a machine that is shared.

    python scripts/bench_3dball.py [--repeats 5] [--seed 0]
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import tempfile
from pathlib import Path

import torch
from bench_update import measure, timed
from mlagents_envs.base_env import ActionTuple
from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.learning.networks.mlp import make_mlp
from mappo_unity.scenes import make_scene
from mappo_unity.training.setup import set_up
from mappo_unity.training.trainer import train


def main() -> None:
    """Run all measurements and print them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=positive, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seeds", type=int, default=0, help="also train seeds 0 .. N-1 to the end, default options"
    )
    arguments = parser.parse_args()

    cfg = compose_config(
        ["env=3DBall", f"seed={arguments.seed}", "log.loggers=[]", "log.progress=false"]
    ).config
    print(
        f"load average at the start: {os.getloadavg()[0]:.2f}; {os.cpu_count()} cores; "
        f"torch threads {cfg.num_threads}; {cfg.env.num_areas} areas, batch {cfg.collect.batch_size}, "
        f"hidden {list(cfg.model.hidden)}, minibatch {cfg.ppo.minibatch_size}"
    )

    time_to_95(cfg)
    collection(cfg, arguments.repeats)
    measure(cfg, arguments.repeats)
    for seed in range(arguments.seeds):
        whole_run(seed)

    print(f"peak resident memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB")
    print(f"load average at the end: {os.getloadavg()[0]:.2f}")


def time_to_95(cfg: Config) -> None:
    """Train until the mean return over a full window of finished episodes is 95."""
    cfg = compose_config([f"seed={cfg.seed}", "log.progress=false", "stop_at_return=95"]).config
    with tempfile.TemporaryDirectory() as folder:
        outcome = train(cfg, Path(folder))
    seconds = outcome.wall_s
    print(
        f"mean return {outcome.return_mean:.1f} ({outcome.status}) after {seconds:.1f} s from the first "
        f"environment step, {outcome.agent_steps:,} agent steps, {outcome.agent_steps / seconds:,.0f}/s"
    )


def whole_run(seed: int) -> None:
    """Train with the default options to the end."""
    cfg = compose_config([f"seed={seed}", "log.progress=false"]).config
    with tempfile.TemporaryDirectory() as folder:
        outcome = train(cfg, Path(folder))
    print(
        f"seed {seed}: mean return {outcome.return_mean:.2f} over the last {cfg.log.return_window} episodes, "
        f"{outcome.agent_steps:,} agent steps, {outcome.wall_s:.1f} s"
    )


def collection(cfg: Config, repeats: int) -> None:
    """Compare the collector with a bare loop: scene step and forward pass of the same network."""
    with (
        tempfile.TemporaryDirectory() as folder,
        set_up(cfg, Path(folder)) as setup,
        setup.collecting() as batches,
    ):
        rounds = next(batches).rounds.shape[0]
        bare = BareLoop(cfg)
        next(batches), bare.collect(rounds)
        ours, theirs, ratios = [], [], []
        for _ in range(repeats):
            ours.append(timed(lambda: [next(batches) for _ in range(4)]))
            theirs.append(timed(lambda: bare.collect(4 * rounds)))
            ratios.append(theirs[-1] / ours[-1])
        steps = 4 * rounds * int(cfg.env.num_areas or 12)
        print(
            f"collection: {steps / statistics.median(ours):,.0f} agent steps/s; bare loop "
            f"{steps / statistics.median(theirs):,.0f}/s; ratio {statistics.median(ratios):.2f} "
            f"({min(ratios):.2f} to {max(ratios):.2f})"
        )


class BareLoop:
    """Scene step and a plain forward pass with Gaussian noise, nothing else."""

    def __init__(self, cfg: Config) -> None:
        self.env = make_scene("3DBall", seed=cfg.seed, num_areas=cfg.env.num_areas)
        self.net = make_mlp(8, list(cfg.model.hidden), 2, cfg.model.activation, 0.01)
        self.env.reset()
        self.name = next(iter(self.env.behavior_specs))

    @torch.no_grad()
    def collect(self, rounds: int) -> None:
        """Play so many rounds in which agents decide."""
        while rounds:
            decision, _ = self.env.get_steps(self.name)
            if len(decision):
                mean = self.net(torch.from_numpy(decision.obs[0]))
                action = (mean + torch.randn_like(mean)).clamp(-3, 3) / 3
                self.env.set_actions(self.name, ActionTuple(continuous=action.numpy()))
                rounds -= 1
            self.env.step()


if __name__ == "__main__":
    run_script(main)
