"""The bodies of DungeonEscape's areas: where they are, how they move, what they touch.

All coordinates are in the axes of the platform: nothing that an agent senses depends on the platform's
quarter turn, except where the dragon starts. Contacts between agents and things are in `contacts.py`.
Legend: N areas, A = 3 agents of an area, S = N * A slots, T = 5 things of an area, K = 7 touches.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S, box_gap, push_out, slide
from mappo_unity.scenes.dungeon_escape.contacts import Contacts, stop_at_walls
from mappo_unity.scenes.dungeon_escape.layout import (
    AGENT_HALF,
    COLUMN,
    COLUMN_BASE,
    DRAGON,
    DRAGON_START,
    DRAGON_START_Y,
    DRAGON_START_YAW,
    HALVES,
    KEY,
    KEY_OFFSET,
    LOCK,
    LOCK_CENTRE,
    NUM_AGENTS,
    NUM_THINGS,
    PORTAL,
    PORTAL_CENTRE,
    PORTAL_TARGET,
    PORTAL_YAW,
    TOMB,
    TOMB_DROP,
    TOMB_RISE,
)
from mappo_unity.scenes.dungeon_escape.spawn import draw_poses

DRAG_KEPT = 1.0 - 4.0 * TICK_S
DRAGON_DRAG_KEPT = 1.0 - 1.0 * TICK_S
STANDING = AGENT_HALF[1]  # m: height of an agent's centre on the floor
DRAGON_STANDING = HALVES[DRAGON, 1]
DRAGON_REACH = 0.85 + np.hypot(0.75, 0.75) + CONTACT_GAP  # of a column's base, along x and z

_STATE = (
    "position",
    "velocity",
    "yaw",
    "thing",
    "thing_yaw",
    "present",
    "dragon_fall",
    "dragon_speed",
    "_dragon_way",
)


class DungeonRoom:
    """Keep the bodies of all areas in arrays.

    Agents: `position`, `velocity` [S, 3] (m, m/s), `yaw` [S] (rad, clockwise from above). Things (lock,
    tombstone, portal, dragon, free key): `thing` [N, T, 3], centres; `thing_yaw`, `present` [N, T]. The
    tombstone's centre is that of its upper box. `dragon_fall`, `dragon_speed` [N]: vertical velocity, and
    speed over ground, m/s.
    """

    def __init__(self, num_areas: int, gravity: float) -> None:
        num_slots = num_areas * NUM_AGENTS
        self.gravity = gravity

        self.position = np.full((num_slots, 3), 1e3)  # nowhere before the first reset
        self.velocity = np.zeros((num_slots, 3))
        self.yaw = np.zeros(num_slots)

        self.thing = np.full((num_areas, NUM_THINGS, 3), 1e3)
        self.thing[:, LOCK] = LOCK_CENTRE
        self.thing[:, PORTAL] = PORTAL_CENTRE
        self.thing_yaw = np.zeros((num_areas, NUM_THINGS))
        self.thing_yaw[:, PORTAL] = PORTAL_YAW
        self.present = np.zeros((num_areas, NUM_THINGS), bool)
        self.present[:, [LOCK, PORTAL]] = True

        self.dragon_fall = np.zeros(num_areas)
        self.dragon_speed = np.zeros(num_areas)
        self._dragon_way = np.zeros((num_areas, 2))  # unit vector along x and z

        self._drive = np.zeros((num_slots, 3))  # m/s, of this tick
        self._extent = np.zeros(num_slots)  # m: half the agents' width along the room's axes, in this tick
        self._contacts = Contacts(num_areas)

    def bury(self, areas: np.ndarray, agents: np.ndarray) -> None:
        """Put a tombstone where agent `agents` [n] of `areas` [n] is, and the key where the dragon was."""
        slots = areas * NUM_AGENTS + agents
        self.thing[areas, TOMB] = self.position[slots] + (0.0, TOMB_RISE, 0.0)
        self.thing_yaw[areas, TOMB] = self.yaw[slots]
        self.present[areas, TOMB] = True
        self.put_key(areas, self.thing[areas, DRAGON], self.thing_yaw[areas, DRAGON])

    def put_key(self, areas: np.ndarray, origin: np.ndarray, yaw: np.ndarray) -> None:
        """Show the free key of `areas` [n] at `origin` [n, 3] with `yaw` [n]."""
        right = np.stack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)], axis=1)
        self.thing[areas, KEY] = origin + KEY_OFFSET * right
        self.thing_yaw[areas, KEY] = yaw
        self.present[areas, KEY] = True

    def reset(
        self, areas: np.ndarray, rng: np.random.Generator, enabled: np.ndarray, speed: tuple[float, float]
    ) -> None:
        """Turn the platforms, place agents and dragons, hide keys and tombstones.

        `enabled` bool [N, A]: whose former bodies are in the way; `speed`: range of the dragons' speed, m/s.
        """
        turn = rng.integers(0, 4, len(areas))
        self._place_agents(areas, rng, enabled)

        # Only now: the bodies of the ended episode were in the way of the agents.
        self.present[areas, KEY] = False
        self.present[areas, TOMB] = False
        self.present[areas, DRAGON] = True

        # Its start is fixed in the world; here it depends on the platform's quarter turn.
        self.thing[areas, DRAGON, 1] = DRAGON_START_Y
        self.thing[areas, DRAGON, ::2] = DRAGON_START[turn]
        self.thing_yaw[areas, DRAGON] = DRAGON_START_YAW[turn]  # until its first move

        self.dragon_fall[areas] = 0.0
        self.dragon_speed[areas] = rng.uniform(*speed, len(areas))
        self.aim_at_portal(areas)

    def aim_at_portal(self, areas: np.ndarray) -> None:
        """Let the dragons of `areas` [n] turn to the portal at their next move, and keep that way."""
        ahead = PORTAL_TARGET - self.thing[areas, DRAGON, ::2]
        self._dragon_way[areas] = ahead / np.hypot(ahead[:, 0], ahead[:, 1])[:, None]

    def refresh(self, enabled: np.ndarray) -> None:
        """Note who is there to be touched, whenever something has appeared or vanished; bool [N, A]."""
        self._contacts.refresh(enabled, self.present)

    def push(self, ahead: np.ndarray, right: np.ndarray, turn: np.ndarray) -> None:
        """Turn the agents by `turn` [S] (rad); set velocity changes ahead and right [S] (m/s)."""
        self.yaw += turn
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        self._drive[:, 0] = ahead * sin + right * cos
        self._drive[:, 2] = ahead * cos - right * sin
        self._extent = AGENT_HALF[0] * (np.abs(sin) + np.abs(cos))

    def step(self) -> np.ndarray:
        """Advance by one tick after `push`; return bool [N, A, K], what each agent touches at its start."""
        self._move_dragons()

        position, velocity = self.position, self.velocity
        falling = self._fall()
        shift = np.zeros_like(position)
        touching = self._contacts.stop(position, velocity, self.yaw, self.thing, self.thing_yaw, shift)
        stop_at_walls(position, velocity, self._extent, shift)

        # Shifts out of overlaps leave no velocity behind.
        position += velocity * TICK_S
        position += shift
        if falling:
            position[position[:, 1] < STANDING + 1e-9, 1] = STANDING  # no trace of rounding

        return touching

    def dragon_escapes(self) -> np.ndarray:
        """Return bool [N]: which dragons touch the portal."""
        place = self.thing[:, DRAGON]
        near = (place[:, 0] > 9.0) & (place[:, 2] < -9.0)  # it touches at x 9.8 and z -9.8 at the earliest
        near &= self.present[:, DRAGON]
        if near.any():
            areas = np.flatnonzero(near)
            offset = place[areas] - self.thing[areas, PORTAL]
            yaw, turn = self.thing_yaw[areas, DRAGON], self.thing_yaw[areas, PORTAL]
            gap, _ = box_gap(offset, yaw, HALVES[DRAGON], HALVES[PORTAL], turn)
            near[areas] = gap < CONTACT_GAP

        return near

    def local_velocity(self, slots: np.ndarray) -> np.ndarray:
        """Return the velocity of `slots` [n] to their right, up and ahead, [n, 3], m/s."""
        x, y, z = self.velocity[slots].T
        sin, cos = np.sin(self.yaw[slots]), np.cos(self.yaw[slots])
        return np.stack([x * cos - z * sin, y, x * sin + z * cos], axis=1)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays that outlive a tick."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned; call `refresh` next."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _place_agents(self, areas: np.ndarray, rng: np.random.Generator, enabled: np.ndarray) -> None:
        shape = (-1, NUM_AGENTS)
        # The tombstone is there twice: its upper and its lower box, as in `spawn.BODY_HALVES`.
        bodies, things = [DRAGON, KEY, TOMB, TOMB], self.thing[areas]
        centre = np.concatenate([self.position.reshape(*shape, 3)[areas], things[:, bodies]], axis=1)
        centre[:, -1, 1] -= TOMB_DROP  # its lower box
        yaw = np.concatenate([self.yaw.reshape(shape)[areas], self.thing_yaw[areas][:, bodies]], axis=1)
        present = np.concatenate([enabled[areas], self.present[areas][:, bodies]], axis=1)

        position, turn = draw_poses(rng, centre, yaw, present)

        self.position.reshape(*shape, 3)[areas] = position
        self.yaw.reshape(shape)[areas] = turn
        self.velocity.reshape(*shape, 3)[areas] = 0.0

    def _fall(self) -> bool:
        """Apply drives, gravity, drag and the floor's friction; return whether anybody is in the air."""
        velocity = self.velocity
        velocity += self._drive
        pull = self.gravity * TICK_S
        gap = self.position[:, 1] - STANDING
        falling = bool(gap.any())

        # While all stand on the floor, gravity is only what presses them on it.
        if not falling:
            velocity[:, 1] = 0.0
            velocity *= DRAG_KEPT
            slide(velocity, pull * DRAG_KEPT)
            return False

        velocity[:, 1] -= pull
        velocity *= DRAG_KEPT
        taken = np.maximum(-velocity[:, 1] - gap / TICK_S, 0.0)  # lands exactly
        velocity[:, 1] += taken
        slide(velocity, taken)
        return True

    def _move_dragons(self) -> None:
        """Step towards the portal by position; slide along a column's base; fall onto the floor."""
        position = self.thing[:, DRAGON]
        self.thing_yaw[:, DRAGON] = np.arctan2(self._dragon_way[:, 0], self._dragon_way[:, 1])
        position[:, ::2] += self._dragon_way * (self.dragon_speed * TICK_S)[:, None]

        # A dragon starts 0.04 m above the floor.
        height = position[:, 1] - DRAGON_STANDING
        if height.any():
            self.dragon_fall -= self.gravity * TICK_S
            self.dragon_fall *= DRAGON_DRAG_KEPT
            self.dragon_fall[:] = np.maximum(self.dragon_fall, -height / TICK_S)
            position[:, 1] += self.dragon_fall * TICK_S
            position[position[:, 1] < DRAGON_STANDING + 1e-9, 1] = DRAGON_STANDING

        beside = np.abs(np.abs(position[:, ::2]) - COLUMN) < DRAGON_REACH
        near = np.flatnonzero(beside[:, 0] & beside[:, 1])
        if near.size:
            offset = position[near]
            offset[:, ::2] -= np.copysign(COLUMN, offset[:, ::2])
            gap, normal = box_gap(offset, self.thing_yaw[near, DRAGON], HALVES[DRAGON], HALVES[COLUMN_BASE])
            position[near] += push_out(gap)[:, None] * normal
            # From where it was pushed to, the way to the portal is another one.
            self.aim_at_portal(near[gap < 0])
