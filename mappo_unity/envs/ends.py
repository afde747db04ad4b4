"""What `next` says of slots whose episode ended in a round, whoever has taken them since.

There an ended slot is still present, and a team mate of it that had departed still departed: what a critic
needs to judge the last moment of an episode that was cut off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class End(NamedTuple):
    """Slots that ended, with what is said of them."""

    rows: np.ndarray  # int64 [n], slots
    observations: list[np.ndarray]  # [n, *shape] of every sensor
    departed: bool


class RoundEnds:
    """The ends of one round."""

    def __init__(self) -> None:
        self._ends: list[End] = []
        self._departures: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def playing(self, rows: np.ndarray, observations: list[np.ndarray]) -> None:
        """Note agents that ended as they played, with their terminal observations (kept as they are)."""
        self._ends.append(End(rows, observations, departed=False))

    def departing(self, rows: np.ndarray, observations: list[np.ndarray]) -> None:
        """Note members that depart; their slots go on."""
        self._departures.append((rows, observations))

    def departed(self, rows: np.ndarray, shapes: list[tuple[int, ...]]) -> None:
        """Note members that ended with their team after they had departed: they saw zeros."""
        zeros = [np.zeros((len(rows), *shape), np.float32) for shape in shapes]
        self._ends.append(End(rows, zeros, departed=True))

    def returning(self, rows: np.ndarray, shapes: list[tuple[int, ...]]) -> np.ndarray:
        """Note members that departed and begin anew before their team has ended.

        Returns:
            bool ``[n]``, those that departed in this very round.
        """
        self.departed(rows, shapes)

        # who departed in this very round has its terminal observation in it
        just_left = np.zeros(len(rows), bool)
        for slots, observations in self._departures:
            back = np.isin(slots, rows)
            self.playing(slots[back], [o[back] for o in observations])
            just_left |= np.isin(rows, slots)
        return just_left

    def write(self, obs: list[np.ndarray], present: np.ndarray, departed: np.ndarray) -> None:
        """Write what was noted into observations ``[N, *shape]`` and flags ``[N]``."""
        for end in self._ends:
            present[end.rows] = True
            departed[end.rows] = end.departed
            for own, new in zip(obs, end.observations):
                own[end.rows] = new
