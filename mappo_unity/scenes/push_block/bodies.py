"""Boxes that slide on the floor of a square room and push each other: agents and blocks, without an engine.

All boxes stand upright, so that contacts are found from above (`contacts.py`) and solved in the plane
(`solver.py`); heights only matter for the fall after a reset. As in Unity's engine: forces and drag, then
contacts with the floor's friction, then motion; overlaps that are left after it are pushed apart.
Legend: N areas, B bodies of an area, M = N B bodies of all areas in a row, K pairs of them. Area coordinates:
x right, y up, z forward; metres; floor at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mappo_unity.scenes.core.ground import BOX_FRICTION, CONTACT_GAP, TICK_S
from mappo_unity.scenes.push_block.contacts import (
    Meeting,
    Outlines,
    Room,
    as_complex,
    joined,
    meet,
    near_pairs,
    pair_contacts,
    plan_extents,
    swapped,
    turns_of,
    wall_contacts,
)
from mappo_unity.scenes.push_block.solver import Floor, solve, systems_of

MAX_SPIN = 7.0  # rad/s: the engine's limit
SPIN_KEPT = 1.0 - 0.05 * TICK_S
PUSH_ROUNDS = 40  # only turned blocks at a reset need more than a few
FAR_IN, REACH = 0.05, 1.4  # m: from there on also those that come into the way are looked at, so far off
DEEP = 1e-3  # m: overlaps below this are left to the next tick

_STATE = ("place", "height", "yaw", "motion", "fall", "half", "kept", "hold", "rub", "present")


class SlidingBoxes:
    """Keep and move B boxes in each of N areas.

    Attributes, float64, to be read and written in place: `place` [N, B, 2], x and z of the centres; `height`
    [N, B]; `yaw` [N, B], rad, clockwise from above; `motion` [N, B, 3], velocity along x and z (m/s) and spin
    (rad/s); `fall` [N, B], vertical velocity; `kept` [N, B], share of the speed that drag leaves in a tick;
    `present` bool [N, B]; `gravity`, m/s^2. To be read: `half` [N, B, 2], half sizes along right and forward
    (`resize` changes them); `hold`, `rub` [N, B], static and dynamic friction with the floor, doubled
    (`ground.py`; `set_friction` changes them); `extent` [N, B, 2], how far they reach along x and z since the
    last tick.

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
        shape = num_areas, bodies = num_areas, len(mass)
        self.room, self.gravity = room, gravity
        self.rest = np.asarray(half)[:, 1]  # height of the centre on the floor

        # The solver wants a row for each part of a system's motion; who is outside sees three numbers a body.
        *many, size = self._systems = systems_of(num_areas, bodies)
        self._motion = np.zeros((*many, 3, size))
        self.motion = np.moveaxis(self._motion, -2, 0).reshape(3, *shape).transpose(1, 2, 0)
        self.place = np.zeros((*shape, 2))
        self._centre = as_complex(self.place).reshape(-1)
        self.height = np.tile(self.rest, (num_areas, 1))
        self.yaw = np.zeros(shape)
        self.fall = np.zeros(shape)

        self.half = np.tile(np.asarray(half)[:, ::2], (num_areas, 1, 1)).astype(float)
        self.kept = np.tile(1.0 - np.asarray(drag) * TICK_S, (num_areas, 1))
        self.hold, self.rub = np.full(shape, BOX_FRICTION), np.full(shape, BOX_FRICTION)
        self.present = np.ones(shape, bool)

        self.extent = self.half.copy()
        self._mass = np.tile(np.asarray(mass, float), num_areas)
        self._turns = np.tile(np.asarray(turns, bool), num_areas)
        self._pairs = _pairs(num_areas, bodies)
        self._pairs_of_area = self._pairs.shape[1] // num_areas
        self._table = np.zeros((4, num_areas * bodies), complex)
        self._weigh()

    def step(self, drive: np.ndarray) -> None:
        """Advance by one tick; `drive` complex [N, B]: velocity changes x + iz, m/s."""
        x, z, spin = self.motion.transpose(2, 0, 1)
        x += drive.real
        z += drive.imag
        x *= self.kept
        z *= self.kept
        if np.count_nonzero(spin):
            spin *= SPIN_KEPT
            np.minimum(np.maximum(spin, -MAX_SPIN, out=spin), MAX_SPIN, out=spin)
        landed = self._land()

        boxes, velocity = self.outlines(), (x + 1j * z).reshape(-1)
        # Who is hit may leave as fast as the fastest of its area came.
        speed = np.abs(velocity).reshape(self.yaw.shape).max(axis=1)
        reach = 2.0 * (speed * TICK_S + CONTACT_GAP)
        meeting = meet(boxes, near_pairs(boxes, self._pairs, reach.repeat(self._pairs_of_area)))
        contacts = joined(
            pair_contacts(meeting, velocity, self._turns),
            wall_contacts(boxes, self.room, velocity, self._turns),
        )
        solve(contacts, self._motion, self._weight, self._floor(landed))

        self._centre += (x + 1j * z).reshape(-1) * TICK_S
        turned = bool(np.count_nonzero(spin))
        if turned:
            self.yaw += spin * TICK_S
            boxes = self.outlines()
        self._separate(boxes, meeting, turned)

    def resize(self, areas: np.ndarray, body: int, half: np.ndarray) -> None:
        """Give a body of `areas` [n] other half sizes along its right and forward, [n, 2] m; mass stays."""
        self.half[areas, body] = half
        self._weigh()

    def set_friction(self, areas: np.ndarray, hold: np.ndarray, rub: np.ndarray) -> None:
        """Change the floor of `areas` [n]: static and dynamic friction, doubled, [n, 1]."""
        self.hold[areas], self.rub[areas] = hold, rub
        self._weigh()

    def outlines(self) -> Outlines:
        """Return where the boxes are, seen from above."""
        table, present = self._table, self.present.reshape(-1)
        table[0], table[1] = self._centre, turns_of(self.yaw.reshape(-1))
        extent = plan_extents(table[1], table[2]).view(float).reshape(-1, 2)
        self.extent = extent.reshape(self.place.shape)
        radius = np.where(present, self._radius, -np.inf)
        return Outlines(table, self.place.reshape(-1, 2), extent, radius, present)

    def deepest(self) -> np.ndarray:
        """Return the deepest overlap of any two boxes of an area, or of a box and a wall, [N] m."""
        boxes = self.outlines()
        depth = np.where(boxes.present, -self.room.gaps(boxes).min(axis=1), 0.0).clip(0.0)
        meeting = meet(boxes, near_pairs(boxes, self._pairs, 0.0))
        np.maximum.at(depth, meeting.pairs[0], -meeting.gap)
        return np.asarray(depth.reshape(self.yaw.shape).max(axis=1))

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
        half = as_complex(self.half).reshape(-1)
        self._radius = np.abs(half)
        inertia = self._mass * self._radius**2 / 3.0
        weight = np.array((1.0 / self._mass, 1.0 / self._mass, self._turns / inertia))
        self._weight = np.moveaxis(weight.reshape(3, *self._systems), 0, -2)
        self._table[2], self._table[3] = half, swapped(half)

        # Spin by speed lost to the floor: the two friction anchors of a face stand in opposite corners.
        grip = self._mass * self._radius / inertia
        self._grip = np.array((-grip, grip)).reshape(2, *self._systems)
        self._is_sticky = bool((self.hold != self.rub).any())

    def _land(self) -> np.ndarray:
        """Fall; return the downward speed that the floor takes, [N, B] m/s."""
        pull: np.ndarray = self.gravity * TICK_S * self.kept
        gap = self.height - self.rest
        if not np.count_nonzero(gap) and not np.count_nonzero(self.fall):  # as nearly always
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
        rub = np.maximum(self.rub * landed, 1e-12).reshape(self._systems)
        hold = (self.hold * landed).reshape(self._systems) if self._is_sticky else rub
        return Floor(hold, rub, rub * self._grip)

    def _separate(self, boxes: Outlines, before: Meeting, turned: bool) -> None:
        """Push overlapping boxes apart, the lighter one farther, and all of them into the room.

        `before`: how near ones faced each other before they moved; `turned`: whether any has turned.
        """
        self._stay_inside(boxes)
        pairs, place = before.pairs, self._centre
        if not before.gap.size:
            return

        # While no face turns, those that were apart along an axis are no nearer than they are along it now.
        if not turned:
            moved = place.take(pairs[0]) - place.take(pairs[1]) - before.offset
            gap = before.gap + (moved * before.normal.conj()).real
            if not np.count_nonzero(gap < -DEEP):
                return

        widened = False
        for _ in range(PUSH_ROUNDS):
            boxes.table[0] = place
            meeting = meet(boxes, pairs)
            deep = (meeting.gap < -DEEP).nonzero()[0]
            if not deep.size:
                break
            if not widened and meeting.gap.min() < -FAR_IN:
                pairs, widened = near_pairs(boxes, self._pairs, REACH), True
                continue

            one, other = meeting.pairs[:, deep]
            way = meeting.normal[deep] * -meeting.gap[deep]
            share = self._mass[other] / (self._mass[one] + self._mass[other])
            np.add.at(place, one, way * share)
            np.add.at(place, other, way * (share - 1.0))
            # Against a wall the other one gives way, in the rounds that follow.
            self._stay_inside(boxes)

    def _stay_inside(self, boxes: Outlines) -> None:
        """Put centres back that brought their boxes into a wall, and stop them along that axis."""
        if not np.count_nonzero(self.room.gaps(boxes) < 0.0):
            return

        low, high = self.room.low + boxes.extent, self.room.high - boxes.extent
        inside = np.minimum(np.maximum(boxes.place, low), high)
        out = (inside != boxes.place) & boxes.present[:, None]
        boxes.place[out] = inside[out]
        self.motion[..., :2][out.reshape(self.place.shape)] = 0.0


def _pairs(num_areas: int, bodies: int) -> np.ndarray:
    """Return int [2, P]: pairs of bodies of the same area, area by area; bodies as numbered in one row."""
    pairs = np.array(np.triu_indices(bodies, 1))
    return (pairs[:, None] + np.arange(num_areas)[:, None] * bodies).reshape(2, -1)
