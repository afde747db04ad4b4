"""DungeonEscape: kill the dragon with one of three agents, take its key, unlock the door together.

Facts: docs/scenes/DungeonEscape.md. This module holds the rules: who touches what and what follows,
episodes, groups and observations; bodies are in `room.py`, rays in `sight.py`.
Legend: N areas, A = 3 agents of an area, S = N * A slots.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.seven_actions import ACTIONS
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.dungeon_escape.layout import DRAGON, KEY, LOCK, NUM_AGENTS, PORTAL
from mappo_unity.scenes.dungeon_escape.room import DungeonRoom
from mappo_unity.scenes.dungeon_escape.sight import EYES, see

TIME_LIMIT = 15_000  # ticks since the area's reset
DRAGON_SPEED = (1.0, 7.0)  # m/s, drawn at each reset


class DungeonEscape(Scene):
    """Run DungeonEscape; parameter `gravity` (m/s^2, downward)."""

    NAME = "DungeonEscape"
    DEFAULT_NUM_AREAS = 12
    BEHAVIORS = (
        Behavior(
            "DungeonEscape?team=0",
            (
                Sensor("RBSensor", (10,)),
                EYES.sensor("RayPerceptionSensor", stack=3),
                Sensor("VectorSensor_size1", (1,)),
            ),
            branches=(len(ACTIONS),),
        ),
    )
    AREA_BEHAVIORS = (0,) * NUM_AGENTS
    AREA_GROUPS = (0,) * NUM_AGENTS
    PARAMETERS = {"gravity": Parameter(1.5 * 9.81, at_once=True)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.room = DungeonRoom(self.num_areas, self.parameters["gravity"])
        self.enabled = self.agents.enabled.reshape(self.num_areas, NUM_AGENTS)  # a view
        self.slots = np.arange(self.num_slots).reshape(self.num_areas, NUM_AGENTS)

        self.has_key = np.zeros((self.num_areas, NUM_AGENTS), bool)
        self.at_lock = np.zeros((self.num_areas, NUM_AGENTS), bool)  # touched the lock in the last tick
        self.remaining = np.full(self.num_areas, NUM_AGENTS)  # neither killed nor gone through the portal
        self.timer = np.zeros(self.num_areas, np.int64)  # ticks since the area's reset

        self._groups = self.home_groups()

    def reset(self) -> None:
        """Reset every area, then the academy (whose reset leaves the areas as they are in Unity)."""
        self._check_open()
        self._reset_areas(np.arange(self.num_areas))
        super().reset()

    def begin_episode(self, slots: np.ndarray) -> None:
        """Take the key from the agents; all else belongs to the area's reset."""
        self.has_key.ravel()[slots] = False

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return velocity in the agent's frame (and a constant pose), one frame of rays, the key flag."""
        body = np.zeros((len(slots), 10), np.float32)
        body[:, :3] = self.room.local_velocity(slots)
        body[:, 9] = 1.0  # the pose relative to the agent itself: no offset, no rotation

        return [
            body,
            see(self.room, slots, self.enabled),
            self.has_key.reshape(-1, 1)[slots].astype(np.float32),
        ]

    def act(self, slots: np.ndarray) -> None:
        """Turn the agents and set their changes of velocity."""
        ahead, right, turn = ACTIONS[self.agents.discrete[:, 0]].T  # disabled agents hold action 0
        self.room.push(ahead, right, turn)

    def controllers(self) -> None:
        """Count the areas' time and interrupt groups at its limit."""
        self.timer += 1
        late = self.timer >= TIME_LIMIT
        if late.any():
            self._end_groups(np.flatnonzero(late), interrupted=True)

    def simulate(self) -> None:
        """Move all bodies by one tick, then let touches act: key, dragon, lock, portal."""
        touching = self.room.step()
        escaped = self.room.dragon_escapes()
        at_lock = touching[:, :, LOCK]
        entered = at_lock & ~self.at_lock
        self.at_lock = at_lock
        if not (touching[:, :, PORTAL : KEY + 1].any() or entered.any() or escaped.any()):
            return

        taken = _first(touching[:, :, KEY])
        self.has_key |= taken
        self.room.present[:, KEY] &= ~taken.any(axis=1)

        self._kill(_first(touching[:, :, DRAGON]))

        unlocked = entered & self.has_key
        self.has_key &= ~unlocked  # the key is used up before the episode's last record
        self._unlock(np.any(unlocked, axis=1))

        self._enter_portal(touching[:, :, PORTAL])
        # Where the area was reset in this tick (timer 0), the dragon that escaped is gone.
        escaped &= self.room.present[:, DRAGON] & (self.timer > 0)
        self._end_groups(np.flatnonzero(escaped))

        self.room.refresh(self.enabled)

    def parameter_changed(self, name: str) -> None:
        """Apply gravity at once."""
        self.room.gravity = self.parameters["gravity"]

    def pass_time(self, share: np.ndarray) -> None:
        """Set the areas' timers."""
        self.timer[:] = share * TIME_LIMIT

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies and the areas' rules' state."""
        names = ("has_key", "at_lock", "remaining", "timer")
        return {"room": self.room.get_state(), **{name: getattr(self, name).copy() for name in names}}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        self.room.gravity = self.parameters["gravity"]
        self.room.set_state(state["room"])
        self.room.refresh(self.enabled)
        for name in ("has_key", "at_lock", "remaining", "timer"):
            getattr(self, name)[...] = state[name]

    def _kill(self, victim: np.ndarray) -> None:
        """Let the dragon and the agents that touched it vanish; bool [N, A], at most one an area."""
        areas, agents = np.nonzero(victim)
        if areas.size:
            self.room.present[areas, DRAGON] = False
            self.remaining[areas] -= 1
            self.disable(self.slots[areas, agents])
            self.room.bury(areas, agents)

    def _unlock(self, areas: np.ndarray) -> None:
        """Reward all who are still there, end the group's episode; `areas` bool [N]."""
        if areas.any():
            self.add_group_reward(self.slots[areas].ravel(), 1.0)
            self._end_groups(np.flatnonzero(areas))

    def _enter_portal(self, entered: np.ndarray) -> None:
        """Let agents leave one by one; the last one, or the holder of the key, ends the group's episode.

        `entered` bool [N, A]; areas that were reset in this tick (timer 0) have nobody at the portal.
        """
        for agent in range(NUM_AGENTS if entered.any() else 0):
            there = entered[:, agent] & self.enabled[:, agent] & (self.timer > 0)
            areas = np.flatnonzero(there)
            self.remaining[areas] -= 1
            ends = (self.remaining[areas] == 0) | self.has_key[areas, agent]
            self.disable(self.slots[areas[~ends], agent])
            self._end_groups(areas[ends])

    def _end_groups(self, areas: np.ndarray, interrupted: bool = False) -> None:
        """End the groups' episodes without a further reward and reset their areas [n]."""
        if areas.size:
            self.end_episode(self.slots[areas].ravel(), interrupted)
            self._reset_areas(areas)

    def _reset_areas(self, areas: np.ndarray) -> None:
        """Begin the areas anew: agents placed and enabled, dragon at its start; key, tombstone hidden."""
        self.timer[areas] = 0
        self.remaining[areas] = NUM_AGENTS
        self.at_lock[areas] = False
        self.has_key[areas] = False

        # Before they are enabled again: those still enabled are in the way of new spots.
        self.room.reset(areas, self.rng, self.enabled, DRAGON_SPEED)

        slots = self.slots[areas].ravel()
        self.enable(slots, self._groups[slots])
        self.room.refresh(self.enabled)


def _first(mask: np.ndarray) -> np.ndarray:
    """Return bool [N, A]: only the first True of each row."""
    return mask & (mask.cumsum(axis=1) == 1)
