#!/usr/bin/env python3
"""Measure scenes behind mappo-player: the link, collection, a round's parts, two players, time to a return.

Everything that is compared runs in turns in one process, so that ratios hold on a machine that is shared.
Where other work slows the wall clock down, read the CPU columns: trainer and player take turns, so a machine
with a core free for each needs the sum of both a round.

    python scripts/bench_player.py [--scene 3DBall] [--areas 12] [--repeats 5] [--train] [--seed 0]
    python scripts/bench_player.py --scene SoccerTwos --train --max-steps 300000
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import torch
from player_stepping import Stepping, cpu_s, median_ratio, mlagents_client, our_client
from round_parts import player_pid, print_parts
from run_script import positive, run_script

from mappo_unity.cli.player import run as player_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.protocol.serve import env_function
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import set_up

UNITY_AREAS = {"3DBall": 12, "SoccerTwos": 8, "StrikersVsGoalie": 8}  # where presets have more


def main() -> None:
    """Run all measurements and print them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="3DBall")
    parser.add_argument("--areas", type=positive, help="areas of the scene; default: as in Unity")
    parser.add_argument("--repeats", type=positive, default=5)
    parser.add_argument("--rounds", type=positive, default=300, help="environment steps of one measurement")
    parser.add_argument("--train", action="store_true", help="train to --goal, too")
    parser.add_argument("--goal", type=float, default=95.0, help="mean return to train to")
    parser.add_argument("--max-steps", type=positive, default=None, help="agent steps to train at most")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()

    torch.set_num_threads(1)
    print(f"load average at the start: {os.getloadavg()[0]:.2f}; {os.cpu_count()} cores; one torch thread")

    with tempfile.TemporaryDirectory() as folder:
        player_main(["build", arguments.scene, folder])
        cfg = options(arguments, str(Path(folder) / arguments.scene))

        link(cfg, arguments)
        print_parts(cfg, arguments.scene, arguments.repeats, arguments.rounds, Path(folder) / "parts")
        several(cfg, arguments)
        if arguments.train:
            train(cfg, arguments.goal, Path(folder) / "train")

    print(f"load average at the end: {os.getloadavg()[0]:.2f}")


def options(arguments: argparse.Namespace, build: str) -> Config:
    """Return the scene's preset with its player below it."""
    lines = [f"env={arguments.scene}", "env.backend=player", f"env.file_name={build}"]
    lines += [f"seed={arguments.seed}"]

    num_areas = arguments.areas or UNITY_AREAS.get(arguments.scene)
    if num_areas is not None:
        lines.append(f"env.num_areas={num_areas}")
    if arguments.max_steps is not None:
        lines.append(f"max_steps={arguments.max_steps}")

    quiet = ["log.loggers=[]", "log.progress=false", "export_onnx=false", "matches.interval=null"]
    # whose player is measured is the one of this process
    return compose_config([*lines, *quiet, "collect.workers=0"]).config


def link(cfg: Config, arguments: argparse.Namespace) -> None:
    """Compare steps with random actions: ML-Agents' client, ours, no link at all."""
    embedded = env_function(arguments.scene, cfg.env.num_areas)
    bare, ours = mlagents_client(cfg), our_client(cfg)
    rows = {
        "embedded scene": Stepping(embedded(0, None), None),
        "mlagents_envs.UnityEnvironment": bare,
        "mappo-unity": ours,
    }
    for _ in range(arguments.repeats):
        for row in rows.values():
            row.measure(arguments.rounds)

    print(f"\nrandom actions in {arguments.scene}: {arguments.repeats} times {arguments.rounds} steps")
    print(f"{'':34s}{'agent steps/s':>15s}{'us a step':>12s}{'trainer CPU':>13s}{'player CPU':>12s}")
    for name, row in rows.items():
        print(f"{name:34s}{row.line()}")
    print(f"our client against ML-Agents': {median_ratio(bare.wall_us, ours.wall_us):.2f} times as fast")

    for row in rows.values():
        row.env.close()


def several(cfg: Config, arguments: argparse.Namespace) -> None:
    """Print what a second player brings."""
    rows = {}
    for count in (1, 2):
        cfg.env.num_players = count
        rows[count] = Stepping(make_env_function(cfg.env)(0), None)
    cfg.env.num_players = 1

    for _ in range(arguments.repeats):
        for row in rows.values():
            row.measure(arguments.rounds)

    costs = {n: [w / a for a, w in zip(r.agents_per_step, r.cpu_us)] for n, r in rows.items()}
    print(
        f"\ntwo players against one: {median_ratio(rows[2].rates(), rows[1].rates()):.2f} times the agent "
        f"steps/s; trainer's CPU an agent step {median_ratio(costs[2], costs[1]):.2f} times"
    )
    for row in rows.values():
        row.env.close()


def train(cfg: Config, goal: float, folder: Path) -> None:
    """Train until the mean return over a full window reaches the goal."""
    with set_up(cfg, folder) as setup, setup.collecting() as batches:
        state, pid = RunState(cfg, folder, setup), player_pid(setup)
        wall, cpu, player = time.perf_counter(), time.process_time(), cpu_s(pid)

        while state.agent_steps < cfg.max_steps and not state.recent_episodes.reached(goal):
            started = time.perf_counter()
            batch = next(batches)
            collected = time.perf_counter()
            setup.learn(batch, state.agent_steps / cfg.max_steps)
            state.count(batch, collected - started, time.perf_counter() - collected)

        wall_s, cpu_used = time.perf_counter() - wall, time.process_time() - cpu
        player_used = cpu_s(pid) - player

    mean, steps = state.recent_episodes.summary()["return_mean"], state.agent_steps
    print(
        f"\ntraining with the preset's options to a mean return of {mean:.1f}: {steps:,} agent steps, "
        f"{wall_s:.1f} s, {steps / wall_s:,.0f} agent steps/s"
    )
    print(
        f"  CPU: trainer {cpu_used:.1f} s, player {player_used:.1f} s: "
        f"{steps / (cpu_used + player_used):,.0f} agent steps/s with a core for each"
    )


if __name__ == "__main__":
    run_script(main)
