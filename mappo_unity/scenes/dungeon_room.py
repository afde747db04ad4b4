"""The bodies of DungeonEscape's areas: how they move and touch.

In: changes of velocity, who is enabled. Out: poses and touches. Knows no rewards, episodes or sensors.

All coordinates are in the axes of the platform: nothing that an agent senses depends on the platform's
quarter turn, except where the dragon starts. Upright boxes, contact rules of `ground.py`.
Legend: N areas, A = 3 agents of an area, S = N * A slots, K things that an agent can touch.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.dungeon_spawn import CARRIED_KEY_HALF, COLUMN, spawn_agents
from mappo_unity.scenes.ground import (
    BOX_FRICTION,
    CONTACT_GAP,
    TICK_S,
    box_gap,
    plan_extent,
    push_out,
    slide,
    stop,
    stop_pair,
)

NUM_AGENTS = 3
MASS = 10.0  # kg
DRAG_KEPT = 1.0 - 4.0 * TICK_S
DRAGON_DRAG_KEPT = 1.0 - 1.0 * TICK_S
WALL = 12.5  # m, from the centre to the walls
AGENT_HALF = (0.5, 0.5, 0.5)
DRAGON_HALF = (0.75, 0.75, 0.75)
TOMB_RISE = 0.23  # the tombstone's upper box, above the dead agent's centre
KEY_OFFSET = -0.186  # of the free key's box along its own x
PORTAL_YAW = np.radians(-45.0)
PORTAL_TARGET = np.array([11.58, -11.59])  # x, z: where the dragon goes
DRAGON_START = np.array([[0.0, 8.0], [-8.0, 0.0], [0.0, -8.0], [8.0, 0.0]])  # fixed in the world: by turn
DRAGON_START_Y = 0.79

# What an agent can touch: columns of `touching`.
COLUMN_BASE, LOCK, TOMB, NEXT_AGENT, PORTAL, DRAGON, KEY = range(7)
HALVES = np.array(
    [
        [0.85, 2.0, 0.85],  # the base stands for the column: no step that an agent could climb
        [1.5, 1.3, 0.535],
        [0.605, 0.71, 0.26],  # in plan the lower box of the tombstone, which covers the upper one
        AGENT_HALF,
        [2.345, 2.365, 0.88],
        DRAGON_HALF,
        CARRIED_KEY_HALF,
    ]
)
REACH = np.stack([np.hypot(HALVES[:, 0], HALVES[:, 2])] * 2, axis=1)  # of things that turn, along x and z
REACH[[COLUMN_BASE, LOCK]] = HALVES[[COLUMN_BASE, LOCK]][:, ::2]
REACH += np.hypot(0.5, 0.5) + CONTACT_GAP
TOUCH_GAP = np.where(np.arange(7) == KEY, 0.0, CONTACT_GAP)  # a trigger must overlap
DRAGON_REACH = 0.85 + np.hypot(0.75, 0.75) + CONTACT_GAP  # of a column's base, along x and z
FRICTION = {COLUMN_BASE: 0.0, LOCK: BOX_FRICTION, TOMB: BOX_FRICTION}

_ARRAYS = (
    "position",
    "velocity",
    "yaw",
    "dragon_position",
    "dragon_fall",
    "dragon_yaw",
    "dragon_speed",
    "_dragon_step",
    "dragon_present",
    "key_present",
    "tomb_present",
    "_target",
    "_target_yaw",
)


class DungeonRoom:
    """Keep the bodies of all areas in arrays.

    Agents: `position`, `velocity` [S, 3] (m, m/s), `yaw` [S] (rad, clockwise from above), `drive` [S, 3]
    (velocity change asked for this tick). Dragon: `dragon_position` [N, 3], `dragon_yaw`, `dragon_speed`,
    `dragon_fall` [N] (vertical velocity). `dragon_present`, `key_present` (the free key), `tomb_present`
    bool [N].
    """

    def __init__(self, num_areas: int, gravity: float) -> None:
        num_slots = num_areas * NUM_AGENTS
        self.gravity = gravity
        self.num_areas = num_areas
        self.position = np.full((num_slots, 3), 1e3)  # nowhere before the first reset
        self.velocity = np.zeros((num_slots, 3))
        self.drive = np.zeros((num_slots, 3))
        self.yaw = np.zeros(num_slots)
        self.dragon_position = np.full((num_areas, 3), 1e3)
        self.dragon_fall = np.zeros(num_areas)
        self.dragon_yaw = np.zeros(num_areas)
        self.dragon_speed = np.zeros(num_areas)
        self._dragon_step = np.zeros((num_areas, 2))  # m in a tick, x and z
        self.dragon_present = np.zeros(num_areas, bool)
        self.key_present = np.zeros(num_areas, bool)
        self.tomb_present = np.zeros(num_areas, bool)
        self._target = np.zeros((num_areas, NUM_AGENTS, len(HALVES), 3))  # centres of what can be touched
        self._target[:, :, COLUMN_BASE] = (COLUMN[0], 0.0, COLUMN[1])
        self._target[:, :, LOCK] = (0.015, 1.385, 12.6)
        self._target[:, :, PORTAL] = (11.83, 1.83, -11.77)
        self._target_yaw = np.zeros((num_areas, NUM_AGENTS, len(HALVES)))
        self._target_yaw[:, :, PORTAL] = PORTAL_YAW
        self._present = np.ones((num_areas, NUM_AGENTS, len(HALVES)), bool)

    # ---- poses of what appears --------------------------------------------------------------------------

    @property
    def tomb_position(self) -> np.ndarray:
        """Return the centre of the tombstones' upper boxes, [N, 3]."""
        return self._target[:, 0, TOMB]

    @property
    def tomb_yaw(self) -> np.ndarray:
        """Return the tombstones' yaw, [N]."""
        return self._target_yaw[:, 0, TOMB]

    @property
    def key_position(self) -> np.ndarray:
        """Return the centre of the free keys' boxes, [N, 3]."""
        return self._target[:, 0, KEY]

    @property
    def key_yaw(self) -> np.ndarray:
        """Return the free keys' yaw, [N]."""
        return self._target_yaw[:, 0, KEY]

    def bury(self, areas: np.ndarray, agents: np.ndarray) -> None:
        """Put a tombstone where agent `agents` [n] of `areas` [n] is, and the key where the dragon is."""
        slots = areas * NUM_AGENTS + agents
        self.tomb_present[areas] = True
        self._target[areas, :, TOMB] = (self.position[slots] + [0.0, TOMB_RISE, 0.0])[:, None]
        self._target_yaw[areas, :, TOMB] = self.yaw[slots, None]
        self.put_key(areas, self.dragon_position[areas], self.dragon_yaw[areas])

    def put_key(self, areas: np.ndarray, origin: np.ndarray, yaw: np.ndarray) -> None:
        """Show the free key of `areas` [n] at `origin` [n, 3] with `yaw` [n]."""
        right = np.stack([np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)], axis=1)
        self.key_present[areas] = True
        self._target[areas, :, KEY] = (origin + KEY_OFFSET * right)[:, None]
        self._target_yaw[areas, :, KEY] = yaw[:, None]

    def reset(
        self, areas: np.ndarray, rng: np.random.Generator, enabled: np.ndarray, speed: tuple[float, float]
    ) -> None:
        """Turn the platforms, place agents and dragons, hide keys and tombstones.

        `enabled` bool [N, A]: whose former bodies are in the way; `speed`: range of the dragons' speed, m/s.
        """
        turn = rng.integers(0, 4, len(areas))
        spawn_agents(self, areas, rng, enabled)
        self.key_present[areas] = False
        self.tomb_present[areas] = False
        self.dragon_present[areas] = True
        self.dragon_position[areas, 1] = DRAGON_START_Y
        self.dragon_position[areas, ::2] = DRAGON_START[turn]
        self.dragon_fall[areas] = 0.0
        self.dragon_speed[areas] = rng.uniform(*speed, len(areas))
        self._face_portal(areas)

    # ---- one tick ---------------------------------------------------------------------------------------

    def push(self, ahead: np.ndarray, right: np.ndarray, turn: np.ndarray) -> None:
        """Ask for velocity changes [S] ahead and to the right (m/s, in this tick), then turn [S] (rad)."""
        sin, cos = np.sin(self.yaw), np.cos(self.yaw)
        self.drive[:, 0] = ahead * sin + right * cos
        self.drive[:, 2] = ahead * cos - right * sin
        self.yaw += turn

    def step(self, enabled: np.ndarray) -> np.ndarray:
        """Advance by one tick; return bool [N, A, K], what each agent touches at its start."""
        self._move_dragons()
        self._refresh_targets(enabled)
        position, velocity = self.position, self.velocity
        velocity += self.drive
        velocity[:, 1] -= self.gravity * TICK_S
        velocity *= DRAG_KEPT
        shift = self._ground()
        touching = self._boxes(shift)
        self._walls(shift)
        position += velocity * TICK_S
        position += shift
        return touching

    def local_velocity(self, slots: np.ndarray) -> np.ndarray:
        """Return the velocity of `slots` [n] to their right, up and ahead, [n, 3], m/s."""
        x, y, z = self.velocity[slots].T
        sin, cos = np.sin(self.yaw[slots]), np.cos(self.yaw[slots])
        return np.stack([x * cos - z * sin, y, x * sin + z * cos], axis=1)

    def dragon_escapes(self) -> np.ndarray:
        """Return bool [N]: which dragons touch the portal."""
        near = self.dragon_position[:, 0] > PORTAL_TARGET[0] - 4.0
        near &= self.dragon_present
        if near.any():
            areas = np.flatnonzero(near)
            offset = self.dragon_position[areas] - self._target[areas, 0, PORTAL]
            yaw = np.full(len(areas), PORTAL_YAW)
            gap, _ = box_gap(offset, self.dragon_yaw[areas], DRAGON_HALF, HALVES[PORTAL], yaw)
            near[areas] = gap < CONTACT_GAP
        return near

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays; `drive` lives only within a tick."""
        return {name: getattr(self, name).copy() for name in _ARRAYS}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _ARRAYS:
            getattr(self, name)[...] = state[name]

    # ---- parts of a tick --------------------------------------------------------------------------------

    def _face_portal(self, areas: np.ndarray) -> None:
        """Turn dragons to the portal; on a straight way they keep that heading."""
        ahead = PORTAL_TARGET - self.dragon_position[areas, ::2]
        self.dragon_yaw[areas] = np.arctan2(ahead[:, 0], ahead[:, 1])
        step = self.dragon_speed[areas] * TICK_S / np.hypot(ahead[:, 0], ahead[:, 1])
        self._dragon_step[areas] = step[:, None] * ahead

    def _move_dragons(self) -> None:
        """Step towards the portal by position; slide along a column's base; fall onto the floor."""
        position = self.dragon_position
        position[:, ::2] += self._dragon_step
        height = position[:, 1] - DRAGON_HALF[1]
        if height.any():
            self.dragon_fall -= self.gravity * TICK_S
            self.dragon_fall *= DRAGON_DRAG_KEPT
            self.dragon_fall[:] = np.maximum(self.dragon_fall, -height / TICK_S)
            landed = height + self.dragon_fall * TICK_S <= 1e-9
            position[:, 1] = np.where(landed, DRAGON_HALF[1], position[:, 1] + self.dragon_fall * TICK_S)
        beside = np.abs(position[:, ::2]) - COLUMN
        near = np.flatnonzero((np.abs(beside) < DRAGON_REACH).all(axis=1))
        if near.size:
            offset = position[near]
            offset[:, ::2] -= np.copysign(COLUMN, offset[:, ::2])
            gap, normal = box_gap(offset, self.dragon_yaw[near], DRAGON_HALF, HALVES[COLUMN_BASE])
            position[near] += push_out(gap)[:, None] * normal
            self._face_portal(near[gap < 0])

    def _refresh_targets(self, enabled: np.ndarray) -> None:
        """Write the centres of moving things, and who is there to be touched."""
        target, present = self._target, self._present
        place = self.position.reshape(self.num_areas, NUM_AGENTS, 3)
        target[:, :, COLUMN_BASE, ::2] = np.copysign(COLUMN, place[:, :, ::2])  # the nearest of the four
        target[:, :, NEXT_AGENT] = place[:, (1, 2, 0)]
        target[:, :, DRAGON] = self.dragon_position[:, None]
        self._target_yaw[:, :, NEXT_AGENT] = self.yaw.reshape(-1, NUM_AGENTS)[:, (1, 2, 0)]
        self._target_yaw[:, :, DRAGON] = self.dragon_yaw[:, None]
        present[:] = enabled[:, :, None]
        present[:, :, TOMB] &= self.tomb_present[:, None]
        present[:, :, NEXT_AGENT] &= enabled[:, (1, 2, 0)]
        present[:, :, DRAGON] &= self.dragon_present[:, None]
        present[:, :, KEY] &= self.key_present[:, None]

    def _ground(self) -> np.ndarray:
        """Stop the fall at the floor and rub; return the shift [S, 3] out of it, m."""
        velocity = self.velocity
        gap = self.position[:, 1] - AGENT_HALF[1]
        taken = np.maximum(-velocity[:, 1] - np.maximum(gap, 0.0) / TICK_S, 0.0)
        taken[gap >= CONTACT_GAP] = 0.0
        velocity[:, 1] += taken
        slide(velocity, taken)
        shift = np.zeros_like(velocity)
        shift[:, 1] = push_out(gap)
        return shift

    def _boxes(self, shift: np.ndarray) -> np.ndarray:
        """Find all touches, bool [N, A, K]; stop agents at solid boxes and at each other."""
        place = self.position.reshape(self.num_areas, NUM_AGENTS, 1, 3)
        offset = (place - self._target).reshape(-1, len(HALVES), 3)
        near = np.abs(offset[:, :, 0]) < REACH[:, 0]
        near &= np.abs(offset[:, :, 2]) < REACH[:, 1]
        near &= self._present.reshape(near.shape)
        touching = np.zeros(near.shape, bool)
        slots, things = np.nonzero(near)
        if slots.size:
            yaw = self._target_yaw.reshape(near.shape)[slots, things]
            offset = offset[slots, things]
            gap, normal = box_gap(offset, self.yaw[slots], AGENT_HALF, HALVES[things], yaw)
            touching[slots, things] = gap < TOUCH_GAP[things]
            solid = np.flatnonzero((gap < CONTACT_GAP) & (things <= NEXT_AGENT))
            if solid.size:
                self._stop(slots[solid], things[solid], gap[solid], normal[solid], shift)
        return touching.reshape(self._present.shape)

    def _stop(
        self, slots: np.ndarray, things: np.ndarray, gap: np.ndarray, normal: np.ndarray, shift: np.ndarray
    ) -> None:
        """Apply contacts [n] of `slots` with `things`; no slot meets one thing twice."""
        out = push_out(gap)[:, None] * normal
        pairs = np.flatnonzero(things == NEXT_AGENT)
        for number in range(NUM_AGENTS if pairs.size else 0):  # an agent may be in two pairs: in turns
            rows = pairs[slots[pairs] % NUM_AGENTS == number]
            first = slots[rows]
            second = first - number + (number + 1) % NUM_AGENTS
            velocity, other = self.velocity[first], self.velocity[second]
            mobility = np.full(3, 1.0 / MASS)
            stop_pair(velocity, other, normal[rows], gap[rows], mobility, mobility)
            self.velocity[first], self.velocity[second] = velocity, other
            shift[first] += 0.5 * out[rows]
            shift[second] -= 0.5 * out[rows]
        for thing, friction in FRICTION.items():
            rows = np.flatnonzero(things == thing)
            if rows.size:
                velocity = self.velocity[slots[rows]]
                stop(velocity, normal[rows], gap[rows], friction)
                self.velocity[slots[rows]] = velocity
                shift[slots[rows]] += out[rows]

    def _walls(self, shift: np.ndarray) -> None:
        """Stop agents at the four walls, which have the last word; as `ground.stop`, along the axes."""
        velocity = self.velocity
        for axis, extent in zip((0, 2), plan_extent(self.yaw, AGENT_HALF), strict=True):
            side = self.position[:, axis]
            gap = WALL - extent
            gap -= np.abs(side)
            near = gap < CONTACT_GAP
            if near.any():
                sign = np.sign(side)
                lack = np.maximum(sign * velocity[:, axis] - np.maximum(gap, 0.0) / TICK_S, 0.0)
                lack[~near] = 0.0
                velocity[:, axis] -= sign * lack
                along = velocity[:, 2 - axis]
                slip = np.hypot(along, velocity[:, 1])
                kept = np.maximum(1.0 - BOX_FRICTION * lack / np.maximum(slip, 1e-12), 0.0)
                along *= kept
                velocity[:, 1] *= kept
                shift[:, axis] -= sign * push_out(gap)
