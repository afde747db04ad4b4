"""Figures about finished episodes and collected batches, as dicts of floats."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from mappo_unity.envs.rounds import Episode


class RecentEpisodes:
    """The newest finished episodes of every behavior.

    Attributes: `total`, of the run; `early`, how many are still to end before the window counts.
    """

    def __init__(self, size: int, behaviors: list[str]) -> None:
        self.size = size
        self.total = self.early = 0
        self.recent: dict[str, deque[tuple[float, float, int]]] = {b: deque(maxlen=size) for b in behaviors}

    def add(self, episodes: dict[str, list[Episode]]) -> int:
        """Take finished episodes in; return how many there were."""
        count = 0
        for behavior, finished in episodes.items():
            for episode in finished:
                # an episode without a decision says nothing about the policy
                if episode.length:
                    row = (episode.individual_return, episode.group_return, episode.length)
                    self.recent[behavior].append(row)
                    count += 1

        self.total += count
        self.early = max(0, self.early - count)
        return count

    def begin_anew(self) -> None:
        """Empty the window, as a lesson has changed; the total stays.

        The next episodes to end, as many as the window holds twice, began before the change or are the short
        ones among those that began after it: no sample of the new lesson until the first half has left again.
        """
        for rows in self.recent.values():
            rows.clear()
        self.early = 2 * self.size

    @property
    def full(self) -> bool:
        """Whether every behavior has as many episodes as the window holds, and none is an early one."""
        return not self.early and all(len(rows) == self.size for rows in self.recent.values())

    def reached(self, goal: float) -> bool:
        """Return whether the mean return over a full window is at least `goal`."""
        return self.full and self.summary()["return_mean"] >= goal

    def score(self) -> float:
        """Return the mean return, or minus infinity while fewer episodes have ended than the window holds.

        The first to end are no sample: where success ends an episode, they are those that met it by luck.
        """
        counts = not self.early and len(self._rows()) >= self.size
        return self.summary()["return_mean"] if counts else -math.inf

    def standard_error(self, team_sizes: Mapping[str, int]) -> float:
        """Return that of the mean return, 0 of no episodes; a team earns much the same and counts once.

        Args:
            team_sizes: agents of a team of each behavior.
        """
        count = sum(len(rows) / team_sizes[behavior] for behavior, rows in self.recent.items())
        return self.summary()["return_std"] / math.sqrt(count) if count else 0.0

    def summary(self) -> dict[str, float]:
        """Return means over the window, over all behaviors and, if several, for each of them.

        A return is the individual and the group reward of an agent's episode.
        """
        out = _summary("", self._rows())

        if len(self.recent) > 1:
            for behavior, rows in self.recent.items():
                out |= _summary(f"{behavior}/", list(rows))

        return out

    def _rows(self) -> list[tuple[float, float, int]]:
        return [row for rows in self.recent.values() for row in rows]

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs."""
        return {
            "total": self.total,
            "early": self.early,
            "recent": {b: [list(r) for r in rows] for b, rows in self.recent.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what `state_dict` returned."""
        self.total, self.early = int(state["total"]), int(state.get("early", 0))  # since 0.3
        for behavior, rows in state["recent"].items():
            self.recent[behavior] = deque(((r[0], r[1], int(r[2])) for r in rows), maxlen=self.size)


def _summary(prefix: str, rows: list[tuple[float, float, int]]) -> dict[str, float]:
    if not rows:
        names = ("return_mean", "return_std", "group_return_mean", "episode_length_mean")
        return {f"{prefix}{name}": float("nan") for name in names}

    individual, group, length = (np.array(column, float) for column in zip(*rows))
    returns = individual + group
    return {
        f"{prefix}return_mean": float(returns.mean()),
        f"{prefix}return_std": float(returns.std()),
        f"{prefix}group_return_mean": float(group.mean()),
        f"{prefix}episode_length_mean": float(length.mean()),
    }


def by_policy(metrics: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return learning metrics of all policies: plain names for one, ``Name/metric`` for several.

    With several the plain names hold the mean, so that every run has the same first columns.
    """
    if len(metrics) == 1:
        return dict(next(iter(metrics.values())))

    names = list(dict.fromkeys(name for row in metrics.values() for name in row))
    out = {name: float(np.mean([row[name] for row in metrics.values() if name in row])) for name in names}

    for policy, row in metrics.items():
        out |= {f"{policy}/{name}": value for name, value in row.items()}

    return out
