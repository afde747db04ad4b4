"""Boxes that slide on the floor of a square room and push each other: agents and blocks, without an engine.

All boxes stand upright, so that contacts are found from above (`contacts.py`) and solved in the plane
(`solver.py`); heights only matter for the fall after a reset. As in Unity's engine: forces and drag, then
contacts with the floor's friction, then motion; overlaps that are left after it are pushed apart.
Legend: N areas, B bodies of an area. Area coordinates: x right, y up, z forward; metres; floor at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mappo_unity.scenes.core.ground import BOX_FRICTION, TICK_S
from mappo_unity.scenes.push_block.contacts import (
    Outlines,
    Room,
    as_complex,
    joined,
    meet,
    near_pairs,
    pair_contacts,
    plan_extents,
    turns_of,
    wall_contacts,
)
from mappo_unity.scenes.push_block.solver import Floor, solve

MAX_SPIN = 7.0  # rad/s: the engine's limit
SPIN_KEPT = 1.0 - 0.05 * TICK_S
PUSH_ROUNDS = 40  # only turned blocks at a reset need more than a few
FAR_IN, REACH = 0.05, 0.7  # m: from there on also those that come into the way are looked at, so far off
DEEP = 1e-3  # m: overlaps below this are left to the next tick

_STATE = ("place", "height", "yaw", "motion", "fall", "half", "kept", "hold", "rub", "present")


class SlidingBoxes:
    """Keep and move B boxes in each of N areas.

    Attributes, float64, to be read and written in place: `place` [N, B, 2], x and z of the centres; `height`
    [N, B]; `yaw` [N, B], rad, clockwise from above; `motion` [N, B, 3], velocity along x and z (m/s) and spin
    (rad/s); `fall` [N, B], vertical velocity; `half` [N, B, 2], half sizes along right and
    forward, to be changed by `resize`; `kept` [N, B], share of the speed that drag leaves in a tick; `hold`,
    `rub` [N, B], static and dynamic friction with the floor, doubled (`ground.py`);
    `present` bool [N, B]; `gravity`, m/s^2. To be read: `extent` [N, B, 2], how far they reach along x and z
    since the last tick.

    Arguments: `half` [B, 3] (right, up, forward), `mass` [B] kg, `drag` [B] 1/s; `turns` [B]: whether
    contacts turn a body (else its yaw is only set); `room`: faces of the walls.
    """

    def __init__(
        self,
        num_areas: int,
        half: np.ndarray,
        mass: Sequence[float],
        drag: Sequence[float],
        turns: Sequence[bool],
        room: Room,
        gravity: float,
    ) -> None:
        shape = (num_areas, len(mass))
        self.room, self.gravity = room, gravity
        self.rest = np.asarray(half)[:, 1]  # height of the centre on the floor

        self.place = np.zeros((*shape, 2))
        self.height = np.tile(self.rest, (num_areas, 1))
        self.yaw = np.zeros(shape)
        self.motion = np.zeros((*shape, 3))
        self.fall = np.zeros(shape)

        self.half = np.tile(np.asarray(half)[:, ::2], (num_areas, 1, 1)).astype(float)
        self.kept = np.tile(1.0 - np.asarray(drag) * TICK_S, (num_areas, 1))
        self.hold, self.rub = np.full(shape, BOX_FRICTION), np.full(shape, BOX_FRICTION)
        self.present = np.ones(shape, bool)

        self.extent = self.half.copy()
        self._mass = np.asarray(mass, float)
        self._turns = np.asarray(turns, bool)
        self._any_turns = bool(self._turns.any())
        self._table = np.zeros((*shape, 4), complex)
        self._weigh()

    def step(self, drive: np.ndarray) -> None:
        """Advance by one tick; `drive` [N, B, 2]: velocity changes along x and z, m/s."""
        motion = self.motion
        motion[..., :2] += drive
        motion[..., :2] *= self.kept[..., None]
        if self._any_turns:
            spin = motion[..., 2] * SPIN_KEPT
            motion[..., 2] = np.minimum(np.maximum(spin, -MAX_SPIN), MAX_SPIN)
        landed = self._land()

        boxes, turns = self.outlines(), self._turns
        contacts, near = pair_contacts(boxes, motion, turns)
        contacts = joined(contacts, wall_contacts(boxes, self.room, motion, turns))
        solve(contacts, motion, self._weight, self._floor(landed))

        self.place += motion[..., :2] * TICK_S
        if self._any_turns:
            self.yaw += motion[..., 2] * TICK_S
        self._separate(near)

    def resize(self, areas: np.ndarray, body: int, half: np.ndarray) -> None:
        """Give a body of `areas` [n] other half sizes along its right and forward, [n, 2] m; mass stays."""
        self.half[areas, body] = half
        self._weigh()

    def outlines(self) -> Outlines:
        """Return where the boxes are, seen from above."""
        table, turn = self._table, turns_of(self.yaw)
        table[..., 0], table[..., 1] = as_complex(self.place), turn
        radius = np.where(self.present, self._radius, -np.inf)
        return Outlines(table, self.place, plan_extents(turn, self.half), radius, self.present)

    def deepest(self) -> np.ndarray:
        """Return the deepest overlap of any two boxes of an area, or of a box and a wall, [N] m."""
        boxes = self.outlines()
        beyond = np.maximum(self.room.low - self.place, self.place - self.room.high) + boxes.extent
        depth: np.ndarray = np.where(self.present[..., None], beyond, 0.0).max(axis=(1, 2)).clip(0.0)
        near = near_pairs(boxes, 0.0)
        np.maximum.at(depth, near[:, 0], -meet(boxes, near).gap)
        return depth

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]
        self._weigh()

    def _weigh(self) -> None:
        """Compute what follows from masses and sizes: inverse masses and inertia, grip against turning."""
        # Moment of inertia about the vertical, kg m^2: m (w^2 + l^2) / 12.
        inertia = self._mass * (self.half**2).sum(axis=2) / 3.0
        self._weight = np.empty(self.motion.shape)
        self._weight[..., :2] = (1.0 / self._mass)[:, None]
        self._weight[..., 2] = self._turns / inertia

        half = as_complex(self.half)
        self._table[..., 2], self._table[..., 3] = half, 1j * half.conj()

        # Spin by speed lost to the floor: the two friction anchors of a face stand in opposite corners.
        self._radius = np.sqrt((self.half**2).sum(axis=2))
        self._grip = self._mass * self._radius / inertia

    def _land(self) -> np.ndarray:
        """Fall; return the downward speed that the floor takes, [N, B] m/s."""
        pull = self.gravity * TICK_S * self.kept
        gap = self.height - self.rest
        if not gap.any() and not self.fall.any():  # as nearly always
            return pull

        self.fall -= self.gravity * TICK_S
        self.fall *= self.kept
        landed = np.maximum(-self.fall - gap / TICK_S, 0.0)
        self.fall += landed
        self.height += self.fall * TICK_S

        # No trace of rounding: bodies that stand have exactly that height.
        standing = landed > 0
        self.height[standing] = np.broadcast_to(self.rest, standing.shape)[standing]
        self.fall[standing] = 0.0
        return landed

    def _floor(self, landed: np.ndarray) -> Floor:
        """Return what the floor's friction can take in this tick."""
        rub = self.rub * landed
        return Floor(self.hold * landed, rub, rub * self._grip)

    def _separate(self, pairs: np.ndarray) -> None:
        """Push overlapping boxes apart, the lighter one farther, and all of them into the room.

        `pairs` int [K, 3]: area and bodies of those that were near before they moved.
        """
        boxes = self.outlines()
        self.extent = boxes.extent
        low, high = self.room.low + boxes.extent, self.room.high - boxes.extent
        self._stay_inside(low, high)
        if not len(pairs):
            return

        widened = False
        for _ in range(PUSH_ROUNDS):
            boxes.table[..., 0] = as_complex(self.place)
            meeting = meet(boxes, pairs)
            deep = (meeting.gap < -DEEP).nonzero()[0]
            if not deep.size:
                break
            if not widened and meeting.gap.min() < -FAR_IN:
                pairs, widened = near_pairs(boxes, REACH), True
                continue

            area, one, other = pairs[deep].T
            way = (meeting.normal[deep] * -meeting.gap[deep]).view(float).reshape(-1, 2)
            share = (self._mass[other] / (self._mass[one] + self._mass[other]))[:, None]
            np.add.at(self.place, (area, one), way * share)
            np.add.at(self.place, (area, other), way * (share - 1.0))
            # Against a wall the other one gives way, in the rounds that follow.
            self._stay_inside(low, high)

    def _stay_inside(self, low: np.ndarray, high: np.ndarray) -> None:
        """Put centres within `low` and `high` [N, B, 2], and stop those that went out."""
        inside = np.minimum(np.maximum(self.place, low), high)
        out = (inside != self.place) & self.present[..., None]
        if out.any():
            self.place[out] = inside[out]
            self.motion[..., :2][out] = 0.0
