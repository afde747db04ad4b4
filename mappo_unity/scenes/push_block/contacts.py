"""Where boxes of an area touch each other or its walls, or will within the tick, seen from above.

Two boxes meet along the axis that separates them best; the contact is the piece of the one's edge that faces
the other's, by its two ends. A contact counts as far as bodies can come in the tick, so that fast ones do not
enter each other (Unity's engine looks only 0.02 m far).
Legend: N areas, B bodies of an area, P pairs of bodies, K pairs or bodies that are looked at closely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.push_block.solver import WALL, Contacts

_CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
_NO_PAIRS = np.zeros(0, np.int64)
_NO_POINTS = np.zeros((0, 2))
_NO_CONTACTS = Contacts(_NO_PAIRS, _NO_PAIRS, _NO_PAIRS, _NO_POINTS, _NO_POINTS, _NO_POINTS, np.zeros(0))


class Poses(NamedTuple):
    """Boxes from above: what contacts are found from."""

    place: np.ndarray
    """[N, B, 2], m: x, z of the centres."""
    yaw: np.ndarray
    """[N, B], rad, clockwise."""
    half: np.ndarray
    """[N, B, 2], m: half sizes along the boxes' own right and forward."""
    present: np.ndarray
    """bool [N, B]."""


class Meeting(NamedTuple):
    """Pairs of boxes that are near, and how they face each other."""

    gap: np.ndarray
    """[K], m: along the best separating axis; negative: depth."""
    normal: np.ndarray
    """[K, 2]: along it, from the other to the one."""
    axis: np.ndarray
    """int [K]: whose it is: right, forward of the other (0, 1), of the one (2, 3)."""
    axes: np.ndarray
    """[K, 4, 2]: all four of them."""


class Room(NamedTuple):
    """The faces of the four walls, m."""

    low: np.ndarray
    """[2]: x, z."""
    high: np.ndarray
    """[2]: x, z."""


def near_pairs(
    poses: Poses, pairs: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give area, one and other (int [K]) of pairs [2, P] whose circles meet, enlarged by `reach` [N, B]."""
    one, other = pairs
    if not one.size:
        return _NO_PAIRS, _NO_PAIRS, _NO_PAIRS
    radius = np.sqrt((poses.half**2).sum(axis=2)) + reach
    x, z = (poses.place[:, one] - poses.place[:, other]).transpose(2, 0, 1)
    near = x * x + z * z < (radius[:, one] + radius[:, other]) ** 2
    near &= poses.present[:, one] & poses.present[:, other]
    area, pair = near.nonzero()
    return area, one[pair], other[pair]


def meet(poses: Poses, area: np.ndarray, one: np.ndarray, other: np.ndarray) -> Meeting:
    """Find the best separating axes of pairs [K]."""
    yaw, other_yaw = poses.yaw[area, one], poses.yaw[area, other]
    half, other_half = poses.half[area, one].T, poses.half[area, other].T
    sin, cos, other_sin, other_cos = np.sin(yaw), np.cos(yaw), np.sin(other_yaw), np.cos(other_yaw)

    axes = np.empty((len(area), 4, 2))
    axes[:, 0, 0], axes[:, 0, 1] = other_cos, -other_sin
    axes[:, 1, 0], axes[:, 1, 1] = other_sin, other_cos
    axes[:, 2, 0], axes[:, 2, 1] = cos, -sin
    axes[:, 3, 0], axes[:, 3, 1] = sin, cos

    offset = poses.place[area, one] - poses.place[area, other]
    along = (axes @ offset[:, :, None])[:, :, 0]
    s, c = np.abs(sin * other_cos - cos * other_sin), np.abs(cos * other_cos + sin * other_sin)
    reach = np.empty_like(along)
    reach[:, 0] = other_half[0] + half[0] * c + half[1] * s
    reach[:, 1] = other_half[1] + half[0] * s + half[1] * c
    reach[:, 2] = half[0] + other_half[0] * c + other_half[1] * s
    reach[:, 3] = half[1] + other_half[0] * s + other_half[1] * c

    gaps = np.abs(along) - reach
    gaps[:, 2:] -= 1e-9  # of two parallel faces always the same one is taken
    axis, rows = gaps.argmax(axis=1), np.arange(len(area))
    sign = np.where(along[rows, axis] < 0, -1.0, 1.0)
    return Meeting(gaps[rows, axis], axes[rows, axis] * sign[:, None], axis, axes)


def pair_contacts(poses: Poses, pairs: np.ndarray, motion: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of pairs [2, P] of bodies.

    `motion` [N, B, 3]: velocity (m/s; the spin is not looked at).
    `turns` bool [B]: which bodies contacts turn. Of a pair of others one point is enough.
    """
    speed = np.sqrt(motion[..., 0] ** 2 + motion[..., 1] ** 2)
    area, one, other = near_pairs(poses, pairs, speed * TICK_S + CONTACT_GAP)
    if not area.size:
        return _NO_CONTACTS

    meeting = meet(poses, area, one, other)

    closing = -((motion[area, one] - motion[area, other])[:, :2] * meeting.normal).sum(axis=1)
    reach = np.maximum(closing, 0.0) * TICK_S + CONTACT_GAP
    near = np.flatnonzero(meeting.gap < reach)
    if not near.size:
        return _NO_CONTACTS

    area, one, other, reach = area[near], one[near], other[near], reach[near]
    meeting = Meeting(*(part[near] for part in meeting))

    # The ends [2, K, 2] of the touching piece, and their gaps.
    point, gap, meets = _edge(poses, area, one, other, meeting)
    near_end = meets & (gap < reach)
    nearer = gap.argmin(axis=0) == np.arange(2)[:, None]
    end, pair = (near_end & (nearer | turns[one] | turns[other])).nonzero()
    area, one, other, point = area[pair], one[pair], other[pair], point[end, pair]
    return Contacts(
        area,
        one,
        other,
        meeting.normal[pair],
        point - poses.place[area, one],
        point - poses.place[area, other],
        gap[end, pair],
    )


def wall_contacts(poses: Poses, room: Room, motion: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of boxes with the walls that they are near and approach: their corners.

    `motion`, `turns`: as in `pair_contacts`. Of a body that contacts do not turn one point is enough.
    """
    reach = np.abs(motion[..., :2]) * TICK_S + CONTACT_GAP
    extent = plan_extents(poses.yaw, poses.half)
    gap = np.stack([poses.place - extent - room.low, room.high - poses.place - extent])  # [2, N, B, 2]
    near = (gap < reach) & poses.present[..., None]
    side, area, body, axis = near.nonzero()
    if not area.size:
        return _NO_CONTACTS

    normal = np.zeros((len(area), 2))
    normal[np.arange(len(area)), axis] = 1.0 - 2.0 * side
    gap = gap[side, area, body, axis]
    still = (~turns[body]).nonzero()[0]
    parts = [_touches(area[still], body[still], normal[still], np.zeros((len(still), 2)), gap[still])]

    turning = turns[body].nonzero()[0]
    if turning.size:
        area, body, normal, gap = area[turning], body[turning], normal[turning], gap[turning]
        arm = _corner_arms(poses.yaw[area, body], poses.half[area, body])  # [K, 4, 2]
        along = (arm @ normal[:, :, None])[:, :, 0]
        beyond = gap[:, None] + along - along.min(axis=1, keepdims=True)  # the gap of each corner
        which, corner = (beyond < reach[area, body, axis[turning]][:, None]).nonzero()
        parts.append(
            _touches(area[which], body[which], normal[which], arm[which, corner], beyond[which, corner])
        )
    return joined(parts)


def _touches(
    area: np.ndarray, body: np.ndarray, normal: np.ndarray, arm: np.ndarray, gap: np.ndarray
) -> Contacts:
    """Return contacts [K] of bodies with walls."""
    return Contacts(area, body, np.full(len(area), WALL), normal, arm, arm, gap)


def joined(parts: list[Contacts]) -> Contacts:
    """Return the contacts of all parts."""
    return Contacts(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def plan_extents(yaw: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return how far boxes reach along x and z, [..., 2] m, by `yaw` [...] and half sizes [..., 2]."""
    sin, cos = np.abs(np.sin(yaw)), np.abs(np.cos(yaw))
    extents = np.empty(half.shape)
    extents[..., 0] = half[..., 0] * cos + half[..., 1] * sin
    extents[..., 1] = half[..., 0] * sin + half[..., 1] * cos
    return extents


def _edge(
    poses: Poses, area: np.ndarray, one: np.ndarray, other: np.ndarray, meeting: Meeting
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the edge that faces the separating box, as far as it lies beside that one's face.

    Points [2, K, 2], gaps [2, K] of them, and bool [2, K], whether there is such a piece.
    """
    rows = np.arange(len(area))
    mine = meeting.axis >= 2  # the face is that of the one
    face, edge = np.where(mine, one, other), np.where(mine, other, one)
    out = np.where(mine, -1.0, 1.0)[:, None] * meeting.normal  # of the face
    face_half, edge_half = poses.half[area, face], poses.half[area, edge]
    which = meeting.axis % 2
    first = np.where(mine, 2, 0)
    side = meeting.axes[rows, first + 1 - which]  # along the face

    # The edge is that of the box's four which looks most against the face.
    own = meeting.axes.reshape(-1, 2, 2, 2)[rows, np.where(mine, 0, 1)]  # its axes [K, 2, 2]
    facing = (own @ out[:, :, None])[:, :, 0]
    axis = np.abs(facing).argmax(axis=1)
    ahead = own[rows, axis] * -np.sign(facing[rows, axis])[:, None]
    tangent = own[rows, 1 - axis] * edge_half[rows, 1 - axis][:, None]
    offset = poses.place[area, edge] - poses.place[area, face]
    middle = offset + ahead * edge_half[rows, axis][:, None]  # from the face's box

    # Cut the edge where it leaves the strip before the face: t from -1 to 1 along it.
    start, slope = (middle * side).sum(axis=1), (tangent * side).sum(axis=1)
    slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    width = face_half[rows, 1 - which]
    ends = np.stack([(-width - start) / slope, (width - start) / slope])
    low = np.maximum(np.minimum(ends[0], ends[1]), -1.0)
    high = np.minimum(np.maximum(ends[0], ends[1]), 1.0)
    t = np.stack([low, high])
    point = middle + t[:, :, None] * tangent
    gap = (point * out).sum(axis=2) - face_half[rows, which]
    return point + poses.place[area, face], gap, np.broadcast_to(low <= high, gap.shape)


def _corner_arms(yaw: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the ways from the centres to the corners, [K, 4, 2]."""
    sin, cos = np.sin(yaw)[:, None], np.cos(yaw)[:, None]
    right, ahead = (half[:, None] * _CORNERS).transpose(2, 0, 1)
    return np.stack([right * cos + ahead * sin, ahead * cos - right * sin], axis=2)
