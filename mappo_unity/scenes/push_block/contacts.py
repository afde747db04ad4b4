"""Where boxes of an area touch each other or its walls, or will within the tick, seen from above.

Two boxes meet along the axis that separates them best; the contact is the piece of the one's edge that faces
the other's, by its two ends. A contact counts as far as bodies can come in the tick, so that fast ones do not
enter each other (Unity's engine looks only 0.02 m far).

Areas are few and arrays small, so what counts is the number of calls: vectors in the plane are complex
numbers x + iz. A box with yaw y has its right along its turn exp(-iy), and its forward along i times that;
in conj(a) b stand, for a unit vector a, how far b reaches along a and along ia.
Legend: M bodies of all areas in a row, K pairs or contacts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.push_block.solver import WALL, Contacts

_AXES = np.array([1.0, 1.0j])  # right, forward
_NO_CONTACTS = Contacts(np.zeros((2, 0), np.int64), np.zeros((3, 0), complex), np.zeros(0))


class Outlines(NamedTuple):
    """Boxes from above: what contacts are found from."""

    table: np.ndarray
    """complex [4, M]: centre, m; turn; half sizes right + i forward and forward + i right, m."""
    place: np.ndarray
    """[M, 2], m: x, z of the centre."""
    extent: np.ndarray
    """[M, 2], m: how far they reach along x and z."""
    radius: np.ndarray
    """[M], m: of the circles around them; -inf for those that are not there."""
    present: np.ndarray
    """bool [M]."""


class Meeting(NamedTuple):
    """How the boxes of K pairs face each other: a face of the other, and the one's edge before it."""

    pairs: np.ndarray
    """int [2, K]: the one, and the other whose face separates them best."""
    gap: np.ndarray
    """[K], m: along the face's normal; negative: depth."""
    normal: np.ndarray
    """complex [K]: of the face, towards the one."""
    axis: np.ndarray
    """int [K]: 0 where the face looks to the right or left of its box, 1 forward or back."""
    offset: np.ndarray
    """complex [K], m: from the other's centre to the one's."""
    edge: np.ndarray
    """complex [4, K]: the one, as in `Outlines.table`."""
    face: np.ndarray
    """complex [4, K]: the other."""


class Room:
    """The faces of the four walls: `low` and `high` [2], x and z, m."""

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.low, self.high = low, high
        self.middle, self.half = 0.5 * (low + high), 0.5 * (high - low)

    def gaps(self, boxes: Outlines) -> np.ndarray:
        """Return how far boxes are from the nearer wall along x and z, [M, 2] m."""
        return np.asarray(self.half - boxes.extent - np.abs(boxes.place - self.middle))


def as_complex(vectors: np.ndarray) -> np.ndarray:
    """Return a view complex [...] of vectors [..., 2] (x, z) that lie side by side in memory."""
    return vectors.view(complex)[..., 0]


def turns_of(yaw: np.ndarray) -> np.ndarray:
    """Return complex [...]: the right of boxes with that yaw [...], rad clockwise from above."""
    return np.asarray(np.exp(-1j * yaw))


def plan_extents(turn: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return how far boxes reach along x + i along z, complex [...] m, by their turns and half sizes.

    `turn`, `half` complex [...]: see `turns_of`; right + i forward, m.
    """
    return np.asarray(half * np.abs(turn.real) + swapped(half) * np.abs(turn.imag))


def swapped(half: np.ndarray) -> np.ndarray:
    """Return forward + i right for right + i forward, complex [...]."""
    return 1j * half.conj()


def near_pairs(boxes: Outlines, pairs: np.ndarray, reach: np.ndarray | float) -> np.ndarray:
    """Return those of `pairs` int [2, P] whose circles come nearer than `reach` [P] or one, m."""
    centre, radius = boxes.table[0].take(pairs), boxes.radius.take(pairs)
    near = np.abs(centre[0] - centre[1]) < radius[0] + radius[1] + reach
    return pairs.take(near.nonzero()[0], axis=1)


def meet(boxes: Outlines, pairs: np.ndarray) -> Meeting:
    """Find the best separating faces of pairs [2, K]."""
    both = boxes.table.take(pairs, axis=1)
    centre, turn, half, crossed = both
    offset, between = centre[0] - centre[1], turn[0] * turn[1].conj()

    # The offset in the axes of both, against what both reach along them: four faces a pair.
    along = offset * turn.conj()
    reach = half + half[::-1] * np.abs(between.real) + crossed[::-1] * np.abs(between.imag)
    gaps = (np.abs(along.view(float)) - reach.view(float)).reshape(2, -1, 2).swapaxes(0, 1).reshape(-1, 4)
    gaps[:, :2] -= 1e-9  # of two parallel faces always the same one is taken

    # The face whose gap is the widest is the other's.
    best, each = gaps.argmax(axis=1), np.arange(len(gaps))
    other, axis = best >> 1, best & 1
    order = np.array((1 - other, other)) * len(gaps) + each
    edge, face = both.reshape(4, -1).take(order, axis=1).swapaxes(0, 1)

    offset = edge[0] - face[0]
    normal = face[1] * _AXES.take(axis)
    normal *= np.copysign(1.0, (offset * normal.conj()).real)
    return Meeting(pairs.take(order), gaps.max(axis=1), normal, axis, offset, edge, face)


def pair_contacts(meeting: Meeting, velocity: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of pairs of bodies that are near.

    `velocity` complex [M], m/s. `turns` bool [M]: which bodies contacts turn; of a pair of others one
    point is enough.
    """
    one, other = velocity.take(meeting.pairs)
    closing = ((other - one) * meeting.normal.conj()).real
    reach = np.maximum(closing, 0.0) * TICK_S + CONTACT_GAP
    point, gap, meets = _edge(meeting)
    touches = meets & (gap < reach)

    one, other = turns.take(meeting.pairs)
    one_point = ~(one | other)
    if np.count_nonzero(one_point):
        second_nearer = gap[1] < gap[0]
        touches[0] &= ~(one_point & second_nearer)
        touches[1] &= ~(one_point & ~second_nearer)

    end, pair = touches.nonzero()
    if not pair.size:
        return _NO_CONTACTS
    normal = meeting.normal.take(pair)
    arm = point[end, pair] * normal
    vectors = np.array((normal, arm - meeting.offset.take(pair), arm))
    return Contacts(meeting.pairs.take(pair, axis=1), vectors, gap[end, pair])


def wall_contacts(boxes: Outlines, room: Room, velocity: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of boxes with the walls that they are near: their corners.

    `velocity`, `turns`: as in `pair_contacts`. Of a body that contacts do not turn one point is enough.
    """
    gaps, reach = room.gaps(boxes), np.abs(velocity.view(float).reshape(-1, 2)) * TICK_S + CONTACT_GAP
    body, axis = ((gaps < reach) & boxes.present[:, None]).nonzero()
    if not body.size:
        return _NO_CONTACTS

    gap, reach = gaps[body, axis], reach[body, axis]
    normal = _AXES.take(axis) * np.copysign(1.0, room.middle.take(axis) - boxes.place[body, axis])
    turning = turns.take(body)
    if not np.count_nonzero(turning):
        return _touches(body, normal, np.zeros_like(normal), gap)

    # Bodies that are not turned have one point; of the others all corners that are near.
    _, turn, half, _ = boxes.table.take(body, axis=1)
    arm = (turn * np.array((half, half.conj(), -half, -half.conj()))).T
    along = (arm * normal.conj()[:, None]).real
    depth = along - along.min(axis=1, keepdims=True)  # from the nearest corner
    arm *= turning[:, None]
    depth[~turning, 0], depth[~turning, 1:] = 0.0, np.inf
    depth += gap[:, None]
    which, corner = (depth < reach[:, None]).nonzero()
    return _touches(body[which], normal[which], arm[which, corner], depth[which, corner])


def joined(first: Contacts, second: Contacts) -> Contacts:
    """Return the contacts of both."""
    if not first.gap.size:
        return second
    if not second.gap.size:
        return first
    return Contacts(*(np.concatenate(columns, axis=-1) for columns in zip(first, second, strict=True)))


def _touches(body: np.ndarray, normal: np.ndarray, arm: np.ndarray, gap: np.ndarray) -> Contacts:
    """Return contacts [K] of bodies with walls."""
    bodies = np.full((2, len(body)), WALL)
    bodies[0] = body
    return Contacts(bodies, np.array((normal, arm, arm)), gap)


def _edge(meeting: Meeting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the edge that looks at the face, as far as it lies beside it.

    Points complex [2 ends, K] from the face's box, along its normal and along it; gaps [2, K] of them; and
    bool [K], whether there is such a piece.
    """
    _, turn, half, crossed = meeting.edge
    size = np.where(meeting.axis == 1, meeting.face[3], meeting.face[2])  # depth behind the face + i width

    # In the face's axes: of the box's four edges the one that looks most against it.
    inverse = meeting.normal.conj()
    turn = turn * inverse
    sideways = np.abs(turn.real) > np.abs(turn.imag)
    look = np.where(sideways, turn, turn * 1j)
    look *= np.copysign(1.0, -look.real)
    reach = np.where(sideways, half, crossed)  # of the edge from the box's centre + i half its length
    middle = meeting.offset * inverse + look * reach.real
    way = look * (-1j * reach.imag)

    # Cut the edge where it leaves the strip before the face: t from -1 to 1 along it.
    slope = way.imag  # positive, as the edge lies along the face rather than across it
    centre, spread = -middle.imag / slope, size.imag / slope
    t = np.array((np.maximum(centre - spread, -1.0), np.minimum(centre + spread, 1.0)))
    point = middle + t * way
    return point, point.real - size.real, t[0] <= t[1]
