#!/usr/bin/env python3
"""Train on VMAS, a cooperative benchmark from outside, and print when each goal is reached.

Three tasks with BenchMARL's parameters: navigation (3 agents), balance (4) and simple_spread (3), 60
environments, episodes of 100 steps. A frame is one step of one environment; the return is the mean over
agents of an episode's sum, of the deterministic policy over the same 400 episodes each time (not counted as
frames, nor in the seconds).

    python scripts/bench_vmas.py [TASK ...] [--seeds 0 1 2] [--set ppo.lr=1e-4 ...]

Needs the package vmas (extra "bench").
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config

sys.path.insert(0, str(Path(__file__).resolve().parent))  # where env.factory finds vmas_env

NUM_ENVS = 60
EVAL_ENVS = 400
EVAL_SEED = 12345


@dataclass(frozen=True)
class Task:
    """What is trained, with which options beyond the common ones, and what counts as reached."""

    agents: int
    frames: int
    goal: float | None  # None: better than at the start
    params: dict[str, Any]  # BenchMARL 1.5.2's, by its conf/task/vmas
    options: tuple[str, ...] = ()


COMMON = (
    "env=custom",
    "env.factory=vmas_env:make",
    f"env.params.num_envs={NUM_ENVS}",
    "collect.rounds=100",  # whole episodes: they begin together, so half of one is half of the task
    "ppo.gamma=0.9",  # as in VMAS' own experiments
    "ppo.lr=1e-3",
    "ppo.epochs=10",
    "model.init_log_std=1",  # about the range of actions
    "log.progress=false",
    "log.loggers=[]",
    "export_onnx=false",
)
TASKS = {
    "navigation": Task(3, 60_000, 0.95, {"shared_rew": False}),
    "balance": Task(4, 180_000, 50.0, {}, ("collect.rounds=50",)),  # its episodes soon run apart
    "simple_spread": Task(3, 180_000, None, {}),
}


def main() -> None:
    """Train the tasks asked for and print the table, a line as soon as a run is over."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)}; default: all")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--set", nargs="+", default=[], metavar="OPTION=VALUE", help="further options")
    parser.add_argument("--frames", type=positive, default=None, help="instead of the task's own number")
    parser.add_argument("--curve", action="store_true", help="print every evaluation")
    arguments = parser.parse_args()
    for name in arguments.tasks:
        if name not in TASKS:
            parser.error(f"there is no task {name!r}; there are {', '.join(TASKS)}")

    columns = "task", "seed", "frames", "return: start", "end", "best", "goal", "reached at", "rolled back"
    print(f"| {' | '.join([*columns, 's', 'CPU s', 'load'])} |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|", flush=True)

    for name in arguments.tasks or TASKS:
        for seed in arguments.seeds:
            run = Run(name, seed, arguments.frames or TASKS[name].frames, arguments.set)
            run.train()
            print(run.row(), flush=True)
            if arguments.curve:
                print("  " + "  ".join(f"{f // 1000}k {r:.4g}" for f, r in run.curve), flush=True)


def options(name: str, seed: int, frames: int) -> list[str]:
    """Return the options of a run, as mappo-train takes them."""
    task = TASKS[name]
    params = [f"env.params.{key}={value}" for key, value in {"n_agents": task.agents, **task.params}.items()]
    steps = frames * task.agents
    return [
        *COMMON,
        f"env.name=vmas-{name}",
        f"env.params.scenario={name}",
        *params,
        f"log.return_window={NUM_ENVS * task.agents}",
        f"max_steps={steps}",
        f"checkpoint_interval={steps}",
        f"seed={seed}",
        *task.options,
    ]


class Run:
    """One training run, evaluated in between."""

    def __init__(self, name: str, seed: int, frames: int, extra: list[str]) -> None:
        self.name, self.seed, self.task = name, seed, TASKS[name]
        self.cfg: Config = compose_config([*options(name, seed, frames), *extra]).config
        self.curve: list[tuple[int, float]] = []  # frames, mean return
        self.seconds = self.cpu_seconds = 0.0
        self.frames = self.rollbacks = 0
        self.since: float | None = None  # processor time at the end of the last iteration

    def train(self) -> None:
        """Train to the end, evaluating about twenty times on the way."""
        from mappo_unity.training.setup import set_up
        from mappo_unity.training.trainer import train

        with tempfile.TemporaryDirectory() as folder:
            with set_up(self.cfg, Path(folder)) as setup:
                self.evaluate(setup)
            outcome = train(self.cfg, Path(folder), after_iteration=self.watch)
        self.seconds = outcome.wall_s
        self.rollbacks = sum(rolled_back for rolled_back, _ in outcome.updates.values())

    def watch(self, state: Any) -> None:
        """Count an iteration's frames and processor time; evaluate now and then."""
        now = time.process_time()
        if self.since is not None:
            self.cpu_seconds += now - self.since
        self.frames = state.agent_steps // self.task.agents
        done = state.agent_steps >= self.cfg.max_steps
        if done or self.frames - self.curve[-1][0] >= self.cfg.max_steps / self.task.agents / 20:
            self.evaluate(state.setup)
        self.since = time.process_time()

    def evaluate(self, setup: Any) -> None:
        """Play the deterministic policy on the same episodes as ever; note the mean return."""
        import torch
        from vmas_env import make

        from mappo_unity.policies.evaluate import play
        from mappo_unity.policies.policy import ActorPolicy
        from mappo_unity.training.resume_check import describe_policies

        actors = {name: learner.actor for name, learner in setup.learners.items()}
        policy = ActorPolicy(describe_policies(setup.env), actors, True, "the policy")
        with torch.random.fork_rng(devices=[]):
            env = make(EVAL_SEED, **{**self.cfg.env.params, "num_envs": EVAL_ENVS})
            episodes = next(iter(play(env, policy, EVAL_ENVS * self.task.agents).values()))
        self.curve.append((self.frames, float(np.mean([e.individual_return for e in episodes]))))

    def row(self) -> str:
        """Return the run's line of the table."""
        start, end = self.curve[0][1], self.curve[-1][1]
        goal = self.task.goal if self.task.goal is not None else start
        reached = next((frames for frames, value in self.curve[1:] if value >= goal), math.inf)
        return (
            f"| {self.name} | {self.seed} | {self.frames:,} | {start:.4g} | {end:.4g} "
            f"| {max(value for _, value in self.curve):.4g} | {goal:.4g} "
            f"| {f'{reached:,}' if reached < math.inf else 'never'} | {self.rollbacks} "
            f"| {self.seconds:.0f} | {self.cpu_seconds:.0f} | {os.getloadavg()[0]:.1f} |"
        )


if __name__ == "__main__":
    run_script(main)
