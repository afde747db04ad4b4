"""Which member of its team each agent is, for policies with a network for each member.

In: ids of agents and of their groups, as they request decisions, and who has ended. Out: places among teams.
As in training (`envs.slots`) an agent keeps its place until it has ended *and* a new one needs the place.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mappo_unity.errors import ConfigError


class Places(NamedTuple):
    """Where each row of a result stands among the teams."""

    teams: np.ndarray  # int [n]
    members: np.ndarray  # int [n]
    shape: tuple[int, int]  # G, A


def team_places(group_id: np.ndarray, team_size: int | None = None) -> Places:
    """Give each row its team and its place in it: the order of the rows of a group.

    Members that are not asked at the same time are not told apart by this, which matters to policies with a
    network for each member alone (`MemberTable`).

    Args:
        group_id: int ``[n]``, 0 = alone.
        team_size: places of a team; None: as many as the largest one needs.

    Raises:
        ConfigError: a team is larger.
    """
    # Group 0 is none: each of its agents is a team of its own, numbered after the groups.
    alone = np.arange(len(group_id)) + int(group_id.max(initial=0)) + 1
    keys_ = np.where(group_id > 0, group_id, alone)
    _, teams = np.unique(keys_, return_inverse=True)

    # Stable, so that the members of a team keep the order of their rows.
    order = np.argsort(teams, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(teams[order]) > 0])
    members = np.empty(len(teams), np.int64)
    members[order] = np.arange(len(teams)) - np.repeat(starts, np.diff(np.r_[starts, len(teams)]))

    largest = int(members.max(initial=0)) + 1
    if team_size is not None and largest > team_size:
        raise ConfigError(f"a team of {largest} agents is larger than the policy's {team_size} members")

    return Places(teams, members, (int(teams.max(initial=-1)) + 1, team_size or largest))


class MemberTable:
    """The members of one behavior's teams, as long as they play.

    Args:
        team_size: A, the places of a team.
    """

    def __init__(self, team_size: int) -> None:
        self.team_size = team_size
        self._teams: dict[int, list[int]] = {}  # group: its agents, in their places
        self._ended: set[int] = set()
        self._asked_at: dict[int, int] = {}  # agent: when it asked last
        self._now = 0

    def end(self, agent_ids: Iterable[int]) -> None:
        """Take note that episodes of these agents have ended: their places may be given away."""
        self._ended.update(agent for agent in map(int, agent_ids) if agent in self._asked_at)

    def places(self, agent_ids: np.ndarray, group_ids: np.ndarray) -> Places:
        """Return the places of these agents, giving some to the new ones.

        Args:
            agent_ids: int ``[n]``; group_ids: int ``[n]``, 0 = alone.

        Raises:
            ConfigError: a team is larger than the policy's.
        """
        # the rows tell which teams there are, and that none is too large
        by_rows = team_places(group_ids, self.team_size)
        members = np.zeros(len(agent_ids), np.int64)

        self._now += 1
        rows = list(zip(agent_ids.tolist(), group_ids.tolist()))
        # all of them first: nobody who asks now loses its place to another who does
        for agent, group in rows:
            if group > 0:
                self._asked_at[agent] = self._now
                self._ended.discard(agent)

        for row, (agent, group) in enumerate(rows):
            members[row] = self._place(agent, group) if group > 0 else 0

        return by_rows._replace(members=members)

    def _place(self, agent: int, group: int) -> int:
        team = self._teams.setdefault(group, [])
        if agent in team:
            return team.index(agent)
        if len(team) < self.team_size:
            team.append(agent)
            return len(team) - 1

        # who has ended goes first, then (whoever plays may tell of no ends) who has not asked for longest
        ended = [a for a in team if a in self._ended]
        leaver = ended[0] if ended else min(team, key=lambda a: self._asked_at.get(a, 0))
        place = team.index(leaver)

        team[place] = agent
        self._ended.discard(leaver)
        self._asked_at.pop(leaver, None)
        return place
