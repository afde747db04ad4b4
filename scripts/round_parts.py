"""A round of collecting from a player, part by part: player, decoding, adapter, policy, transport."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from player_stepping import cpu_of, cpu_s, median_ratio, mlagents_client

from mappo_unity.config.schema import Config
from mappo_unity.envs.transforms import transformed
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.protocol import decode, messages
from mappo_unity.protocol.serve import Player, env_function
from mappo_unity.training.collection.batches import Batch, count_decisions
from mappo_unity.training.setup import TrainingSetup, set_up


class Whole(NamedTuple):
    """A round as a whole: microseconds of the clock, of this process and the player's; agents that acted."""

    wall_us: float
    cpu_us: float
    player_us: float
    agents: float


def print_parts(cfg: Config, scene: str, repeats: int, steps: int, folder: Path) -> None:
    """Print what a round costs in player, transport, decoding, adapter and policy, CPU microseconds.

    Args:
        cfg: the scene's options, with its player.
        repeats: measurements, the median of which is printed.
        steps: environment steps of one measurement.
        folder: of the run.
    """
    whole, of_bare, policy_us = collecting(cfg, repeats, steps, folder)
    data, output_us = player_message(scene, cfg, steps)
    decode_us, adapter_us = decoding(data, steps), adapter(scene, cfg, steps)

    wall_us, cpu_us, player_us, agents = whole
    print(f"\na round of collecting {scene}: {agents:.1f} agents act, {wall_us:.0f} us")
    for name, rate, what in (
        ("end to end", f"{agents / wall_us * 1e6:,.0f}", "agent steps/s"),
        ("against bare stepping", f"{of_bare:.2f}", "of ML-Agents' agent steps/s"),
        ("with a core for each", f"{agents / (cpu_us + player_us) * 1e6:,.0f}", "agent steps/s (sum of CPU)"),
    ):
        print(f"  {name:26s}{rate:>10s} {what}")

    rest_us = cpu_us - decode_us - adapter_us - policy_us
    for name, part_us, what in (
        ("player process", player_us, f"scene and its messages alone {output_us:.0f}"),
        ("decoding a message", decode_us, f"{len(data):,} bytes"),
        ("adapter", adapter_us, "with transforms, less the scene's steps"),
        ("policy", policy_us, "a forward pass, actions drawn"),
        ("transport and collector", rest_us, f"what remains of the trainer's {cpu_us:.0f}"),
    ):
        print(f"  {name:26s}{part_us:10.0f} us CPU ({what})")


def collecting(cfg: Config, repeats: int, steps: int, folder: Path) -> tuple[Whole, float, float]:
    """Collect in turns with ML-Agents' bare client.

    Returns:
        A round as a whole, medians; its agent steps a second as a part of those of the bare client; and what
        the policy costs a round, CPU us.
    """
    bare = mlagents_client(cfg)
    with set_up(cfg, folder) as setup, setup.collecting() as batches:
        next(batches)

        rounds = []
        for _ in range(repeats):
            bare.measure(steps)
            rounds.append(measure(setup, batches))
        policy_us = policy(setup, steps)
    bare.env.close()

    rates = [whole.agents / whole.wall_us * 1e6 for whole in rounds]
    whole = Whole(*(statistics.median(column) for column in zip(*rounds)))
    return whole, median_ratio(rates, bare.rates()), policy_us


def measure(setup: TrainingSetup, batches: Iterator[Batch]) -> Whole:
    """Collect a batch; return what a round of it cost."""
    pid = player_pid(setup)
    wall, cpu, player = time.perf_counter(), time.process_time(), cpu_s(pid)
    batch = next(batches)
    rounds = batch.rounds.shape[0]

    return Whole(
        (time.perf_counter() - wall) / rounds * 1e6,
        (time.process_time() - cpu) / rounds * 1e6,
        (cpu_s(pid) - player) / rounds * 1e6,
        count_decisions(batch.rounds, setup.learners) / rounds,
    )


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


def player_pid(setup: TrainingSetup) -> int:
    """Return the number of the process that plays it."""
    base_env: Any = env_of(setup).base_env
    pid: int = base_env.player.process.pid
    return pid


def policy(setup: TrainingSetup, steps: int) -> float:
    """Return what the policy costs a round, CPU us."""
    observations = transformed(env_of(setup)).reset()
    with torch.no_grad():
        return cpu_of(lambda: setup.policy(observations.clone(recurse=False)), steps)


def adapter(scene: str, cfg: Config, steps: int) -> float:
    """Return what adapter and transforms add to a round, CPU us: embedded, less the scene's own steps."""
    make = env_function(scene, cfg.env.num_areas)
    env = UnityEnv(lambda seed: make(seed, None))
    seen = transformed(env)
    actions = seen.rand_action(seen.reset())

    inner_s = timed_steps(env.base_env)
    begin, inner = time.process_time(), inner_s()
    for _ in range(steps):
        seen.step_and_maybe_reset(actions.copy())
    own = time.process_time() - begin - (inner_s() - inner)
    return own / steps * 1e6


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
