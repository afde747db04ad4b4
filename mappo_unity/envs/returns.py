"""Returns and lengths of the episodes that a behavior's slots are in, and those that have finished."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Episode(NamedTuple):
    """A finished episode of one agent, as the environment reported it."""

    agent_id: int
    individual_return: float
    group_return: float
    length: int  # decisions
    interrupted: bool
    group_id: int = 0  # 0 = alone
    slot: int = -1  # of the behavior, in which it ended; -1: not told
    round: int = -1  # in which it ended, see `UnityEnv.rounds`; -1: not told


class Returns:
    """Count what the agents in N slots have earned; arrays are ``[N]``."""

    ARRAYS = ("individual_return", "group_return", "length")

    def __init__(self, count: int) -> None:
        self.individual_return = np.zeros(count)
        self.group_return = np.zeros(count)
        self.length = np.zeros(count, np.int64)
        self.round = -1  # the one that is played, which the environment counts
        self._finished: list[Episode] = []

    def add(self, slots: np.ndarray, reward: np.ndarray, group_reward: np.ndarray) -> None:
        """Count rewards: an episode's return has every one, a row only what its action earned."""
        self.individual_return[slots] += reward
        self.group_return[slots] += group_reward

    def move(self, old: np.ndarray, new: np.ndarray) -> None:
        """Let the episodes of some slots go on in others."""
        for name in self.ARRAYS:
            values = getattr(self, name)
            moved = values[old]  # a copy: teams may exchange members
            values[old] = 0
            values[new] = moved

    def finish(self, rows: np.ndarray, agents: list[int], interrupted: np.ndarray, drop: np.ndarray) -> None:
        """End the episodes of slots ``[n]``; those in `drop`, bool ``[N]``, are not reported."""
        for agent, slot, cut in zip(agents, rows.tolist(), interrupted.tolist()):
            if drop[slot]:
                continue
            returns = float(self.individual_return[slot]), float(self.group_return[slot])
            length = int(self.length[slot])
            self._finished.append(Episode(agent, *returns, length, bool(cut), slot=slot, round=self.round))

        self.individual_return[rows] = self.group_return[rows] = self.length[rows] = 0

    def pop(self) -> list[Episode]:
        """Return the episodes that finished since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def forget(self) -> None:
        """Begin anew: the episodes under way are cut, unreported."""
        self.individual_return[:] = self.group_return[:] = self.length[:] = 0

    def get_state(self) -> dict[str, np.ndarray]:
        """Return the arrays by name."""
        return {name: getattr(self, name).copy() for name in self.ARRAYS}

    def set_state(self, state: dict) -> None:
        """Go back to arrays that `get_state` returned, which may stand among others."""
        for name in self.ARRAYS:
            setattr(self, name, np.array(state[name], getattr(self, name).dtype))
