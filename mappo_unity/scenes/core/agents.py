"""The agents of all areas as arrays: who is enabled, their ids, groups, rewards, counters and actions.

A *slot* is the place of an agent object: slot = area * (agents of an area) + its number in the area. A slot
keeps its place for good; its agent id changes when the object is disabled and enabled again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

_ARRAYS = (
    "enabled",
    "agent_id",
    "group_id",
    "behavior",
    "done",
    "step_count",
    "reward",
    "group_reward",
    "continuous",
    "discrete",
)


class Agents:
    """Keep the state that the ML-Agents framework holds for every agent, in arrays by slot.

    Attributes (S slots): `enabled` bool [S]; `agent_id`, `group_id` int32 [S]; `behavior` int64 [S], an
    index into the scene's behaviors; `done` bool [S]: ended since its last decision; `step_count` int64
    [S]: ticks since its episode began; `reward`, `group_reward` float32 [S]: since its last decision;
    `continuous` float32 [S, C], `discrete` int32 [S, K]: the stored action; zeros after an end, and from
    an exchange with Python on until it sets another.
    """

    def __init__(
        self,
        behavior: np.ndarray,
        group_id: np.ndarray,
        num_behaviors: int,
        num_continuous: int,
        num_branches: int,
    ) -> None:
        num_slots = len(behavior)
        self.enabled = np.ones(num_slots, bool)
        self.agent_id = np.arange(num_slots, dtype=np.int32)
        self.group_id = group_id.astype(np.int32)
        self.behavior = behavior.astype(np.int64)
        self.done = np.zeros(num_slots, bool)
        self.step_count = np.zeros(num_slots, np.int64)

        # What the next record and the next tick take.
        self.reward = np.zeros(num_slots, np.float32)
        self.group_reward = np.zeros(num_slots, np.float32)
        self.continuous = np.zeros((num_slots, num_continuous), np.float32)
        self.discrete = np.zeros((num_slots, num_branches), np.int32)

        self.next_id = num_slots
        self._num_behaviors = num_behaviors
        self._one_tick = np.ones(num_slots, np.int64)  # numpy adds arrays of one shape fastest

        # Looked up at every tick, made anew only after somebody comes, goes or moves.
        self._order: np.ndarray | None = None
        self._is_slot_order = False
        self._members: list[np.ndarray] | None = None

    @property
    def order(self) -> np.ndarray:
        """Return the slots of enabled agents by ascending agent id, the order of rows in Python."""
        if self._order is None:
            slots = self.enabled.nonzero()[0]
            self._order = slots[self.agent_id[slots].argsort(kind="stable")]
            everyone = len(slots) == len(self.enabled)
            self._is_slot_order = everyone and not np.count_nonzero(self._order - slots)
        return self._order

    @property
    def members(self) -> list[np.ndarray]:
        """Return the slots of each behavior's enabled agents by ascending agent id."""
        if self._members is None:
            behavior = self.behavior[self.order]
            several = self._num_behaviors > 1
            self._members = (
                [self.order[behavior == i] for i in range(self._num_behaviors)] if several else [self.order]
            )
        return self._members

    def enabled_slots(self, slots: np.ndarray) -> np.ndarray:
        """Return those of `slots` (integers, or a mask over all slots) whose agents are enabled."""
        slots = as_slots(slots)
        return slots[self.enabled[slots]]

    def count_tick(self) -> None:
        """Count one tick of every agent's episode."""
        self.step_count = self.step_count + self._one_tick

    def store_actions(self, slots: np.ndarray, continuous: np.ndarray, discrete: np.ndarray) -> None:
        """Store the actions of `slots`, one row each; columns that their behavior lacks stay."""
        # Everybody in the order of slots is the common case, and a slice is faster than indices.
        rows = slice(None) if slots is self._order and self._is_slot_order else slots
        if continuous.shape[1]:
            self.continuous[rows, : continuous.shape[1]] = continuous
        if discrete.shape[1]:
            self.discrete[rows, : discrete.shape[1]] = discrete

    def finish(self, slots: np.ndarray) -> None:
        """Clear rewards and actions after a terminal record, and remember that the agent has ended."""
        self.done[slots] = True
        self.reward[slots] = 0
        self.group_reward[slots] = 0
        self.clear_actions(slots)

    def clear_actions(self, slots: np.ndarray) -> None:
        """Forget the stored actions of `slots` (none twice): zeros are executed until others are stored."""
        if len(slots) == len(self.enabled):
            self.continuous.fill(0)
            self.discrete.fill(0)
        else:
            self.continuous[slots] = 0
            self.discrete[slots] = 0

    def disable(self, slots: np.ndarray) -> None:
        """Take agents out of the scene and out of their groups."""
        self.enabled[slots] = False
        self.group_id[slots] = 0
        self._forget_order()

    def enable(self, slots: np.ndarray, group_ids: np.ndarray | int) -> None:
        """Bring agents back under the next free ids, in the order of `slots`."""
        self.enabled[slots] = True
        self.agent_id[slots] = np.arange(self.next_id, self.next_id + len(slots))
        self.next_id += len(slots)
        self.group_id[slots] = group_ids
        self.done[slots] = False
        self.step_count[slots] = 0
        self.clear_actions(slots)
        self._forget_order()

    def move(self, slots: np.ndarray, behavior: np.ndarray | int) -> None:
        """Put agents under another behavior (an index, or one a slot)."""
        self.behavior[slots] = behavior
        self._forget_order()

    def get_state(self) -> dict[str, Any]:
        """Return copies of all arrays, and the next free id."""
        return {**{name: getattr(self, name).copy() for name in _ARRAYS}, "next_id": self.next_id}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        for name in _ARRAYS:
            getattr(self, name)[...] = state[name]
        self.next_id = state["next_id"]
        self._forget_order()

    def _forget_order(self) -> None:
        self._order = None
        self._members = None


def as_slots(slots: np.ndarray) -> np.ndarray:
    """Return slots as integers, whether they are integers or a mask bool over all slots."""
    slots = np.asarray(slots)
    return np.flatnonzero(slots) if slots.dtype == bool else slots.reshape(-1)
