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
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from run_script import run_script

from mappo_unity.cli.player import run as player_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.protocol import decode, messages
from mappo_unity.protocol.serve import Player, env_function
from mappo_unity.training.collection.batches import count_decisions
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import TrainingSetup, set_up

from mlagents_envs.base_env import BaseEnv  # isort: skip  # mappo_unity lets it import

UNITY_AREAS = {"3DBall": 12, "SoccerTwos": 8, "StrikersVsGoalie": 8}  # where presets have more
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run all measurements and print them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="3DBall")
    parser.add_argument("--areas", type=int, default=None, help="areas of the scene; default: as in Unity")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--rounds", type=int, default=300, help="environment steps of one measurement")
    parser.add_argument("--train", action="store_true", help="train to --goal, too")
    parser.add_argument("--goal", type=float, default=95.0, help="mean return to train to")
    parser.add_argument("--max-steps", type=int, default=None, help="agent steps to train at most")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"load average at the start: {os.getloadavg()[0]:.2f}; {os.cpu_count()} cores; one torch thread")
    with tempfile.TemporaryDirectory() as folder:
        player_main(["build", arguments.scene, folder])
        build = str(Path(folder) / arguments.scene)
        cfg = options(arguments, build)
        link(cfg, arguments)
        parts(cfg, arguments, Path(folder))
        several(cfg, arguments)
        if arguments.train:
            train(cfg, arguments, Path(folder))
    print(f"load average at the end: {os.getloadavg()[0]:.2f}")


def options(arguments: argparse.Namespace, build: str, *more: str) -> Config:
    """Return the scene's preset with its player below it."""
    num_areas = arguments.areas or UNITY_AREAS.get(arguments.scene)
    areas = [] if num_areas is None else [f"env.num_areas={num_areas}"]
    lines = [f"env={arguments.scene}", "env.backend=player", f"env.file_name={build}", *areas, *more]
    if arguments.max_steps is not None:
        lines.append(f"max_steps={arguments.max_steps}")
    quiet = ["log.loggers=[]", "log.progress=false", "export_onnx=false", "matches.interval=null"]
    # whose player is measured is the one of this process
    return compose_config([*lines, *quiet, "collect.workers=0", f"seed={arguments.seed}"]).config


# ---- stepping with random actions: ML-Agents' client, ours, no link at all


def link(cfg: Config, arguments: argparse.Namespace) -> None:
    """Compare clients: steps with random actions."""
    embedded = env_function(arguments.scene, cfg.env.num_areas)
    rows = {
        "embedded scene": Stepping(embedded(0, None), None),
        "mlagents_envs.UnityEnvironment": mlagents_client(cfg),
        "mappo-unity": our_client(cfg),
    }
    for _ in range(arguments.repeats):
        for row in rows.values():
            row.measure(arguments.rounds)
    print(f"\nrandom actions in {arguments.scene}: {arguments.repeats} times {arguments.rounds} steps")
    print(f"{'':34s}{'agent steps/s':>15s}{'us a step':>12s}{'trainer CPU':>13s}{'player CPU':>12s}")
    for name, row in rows.items():
        print(f"{name:34s}{row.line()}")
    bare, ours = rows["mlagents_envs.UnityEnvironment"], rows["mappo-unity"]
    print(f"our client against ML-Agents': {median_ratio(bare.wall_us, ours.wall_us):.2f} times as fast")
    for row in rows.values():
        row.env.close()


def mlagents_client(cfg: Config) -> Stepping:
    """Return ML-Agents' own client on the same player, on the first port that is free."""
    from mlagents_envs.environment import UnityEnvironment
    from mlagents_envs.exception import UnityWorkerInUseException

    areas = cfg.env.num_areas or 1
    for port in range(6005, 6105):
        try:
            env = UnityEnvironment(cfg.env.file_name, base_port=port, num_areas=areas, no_graphics=True)
        except UnityWorkerInUseException:
            continue
        return Stepping(env, env._process.pid)
    raise ConfigError("no port from 6005 to 6104 is free for UnityEnvironment")


def our_client(cfg: Config) -> Stepping:
    """Return the client of this project on the same player."""
    env: Any = make_env_function(cfg.env)(0)
    return Stepping(env, env.player.process.pid)


class Stepping:
    """Step an environment with random actions, again and again."""

    def __init__(self, env: BaseEnv, pid: int | None) -> None:
        self.env, self.pid = env, pid
        self.wall_us: list[float] = []
        self.cpu_us: list[float] = []
        self.player_us: list[float] = []
        self.agents_per_step: list[float] = []
        self.rng = np.random.default_rng(0)
        env.reset()

    def measure(self, steps: int) -> None:
        """Take one measurement more."""
        wall, cpu, player, agents = time.perf_counter(), time.process_time(), self._player_s(), 0
        for _ in range(steps):
            agents += self._step()
        self.wall_us.append((time.perf_counter() - wall) / steps * 1e6)
        self.cpu_us.append((time.process_time() - cpu) / steps * 1e6)
        self.player_us.append((self._player_s() - player) / steps * 1e6)
        self.agents_per_step.append(agents / steps)

    def _step(self) -> int:
        agents = 0
        for name, spec in self.env.behavior_specs.items():
            count = len(self.env.get_steps(name)[0])
            if count:
                self.env.set_actions(name, spec.action_spec.random_action(count))
            agents += count
        self.env.step()
        return agents

    def _player_s(self) -> float:
        return cpu_s(self.pid) if self.pid is not None else 0.0

    def line(self) -> str:
        """Return medians as columns."""
        rates = [a / w * 1e6 for a, w in zip(self.agents_per_step, self.wall_us)]
        return (
            f"{statistics.median(rates):15,.0f}{statistics.median(self.wall_us):12.0f}"
            f"{statistics.median(self.cpu_us):13.0f}{statistics.median(self.player_us):12.0f}"
        )


# ---- one round of training's collection, part by part


def parts(cfg: Config, arguments: argparse.Namespace, folder: Path) -> None:
    """Print what a round costs in player, transport, decoding, adapter and policy, CPU microseconds."""
    stack = ExitStack()
    setup = stack.enter_context(set_up(cfg, folder / "parts"))
    base_env: Any = env_of(setup).base_env
    pid = base_env.player.process.pid
    bare = mlagents_client(cfg)
    batches = stack.enter_context(setup.collecting())
    next(batches)
    whole: list[tuple[float, float, float, float]] = []
    for _ in range(arguments.repeats):
        bare.measure(arguments.rounds)
        wall, cpu, player = time.perf_counter(), time.process_time(), cpu_s(pid)
        batch = next(batches)
        rounds = batch.rounds.shape[0]
        whole.append(
            (
                (time.perf_counter() - wall) / rounds * 1e6,
                (time.process_time() - cpu) / rounds * 1e6,
                (cpu_s(pid) - player) / rounds * 1e6,
                count_decisions(batch.rounds, setup.learners) / rounds,
            )
        )
    bare_rates = [a / w for a, w in zip(bare.agents_per_step, bare.wall_us)]
    rates = [agents / wall_us for wall_us, _, _, agents in whole]
    wall_us, cpu_us, player_us, agents = (statistics.median(column) for column in zip(*whole))
    data, output_us = player_message(arguments.scene, cfg, arguments.rounds)
    decode_us = decoding(data, arguments.rounds)
    policy_us = policy(setup, arguments.rounds)
    adapter_us = adapter(cfg, arguments)
    print(f"\na round of collecting {arguments.scene}: {agents:.1f} agents act, {wall_us:.0f} us")
    print(f"  end to end                {agents / wall_us * 1e6:10,.0f} agent steps/s")
    print(f"  against bare stepping     {median_ratio(rates, bare_rates):10.2f} of ML-Agents' agent steps/s")
    print(
        f"  with a core for each      {agents / (cpu_us + player_us) * 1e6:10,.0f} agent steps/s (sum of CPU)"
    )
    print(
        f"  player process            {player_us:10.0f} us CPU (scene and its messages alone {output_us:.0f})"
    )
    print(f"  decoding a message        {decode_us:10.0f} us CPU ({len(data):,} bytes)")
    print(f"  adapter                   {adapter_us:10.0f} us CPU (with transforms, less the scene's steps)")
    print(f"  policy                    {policy_us:10.0f} us CPU")
    rest = cpu_us - decode_us - adapter_us - policy_us
    print(f"  transport and collector   {rest:10.0f} us CPU (what remains of the trainer's {cpu_us:.0f})")
    bare.env.close()
    stack.close()


def player_message(scene: str, cfg: Config, steps: int) -> tuple[bytes, float]:
    """Return a player's message, and what the player spends on one, without gRPC (CPU us)."""
    player = Player(env_function(scene, cfg.env.num_areas), scene)
    hello = messages.parse(messages.message(200, unity_input=decode.initialization(0, 1, "0.28.0")))
    player._open(hello.unity_input.rl_initialization_input)
    reset = messages.parse(messages.message(200, unity_input=decode.rl_input({}, messages.RESET, b"")))
    data = messages.message(200, unity_output=player.advance(reset.unity_input.rl_input))
    step = messages.parse(messages.message(200, unity_input=decode.rl_input({}, messages.STEP, b"")))
    begin = time.process_time()
    for _ in range(steps):
        messages.message(200, unity_output=player.advance(step.unity_input.rl_input))
    return data, (time.process_time() - begin) / steps * 1e6


def decoding(data: bytes, steps: int) -> float:
    """Return what decoding a message costs, CPU us."""
    output = messages.parse(data).unity_output
    decoders = {
        brain.brain_name: decode.BehaviorDecoder(
            brain.brain_name,
            decode.behavior_spec(brain, output.rl_output.agentInfos[brain.brain_name].value[0]),
        )
        for brain in output.rl_initialization_output.brain_parameters
    }

    def once() -> None:
        infos = messages.parse(data).unity_output.rl_output.agentInfos
        for name, decoder in decoders.items():
            decoder.decode(infos[name].value)

    return cpu_of(once, steps)


def env_of(setup: TrainingSetup) -> UnityEnv:
    """Return the environment, which this process plays."""
    assert isinstance(setup.env, UnityEnv)
    return setup.env


def policy(setup: TrainingSetup, steps: int) -> float:
    """Return what the policy costs a round, CPU us."""
    from mappo_unity.envs.transforms import transformed

    observations = transformed(env_of(setup)).reset()
    with torch.no_grad():
        return cpu_of(lambda: setup.policy(observations.clone(recurse=False)), steps)


def adapter(cfg: Config, arguments: argparse.Namespace) -> float:
    """Return what adapter and transforms add to a round, CPU us: embedded, less the scene's own steps."""
    from mappo_unity.envs.transforms import transformed
    from mappo_unity.envs.unity_env import UnityEnv

    make = env_function(arguments.scene, cfg.env.num_areas)
    env = UnityEnv(lambda seed: make(seed, None))
    seen = transformed(env)
    actions = seen.rand_action(seen.reset())
    inner_s = timed_steps(env.base_env)
    begin, inner = time.process_time(), inner_s()
    for _ in range(arguments.rounds):
        seen.step_and_maybe_reset(actions.copy())
    own = time.process_time() - begin - (inner_s() - inner)
    return own / arguments.rounds * 1e6


def timed_steps(env: Any) -> Callable[[], float]:
    """Sum up the CPU seconds of an environment's steps from now on; return a function that tells the sum."""
    step, total = env.step, 0.0

    def timed() -> None:
        nonlocal total
        begin = time.process_time()
        step()
        total += time.process_time() - begin

    env.step = timed
    return lambda: total


# ---- two players, and training


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
    rates = {n: [a / w for a, w in zip(r.agents_per_step, r.wall_us)] for n, r in rows.items()}
    costs = {n: [w / a for a, w in zip(r.agents_per_step, r.cpu_us)] for n, r in rows.items()}
    print(
        f"\ntwo players against one: {median_ratio(rates[2], rates[1]):.2f} times the agent steps/s; "
        f"trainer's CPU an agent step {median_ratio(costs[2], costs[1]):.2f} times"
    )
    for row in rows.values():
        row.env.close()


def train(cfg: Config, arguments: argparse.Namespace, folder: Path) -> None:
    """Train until the mean return over a full window reaches the goal."""
    with set_up(cfg, folder / "train") as setup, setup.collecting() as batches:
        state = RunState(cfg, folder / "train", setup)
        pid = env_of(setup).base_env.player.process.pid
        wall, cpu, player = time.perf_counter(), time.process_time(), cpu_s(pid)
        while state.agent_steps < cfg.max_steps and not state.recent_episodes.reached(arguments.goal):
            started = time.perf_counter()
            batch = next(batches)
            collected = time.perf_counter()
            setup.learn(batch, state.agent_steps / cfg.max_steps)
            state.count(batch, collected - started, time.perf_counter() - collected)
        wall_s, cpu_used = time.perf_counter() - wall, time.process_time() - cpu
        player_used = cpu_s(pid) - player
    print(
        "\ntraining with the preset's options to a mean return of "
        f"{state.recent_episodes.summary()['return_mean']:.1f}: {state.agent_steps:,} agent steps, "
        f"{wall_s:.1f} s, {state.agent_steps / wall_s:,.0f} agent steps/s"
    )
    print(
        f"  CPU: trainer {cpu_used:.1f} s, player {player_used:.1f} s: "
        f"{state.agent_steps / (cpu_used + player_used):,.0f} agent steps/s with a core for each"
    )


def cpu_of(call: Callable[[], Any], times: int) -> float:
    """Return a call's CPU microseconds, after ten calls to warm up."""
    for _ in range(10):
        call()
    begin = time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - begin) / times * 1e6


def cpu_s(pid: int) -> float:
    """Return the CPU seconds of another process (Linux; 0 elsewhere), to 10 ms."""
    stat = Path(f"/proc/{pid}/stat")
    if not stat.exists():
        return 0.0
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def median_ratio(above: list[float], below: list[float]) -> float:
    """Return the median of the ratios of measurements taken in turns."""
    return statistics.median(a / b for a, b in zip(above, below))


if __name__ == "__main__":
    run_script(main)
