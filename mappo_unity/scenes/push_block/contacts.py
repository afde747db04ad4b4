"""Where boxes of an area touch each other or its walls, or will within the tick, seen from above.

Two boxes meet along the axis that separates them best; the contact is the piece of the one's edge that faces
the other's, by its two ends. A contact counts as far as bodies can come in the tick, so that fast ones do not
enter each other (Unity's engine looks only 0.02 m far).

Areas are few and arrays small, so what counts is the number of calls: vectors in the plane are complex
numbers x + iz. A box with yaw y has its right along its turn exp(-iy), and its forward along i times that;
in conj(a) b stand, for a unit vector a, how far b reaches along a and along ia.
Legend: N areas, B bodies of an area, K pairs or contacts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.push_block.solver import WALL, Contacts

_AXES = np.array([1.0, 1.0j])  # right, forward
_TWICE_AXES = np.tile(_AXES, 2)
_SIDES = np.array([1.0, -1.0])
_NO_ROWS, _NO_VECTORS = np.zeros(0, np.int64), np.zeros(0, complex)
_NO_CONTACTS = Contacts(*(_NO_ROWS,) * 3, *(_NO_VECTORS,) * 3, np.zeros(0))


class Outlines(NamedTuple):
    """Boxes from above: what contacts are found from."""

    table: np.ndarray
    """complex [N, B, 4]: centre, m; turn; half sizes right + i forward and forward + i right, m."""
    place: np.ndarray
    """[N, B, 2], m: x, z of the centre."""
    extent: np.ndarray
    """[N, B, 2], m: how far they reach along x and z."""
    radius: np.ndarray
    """[N, B], m: of the circles around them; -inf for those that are not there."""
    present: np.ndarray
    """bool [N, B]."""


class Meeting(NamedTuple):
    """How the boxes of K pairs face each other."""

    gap: np.ndarray
    """[K], m: along the best separating axis; negative: depth."""
    normal: np.ndarray
    """complex [K]: along it, from the other to the one."""
    axis: np.ndarray
    """int [K]: whose it is: right, forward of the one (0, 1), of the other (2, 3)."""
    boxes: np.ndarray
    """complex [K, 2, 4]: the one and the other, as in `Outlines`."""


class Room(NamedTuple):
    """The faces of the four walls, m."""

    low: np.ndarray
    """[2]: x, z."""
    high: np.ndarray
    """[2]: x, z."""


def as_complex(vectors: np.ndarray) -> np.ndarray:
    """Return a view complex [...] of vectors [..., 2] (x, z) that lie side by side in memory."""
    return vectors.view(complex)[..., 0]


def turns_of(yaw: np.ndarray) -> np.ndarray:
    """Return complex [...]: the right of boxes with that yaw [...], rad clockwise from above."""
    return np.asarray(np.exp(-1j * yaw))


def plan_extents(turn: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return how far boxes reach along x and z, [..., 2] m, by turns complex [...], half sizes [..., 2]."""
    ahead, aside = np.abs(turn.real)[..., None], np.abs(turn.imag)[..., None]
    return np.asarray(half * ahead + half[..., ::-1] * aside)


def near_pairs(boxes: Outlines, reach: np.ndarray | float) -> np.ndarray:
    """Return int [K, 3], area and bodies: pairs whose circles meet, enlarged by `reach` [N, B] or one, m."""
    radius, place = boxes.radius + reach, boxes.table[..., 0]
    near = np.abs(place[:, :, None] - place[:, None]) < radius[:, :, None] + radius[:, None]
    area, one, other = near.nonzero()
    return np.array((area, one, other)).T[one < other]


def meet(boxes: Outlines, pairs: np.ndarray) -> Meeting:
    """Find the best separating axes of pairs [K, 3]."""
    both = boxes.table[pairs[:, :1], pairs[:, 1:]]
    turn, half, swapped = both[..., 1], both[..., 2], both[..., 3]
    offset, between = both[:, 0, 0] - both[:, 1, 0], turn[:, :1] * turn[:, 1:].conj()

    # The offset in the axes of both, against what both reach along them.
    along = np.multiply(offset[:, None], turn.conj(), order="C").view(float)
    reach = half + half[:, ::-1] * np.abs(between.real) + swapped[:, ::-1] * np.abs(between.imag)
    gaps = np.abs(along) - np.ascontiguousarray(reach).view(float)
    gaps[:, :2] -= 1e-9  # of two parallel faces always the same one is taken

    axis, rows = gaps.argmax(axis=1), np.arange(len(pairs))
    normal = turn[rows, axis >> 1] * _TWICE_AXES[axis] * np.copysign(1.0, along[rows, axis])
    return Meeting(gaps[rows, axis], normal, axis, both)


def pair_contacts(boxes: Outlines, motion: np.ndarray, turns: np.ndarray) -> tuple[Contacts, np.ndarray]:
    """Return the contacts of pairs of bodies, and the pairs that are near, as `near_pairs` does.

    `motion` [N, B, 3]: velocity (m/s; the spin is not looked at). `turns` bool [B]: which bodies contacts
    turn; of a pair of others one point is enough.
    """
    velocity = as_complex(motion[..., :2])
    pairs = near_pairs(boxes, np.abs(velocity) * TICK_S + CONTACT_GAP)
    meeting = meet(boxes, pairs)
    both = velocity[pairs[:, :1], pairs[:, 1:]]
    closing = ((both[:, 1] - both[:, 0]) * meeting.normal.conj()).real
    reach = np.maximum(closing, 0.0) * TICK_S + CONTACT_GAP
    point, gap, meets = _edge(meeting)
    touches = meets & (gap < reach)

    two_points, second_nearer = turns[pairs[:, 1]] | turns[pairs[:, 2]], gap[1] < gap[0]
    touches[0] &= two_points | ~second_nearer
    touches[1] &= two_points | second_nearer

    end, pair = touches.nonzero()
    point, (area, one, other) = point[end, pair], pairs[pair].T
    arms = point - meeting.boxes[pair, :, 0].T
    return Contacts(area, one, other, meeting.normal[pair], arms[0], arms[1], gap[end, pair]), pairs


def wall_contacts(boxes: Outlines, room: Room, motion: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of boxes with the walls that they are near and approach: their corners.

    `motion`, `turns`: as in `pair_contacts`. Of a body that contacts do not turn one point is enough.
    """
    reach = np.abs(motion[..., :2]) * TICK_S + CONTACT_GAP
    gap = np.array((boxes.place - room.low, room.high - boxes.place)) - boxes.extent
    side, area, body, axis = ((gap < reach) & boxes.present[..., None]).nonzero()
    if not area.size:
        return _NO_CONTACTS

    normal, gap = _SIDES[side] * _AXES[axis], gap[side, area, body, axis]
    turning = turns[body]
    if not turning.any():
        return _touches(area, body, normal, np.zeros(area.shape, complex), gap)

    # Bodies that are not turned have one point; of the others all corners that are near.
    _, turn, half, _ = boxes.table[area, body].T
    arm = (turn * np.array((half, half.conj(), -half, -half.conj()))).T
    along = (arm * normal.conj()[:, None]).real
    beyond = along - along.min(axis=1, keepdims=True)  # from the nearest corner
    arm *= turning[:, None]
    beyond[~turning, 0], beyond[~turning, 1:] = 0.0, np.inf
    beyond += gap[:, None]
    which, corner = (beyond < reach[area, body, axis][:, None]).nonzero()
    return _touches(area[which], body[which], normal[which], arm[which, corner], beyond[which, corner])


def joined(first: Contacts, second: Contacts) -> Contacts:
    """Return the contacts of both."""
    if not first.area.size:
        return second
    if not second.area.size:
        return first
    return Contacts(*(np.concatenate(columns) for columns in zip(first, second, strict=True)))


def _touches(
    area: np.ndarray, body: np.ndarray, normal: np.ndarray, arm: np.ndarray, gap: np.ndarray
) -> Contacts:
    """Return contacts [K] of bodies with walls."""
    return Contacts(area, body, np.full(len(area), WALL), normal, arm, arm, gap)


def _edge(meeting: Meeting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the edge that faces the separating box, as far as it lies beside that one's face.

    Points complex [2 ends, K], gaps [2, K] of them, and bool [K], whether there is such a piece.
    """
    mine = meeting.axis < 2  # the face is that of the one
    one, other = meeting.boxes.transpose(1, 2, 0)
    face, edge = np.where(mine, one, other), np.where(mine, other, one)
    outward = np.where(mine, -meeting.normal, meeting.normal)
    _, _, half, swapped = face
    size = np.where(meeting.axis & 1, swapped, half)  # depth behind the face + i width

    # In the face's axes, outward and along it: of the box's four edges the one that looks most against it.
    inverse = outward.conj()
    _, turn, half, swapped = edge
    turn = turn * inverse
    sideways = np.abs(turn.real) > np.abs(turn.imag)
    look = np.where(sideways, turn, turn * 1j)
    look *= np.copysign(1.0, -look.real)
    reach = np.where(sideways, half, swapped)  # of the edge from the box's centre + i half its length
    middle = (edge[0] - face[0]) * inverse + look * reach.real
    way = look * (-1j * reach.imag)

    # Cut the edge where it leaves the strip before the face: t from -1 to 1 along it.
    slope = np.where(np.abs(way.imag) < 1e-9, 1e-9, way.imag)
    centre, spread = -middle.imag / slope, size.imag / np.abs(slope)
    t = np.array((np.maximum(centre - spread, -1.0), np.minimum(centre + spread, 1.0)))
    point = middle + t * way
    gap = point.real - size.real
    return point * outward + face[0], gap, t[0] <= t[1]
