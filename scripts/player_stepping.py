"""Environments stepped with random actions, ours and ML-Agents' client of a player, and what they cost."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mappo_unity.config.schema import Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError

from mlagents_envs.base_env import BaseEnv  # isort: skip  # mappo_unity lets it import

TICK_S = 1 / os.sysconf("SC_CLK_TCK")
PORTS = range(6005, 6105)


class Stepping:
    """Step an environment with random actions, again and again.

    Args:
        env: what is stepped.
        pid: of its player's process; None where there is none.

    Attributes: of each measurement `wall_us`, `cpu_us` and `player_us`, microseconds a step of the clock, of
    this process and of the player's, and `agents_per_step`.
    """

    def __init__(self, env: BaseEnv, pid: int | None) -> None:
        self.env, self.pid = env, pid
        self.wall_us: list[float] = []
        self.cpu_us: list[float] = []
        self.player_us: list[float] = []
        self.agents_per_step: list[float] = []
        env.reset()

    def measure(self, steps: int) -> None:
        """Take one measurement more."""
        wall, cpu, player = time.perf_counter(), time.process_time(), self._player_s()
        agents = sum(self._step() for _ in range(steps))

        self.wall_us.append((time.perf_counter() - wall) / steps * 1e6)
        self.cpu_us.append((time.process_time() - cpu) / steps * 1e6)
        self.player_us.append((self._player_s() - player) / steps * 1e6)
        self.agents_per_step.append(agents / steps)

    def rates(self) -> list[float]:
        """Return the agent steps a second of each measurement."""
        return [a / w * 1e6 for a, w in zip(self.agents_per_step, self.wall_us)]

    def line(self) -> str:
        """Return medians as columns."""
        return (
            f"{statistics.median(self.rates()):15,.0f}{statistics.median(self.wall_us):12.0f}"
            f"{statistics.median(self.cpu_us):13.0f}{statistics.median(self.player_us):12.0f}"
        )

    def _step(self) -> int:
        """Step once; return how many agents acted."""
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


def mlagents_client(cfg: Config) -> Stepping:
    """Return ML-Agents' own client on the same player, on the first port that is free."""
    from mlagents_envs.environment import UnityEnvironment
    from mlagents_envs.exception import UnityWorkerInUseException

    areas = cfg.env.num_areas or 1
    for port in PORTS:
        try:
            env = UnityEnvironment(cfg.env.file_name, base_port=port, num_areas=areas, no_graphics=True)
        except UnityWorkerInUseException:
            continue
        return Stepping(env, env._process.pid)
    raise ConfigError(f"no port from {PORTS[0]} to {PORTS[-1]} is free for UnityEnvironment")


def our_client(cfg: Config) -> Stepping:
    """Return the client of this project on the same player."""
    env: Any = make_env_function(cfg.env)(0)
    return Stepping(env, env.player.process.pid)


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

    # the name, in brackets, may hold blanks; behind it user and system time are the 12th and 13th
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S


def median_ratio(above: list[float], below: list[float]) -> float:
    """Return the median of the ratios of measurements taken in turns."""
    return statistics.median(a / b for a, b in zip(above, below))
