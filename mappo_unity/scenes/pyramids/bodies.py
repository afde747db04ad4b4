"""Agents, switches and stone pyramids of Pyramids: how agents move and what stops them.

Upright boxes with the contact rules of `ground.py`. Stone pyramids do not give way (a declared
simplification); a switch stays in its place but turns about the vertical under any push off its centre.
Legend: N areas, one agent each.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import (
    BOX_FRICTION,
    CONTACT_GAP,
    TICK_S,
    box_gap,
    plan_extent,
    push_out,
    slide,
    stop,
)
from mappo_unity.scenes.pyramids.layout import (
    INNER_WALLS,
    INSIDE_X,
    INSIDE_Z,
    SPAWN_Y,
    STONE_LAYERS,
)

GRAVITY = 9.81
MASS = 25.0  # kg, of an agent
DRAG_KEPT = 1.0 - 2.0 * TICK_S
AGENT_HALF = (0.5, 0.5, 0.5)
NUM_STONES = 6  # stone pyramids of an area
SWITCH_HALF = (2.0, 2.0, 2.0)
TALL = 10.0  # m: half the height of what stops agents; all contacts are sideways
SWITCH_INERTIA = 1.0 * (4.0**2 + 4.0**2) / 12.0  # kg m^2, about the vertical
SPIN_KEPT = 1.0 - 0.05 * TICK_S
MAX_SPIN = 7.0  # rad/s: the engine's limit
# Spin lost to the floor in a tick: the two friction anchors of a face stand in opposite corners.
SPIN_LOSS = BOX_FRICTION * 1.0 * GRAVITY * np.hypot(2.0, 2.0) / SWITCH_INERTIA * TICK_S
FLUSH = 0.02  # m: corners within this depth of the deepest one belong to the contact

_ARRAYS = ("position", "velocity", "yaw", "switch_position", "switch_fall", "switch_yaw", "switch_spin")
_STATE = (*_ARRAYS, "stone_root", "age", "_block")


class PyramidsBodies:
    """Keep agents, switches and stones of all areas in arrays.

    Agents: `position`, `velocity` [N, 3] (m, m/s), `yaw` [N] (rad, clockwise from above), `drive` [N, 3]
    (velocity change of this tick). Switches: `switch_position` [N, 3] (the box's centre),
    `switch_fall`, `switch_yaw`, `switch_spin` [N] (m/s, rad, rad/s). `stone_root` [N, 6, 2]: x, z of the
    stone pyramids; `age` int [N]: ticks since the reset, which tells how far they have fallen.
    """

    def __init__(self, num_areas: int) -> None:
        self.position = np.zeros((num_areas, 3))
        self.velocity = np.zeros((num_areas, 3))
        self.drive = np.zeros((num_areas, 3))
        self.yaw = np.zeros(num_areas)

        self.switch_position = np.full((num_areas, 3), 1e3)
        self.switch_fall = np.zeros(num_areas)
        self.switch_yaw = np.zeros(num_areas)
        self.switch_spin = np.zeros(num_areas)

        self.stone_root = np.zeros((num_areas, NUM_STONES, 2))
        self.age = np.zeros(num_areas, np.int64)
        self._shift = np.zeros((num_areas, 3))

        # Boxes along the axes that stop an agent, x, z: inner walls, then the lowest layer of the stones.
        self._half = np.concatenate(
            [INNER_WALLS[:, [3, 5]], np.tile(STONE_LAYERS[0, [3, 5]], (NUM_STONES, 1))]
        )
        self._block = np.zeros((num_areas, len(self._half), 2))
        self._block[:, : len(INNER_WALLS)] = INNER_WALLS[:, [0, 2]]

    def place(self, areas: np.ndarray, spots: np.ndarray, yaw: np.ndarray) -> None:
        """Put agent, switch and stones of `areas` [n] at `spots` [n, 8, 2] (x, z); `yaw` [n]: the agents'."""
        self.position[areas, 1] = SPAWN_Y
        self.position[areas, ::2] = spots[:, 0]
        self.velocity[areas] = 0.0
        self.yaw[areas] = yaw

        self.switch_position[areas, 1] = SPAWN_Y + SWITCH_HALF[1]
        self.switch_position[areas, ::2] = spots[:, 1]
        self.switch_fall[areas] = 0.0
        self.switch_yaw[areas] = 0.0  # its spin stays

        self.stone_root[areas] = spots[:, 2:]
        self._block[areas, len(INNER_WALLS) :] = spots[:, 2:] + STONE_LAYERS[0, [0, 2]]
        self.age[areas] = 0

    def stone_heights(self, areas: np.ndarray) -> np.ndarray:
        """Return the height of the centre of each stone layer, [n, 4], m."""
        ticks = self.age[areas, None]
        fallen = 0.5 * GRAVITY * TICK_S**2 * ticks * (ticks + 1)
        return np.maximum(SPAWN_Y + STONE_LAYERS[:, 1] - fallen, STONE_LAYERS[:, 6])

    def push(self, ahead: np.ndarray, turn: np.ndarray) -> None:
        """Set velocity changes [N] ahead (m/s, in this tick), then turn [N] (rad)."""
        self.drive[:, 0] = ahead * np.sin(self.yaw)
        self.drive[:, 2] = ahead * np.cos(self.yaw)
        self.yaw += turn

    def local_velocity(self, areas: np.ndarray) -> np.ndarray:
        """Return the agents' velocity to their right, up and ahead, [n, 3], m/s."""
        x, y, z = self.velocity[areas].T
        sin, cos = np.sin(self.yaw[areas]), np.cos(self.yaw[areas])
        return np.stack([x * cos - z * sin, y, x * sin + z * cos], axis=1)

    def solve(self) -> np.ndarray:
        """Apply drives, gravity, drag and all contacts to the velocities; return who touches the switch, [N].

        Call `move` next.
        """
        velocity = self.velocity
        velocity += self.drive
        velocity[:, 1] -= GRAVITY * TICK_S
        velocity *= DRAG_KEPT

        # what is solved later has the last word, so the outer walls come last
        self._shift[:] = 0.0
        self._ground()
        touching = self._switch()
        self._blocks()
        self._walls()
        return touching

    def move(self, moved: np.ndarray) -> None:
        """Advance positions by one tick; the bricks' engine has moved `moved` bool [N] along x and z."""
        step = self.velocity * TICK_S
        step[moved, ::2] = 0.0
        self.position += step
        self.position += self._shift
        self.switch_position[:, 1] += self.switch_fall * TICK_S
        self.switch_yaw += self.switch_spin * TICK_S
        self.age += 1

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays; `drive` lives only within a tick."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _ground(self) -> None:
        """Stop the falls at the floor; agents and spinning switches rub on it."""
        velocity = self.velocity
        gap = self.position[:, 1] - AGENT_HALF[1]
        taken = np.maximum(-velocity[:, 1] - np.maximum(gap, 0.0) / TICK_S, 0.0)
        taken[gap >= CONTACT_GAP] = 0.0

        # friction goes by the impulse with which the floor stops the fall
        velocity[:, 1] += taken
        slide(velocity, taken)
        self._shift[:, 1] = push_out(gap)

        height = self.switch_position[:, 1] - SWITCH_HALF[1]
        self.switch_fall -= GRAVITY * TICK_S
        self.switch_fall[:] = np.maximum(self.switch_fall, -height / TICK_S)  # lands exactly

        spin = self.switch_spin
        spin *= SPIN_KEPT
        loss = np.where(height < CONTACT_GAP, SPIN_LOSS, 0.0)
        spin[:] = np.sign(spin) * np.clip(np.abs(spin) - loss, 0.0, MAX_SPIN)

    def _switch(self) -> np.ndarray:
        """Stop agents at switches, which turn; return who touches, bool [N]."""
        offset = self.position - self.switch_position
        near = (
            offset[:, 0] ** 2 + offset[:, 2] ** 2
            < (np.hypot(2.0, 2.0) + np.hypot(0.5, 0.5) + CONTACT_GAP) ** 2
        )

        touching = np.zeros(len(near), bool)
        areas = np.flatnonzero(near)
        if not areas.size:
            return touching

        offset, yaw, turn = offset[areas], self.yaw[areas], self.switch_yaw[areas]
        offset[:, 1] = 0.0
        gap, normal = box_gap(offset, yaw, AGENT_HALF, (SWITCH_HALF[0], TALL, SWITCH_HALF[2]), turn)

        rows = np.flatnonzero(gap < CONTACT_GAP)
        if rows.size:
            touching[areas[rows]] = True
            lever = contact_point(offset[rows], yaw[rows], turn[rows], normal[rows])
            self._turn_switch(areas[rows], gap[rows], normal[rows], lever)

        return touching

    def _turn_switch(self, areas: np.ndarray, gap: np.ndarray, normal: np.ndarray, lever: np.ndarray) -> None:
        """Apply the inelastic impulse between agents and switches, with friction.

        `lever` [n, 2]: the contact from the switch's centre, x, z. A point at (x, z) of a body that turns
        clockwise at w moves at w (z, -x).
        """
        flat = normal[:, ::2]
        along = np.stack([flat[:, 1], -flat[:, 0]], axis=1)
        spin = self.switch_spin[areas]
        velocity = self.velocity[areas]
        approach = np.maximum(gap, 0.0) / TICK_S
        limit = np.full(len(areas), np.inf)

        for axis in (flat, along):  # first the impulse along the normal, then friction, limited by it
            arm = axis[:, 0] * lever[:, 1] - axis[:, 1] * lever[:, 0]
            mobility = (axis**2).sum(axis=1) / MASS + arm**2 / SWITCH_INERTIA
            speed = (velocity[:, ::2] * axis).sum(axis=1) - arm * spin
            if axis is flat:
                impulse = np.maximum(-speed - approach, 0.0) / np.maximum(mobility, 1e-9)
                limit = BOX_FRICTION * impulse
            else:
                impulse = np.clip(-speed / np.maximum(mobility, 1e-9), -limit, limit)
            velocity[:, ::2] += axis * (impulse / MASS)[:, None]
            spin -= arm * impulse / SWITCH_INERTIA

        self.velocity[areas] = velocity
        self.switch_spin[areas] = spin
        self._shift[areas] += push_out(gap)[:, None] * normal

    def _blocks(self) -> None:
        """Stop agents at inner walls and stones."""
        extent = np.stack(plan_extent(self.yaw, AGENT_HALF), axis=1)
        beside = self.position[:, None, ::2] - self._block
        reach = self._half + extent[:, None] + CONTACT_GAP
        areas, blocks = np.nonzero((np.abs(beside) < reach).all(axis=2))
        if not areas.size:
            return

        offset = np.zeros((len(areas), 3))
        offset[:, ::2] = beside[areas, blocks]
        half = np.full((len(areas), 3), TALL)
        half[:, ::2] = self._half[blocks]
        gap, normal = box_gap(offset, self.yaw[areas], AGENT_HALF, half)

        # Each contact's number among those of its agent: a turn must hold no agent twice.
        first = np.r_[True, areas[1:] != areas[:-1]]
        rank = np.arange(len(areas)) - np.flatnonzero(first)[np.cumsum(first) - 1]
        for number in range(rank.max() + 1):  # an agent in a corner has several: in turns
            self._stop(areas, gap, normal, (rank == number) & (gap < CONTACT_GAP))

    def _walls(self) -> None:
        """Stop agents at the outer walls, which have the last word."""
        extents = plan_extent(self.yaw, AGENT_HALF)

        for axis, extent, (low, high) in zip((0, 2), extents, (INSIDE_X, INSIDE_Z), strict=True):
            side = self.position[:, axis]
            for sign, face in ((1.0, low), (-1.0, high)):
                gap = sign * (side - face) - extent
                rows = np.flatnonzero(gap < CONTACT_GAP)
                if rows.size:
                    normal = np.zeros((len(rows), 3))
                    normal[:, axis] = sign
                    self._stop(rows, gap[rows], normal, np.ones(len(rows), bool))

    def _stop(self, areas: np.ndarray, gap: np.ndarray, normal: np.ndarray, which: np.ndarray) -> None:
        areas, gap, normal = areas[which], gap[which], normal[which]
        velocity = self.velocity[areas]
        stop(velocity, normal, gap)
        self.velocity[areas] = velocity
        self._shift[areas] += push_out(gap)[:, None] * normal


def contact_point(offset: np.ndarray, yaw: np.ndarray, turn: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return where agents touch their switches, x and z from the switch's centre, [n, 2].

    The middle of the stretch along the surface that both boxes share: from each box the corners within
    `FLUSH` of its outermost one towards the other. `offset` [n, 3] of the agent from the switch, `yaw` the
    agent's, `turn` the switch's, `normal` [n, 3] from the switch to the agent.
    """
    flat = normal[:, ::2]
    along = np.stack([flat[:, 1], -flat[:, 0]], axis=1)
    agent = _corners(yaw, AGENT_HALF[0]) + offset[:, None, ::2]
    switch = _corners(turn, SWITCH_HALF[0])

    low, high = [], []
    for corners, side in ((agent, -1.0), (switch, 1.0)):
        outward = side * np.einsum("nci,ni->nc", corners, flat)
        across = np.einsum("nci,ni->nc", corners, along)
        edge = outward >= outward.max(axis=1, keepdims=True) - FLUSH
        low.append(np.where(edge, across, np.inf).min(axis=1))
        high.append(np.where(edge, across, -np.inf).max(axis=1))

    middle = 0.5 * (np.maximum(*low) + np.minimum(*high))
    depth = np.einsum("nci,ni->nc", switch, flat).max(axis=1)
    return flat * depth[:, None] + along * middle[:, None]


def _corners(yaw: np.ndarray, half: float) -> np.ndarray:
    """Return the corners of square boxes in plan, [n, 4, 2], x and z from the centre."""
    sin, cos = half * np.sin(yaw), half * np.cos(yaw)
    right, ahead = np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)
    return np.stack([ahead + right, ahead - right, -ahead - right, right - ahead], axis=1)
