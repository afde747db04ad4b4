"""Slots of one behavior: which row of the batch holds which agent.

Slots are flat numbers ``team * A + member``. Agents of one group share a team; an agent without a group is a
team of its own. A slot belongs to its agent until the agent has ended *and* somebody else needs the place, so
an agent that begins its next episode under its old id keeps its slot; or until the agent changes its group.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.errors import ConfigError

FREE = -(2**62)  # no agent id, no team key
NOBODY = np.zeros(0, np.int64)


class SlotTable:
    """Assign agents to ``num_teams x team_size`` slots (G x A)."""

    def __init__(self, behavior: str, num_teams: int, team_size: int) -> None:
        self.behavior = behavior
        self.num_teams, self.team_size = num_teams, team_size
        self.agent_id = np.full(num_teams * team_size, FREE, np.int64)
        self.ended = np.ones(num_teams * team_size, bool)
        self.team_key = np.full(num_teams, FREE, np.int64)
        self._slot_of: dict[int, int] = {}

        # mostly the same agents request decisions in the same order again: these skip the look-ups
        self._last_ids = self._last_groups = self._last_slots = NOBODY

        self.movers = self.left = NOBODY  # of the last `assign`: places in it, and slots that these left

    def assign(self, agent_ids: np.ndarray, group_ids: np.ndarray) -> np.ndarray:
        """Return the slots of these agents, giving places to those that are new or have changed their group.

        `movers` says which of them changed it during an episode, `left` which slots these had before.

        Args:
            agent_ids: int ``[n]``; group_ids: int ``[n]``, 0 = alone.

        Returns:
            int64 ``[n]``, flat slots.

        Raises:
            ConfigError: no slot is left for a new agent or team.
        """
        same_agents = np.array_equal(agent_ids, self._last_ids)
        if same_agents and np.array_equal(group_ids, self._last_groups):
            if len(self.movers):
                self.movers = self.left = NOBODY
            return self._last_slots

        # an agent without a group is a team by itself; its key is negative, as no group's is
        keys = np.where(group_ids > 0, group_ids, -1 - agent_ids.astype(np.int64))
        slots = self.lookup(agent_ids)
        self._leave_teams(agent_ids, slots, keys)

        new = np.flatnonzero(slots < 0).tolist()
        if new:
            # whoever begins its next episode in this result keeps its slot from the new ones
            self.ended[slots[slots >= 0]] = False
        for row in new:
            slots[row] = self._place(int(agent_ids[row]), int(group_ids[row]), int(keys[row]))

        self._last_ids, self._last_groups = agent_ids.astype(np.int64), group_ids.astype(np.int64)
        self._last_slots = slots
        return slots

    def lookup(self, agent_ids: np.ndarray) -> np.ndarray:
        """Return the slots of these agents, -1 for those that hold none."""
        return np.array([self._slot_of.get(agent, -1) for agent in agent_ids.tolist()], np.int64)

    def agents_of(self, slots: np.ndarray) -> list[int]:
        """Return the ids of the agents that hold these slots."""
        return self.agent_id[slots].tolist()

    def _leave_teams(self, agent_ids: np.ndarray, slots: np.ndarray, keys: np.ndarray) -> None:
        """Take from agents of another team the slots that they hold; in `slots` they hold none then."""
        away = (slots >= 0) & (self.team_key[slots // self.team_size] != keys)
        self.movers = np.flatnonzero(away)
        self.left = slots[self.movers]
        if not len(self.movers):
            return

        # all of them before the first finds its place: teams may exchange members
        slots[self.movers] = -1
        for agent in agent_ids[self.movers].tolist():
            del self._slot_of[agent]

        # who has ended begins anew elsewhere, and moves nothing
        during = ~self.ended[self.left]
        self.agent_id[self.left] = FREE
        self.ended[self.left] = True
        self.movers, self.left = self.movers[during], self.left[during]

    def _place(self, agent: int, group: int, key: int) -> int:
        team = self._team(key, agent)
        members = slice(team * self.team_size, (team + 1) * self.team_size)

        # slots never used come first, so that an ended agent keeps its own as long as there is room
        empty = np.flatnonzero(self.agent_id[members] == FREE)
        left = empty if len(empty) else np.flatnonzero(self.ended[members])

        if not len(left):
            raise ConfigError(
                f"behavior {self.behavior!r}: agent {agent} is one more than the {self.team_size} slots of "
                f"its team (group {group}); give room with env.max_team_size={self.team_size + 1} or more (a "
                "member makes room with its terminal step)"
            )

        slot = team * self.team_size + int(left[0])
        # who held the slot has ended, and gets another one should it come back
        self._slot_of.pop(int(self.agent_id[slot]), None)
        self._slot_of[agent] = slot
        self.agent_id[slot] = agent
        self.ended[slot] = False

        # the slots of the last ids may have changed hands
        self._last_ids = NOBODY
        return slot

    def _team(self, key: int, agent: int) -> int:
        known = np.flatnonzero(self.team_key == key)
        if len(known):
            return int(known[0])

        # teams never used come first, then those whose members have all ended
        free = np.flatnonzero(self.team_key == FREE)
        if not len(free):
            ended = self.ended.reshape(self.num_teams, self.team_size).all(1)
            free = np.flatnonzero(ended)
        if not len(free):
            raise ConfigError(
                f"behavior {self.behavior!r}: agent {agent} begins one more team than the {self.num_teams} "
                f"team slots; give room with env.max_teams={self.num_teams + 1} or more (a team makes room "
                "with the terminal steps of its members)"
            )

        team = int(free[0])
        members = slice(team * self.team_size, (team + 1) * self.team_size)
        for old in self.agent_id[members].tolist():
            self._slot_of.pop(old, None)
        self.agent_id[members] = FREE
        self.ended[members] = True

        self.team_key[team] = key
        return team

    def get_state(self) -> dict:
        """Return everything that `set_state` needs."""
        return {
            "agent_id": self.agent_id.copy(),
            "ended": self.ended.copy(),
            "team_key": self.team_key.copy(),
        }

    def set_state(self, state: dict) -> None:
        """Go back to a state that `get_state` returned."""
        self.agent_id = np.array(state["agent_id"], np.int64)
        self.ended = np.array(state["ended"], bool)
        self.team_key = np.array(state["team_key"], np.int64)

        # what follows from the arrays is made anew
        self._slot_of = {int(a): s for s, a in enumerate(self.agent_id.tolist()) if a != FREE}
        self._last_ids = self._last_groups = self._last_slots = NOBODY


def count_teams(agent_ids: np.ndarray, group_ids: np.ndarray) -> tuple[int, int]:
    """Return how many teams these agents form and how large the largest is."""
    groups, counts = np.unique(group_ids[group_ids > 0], return_counts=True)
    alone = int((group_ids <= 0).sum())
    return max(1, len(groups) + alone), max(1, int(counts.max(initial=1)))
