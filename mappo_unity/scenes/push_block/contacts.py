"""Where boxes of an area touch each other or its walls, or will within the tick, seen from above.

Two boxes meet along the axis that separates them best; the contact is the piece of the one's edge that faces
the other's, by its two ends. A contact counts as far as bodies can come in the tick, so that fast ones do not
enter each other (Unity's engine looks only 0.02 m far). Areas are few and arrays small, so vectors are kept
by component: fewer calls are faster.
Legend: N areas, B bodies of an area, P pairs of bodies, K pairs or bodies that are looked at closely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.push_block.solver import WALL, Contacts

MARGIN = 0.05  # m: pairs that are that much too far for a contact may still be pushed together in the tick
_ENDS = np.array([[0], [1]])  # of an edge
_NO_PAIRS = np.zeros(0, np.int64)
_NO_POINTS = np.zeros((2, 0))
_NO_CONTACTS = Contacts(_NO_PAIRS, _NO_PAIRS, _NO_PAIRS, _NO_POINTS, _NO_POINTS, _NO_POINTS, np.zeros(0))
_CORNERS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, -1.0, 1.0]])


class Outlines(NamedTuple):
    """Boxes from above: what contacts are found from."""

    table: np.ndarray
    """[N, B, 6]: x, z of the centre, m; sine and cosine of the yaw; half sizes along right and forward, m."""
    extent: np.ndarray
    """[N, B, 2], m: how far they reach along x and z."""
    radius: np.ndarray
    """[N, B], m: of the circles around them."""
    present: np.ndarray
    """bool [N, B]."""


class Pairs(NamedTuple):
    """Pairs of bodies."""

    area: np.ndarray
    """int [K]."""
    one: np.ndarray
    """int [K]: body of the area."""
    other: np.ndarray
    """int [K]."""

    def at(self, rows: np.ndarray) -> Pairs:
        """Return some of the pairs."""
        return Pairs(self.area[rows], self.one[rows], self.other[rows])


class Meeting(NamedTuple):
    """How the boxes of K pairs face each other."""

    gap: np.ndarray
    """[K], m: along the best separating axis; negative: depth."""
    normal: np.ndarray
    """[2, K]: along it, from the other to the one."""
    axis: np.ndarray
    """int [K]: whose it is: right, forward of the other (0, 1), of the one (2, 3)."""
    one: np.ndarray
    other: np.ndarray
    """[6, K]: the boxes, as in `Outlines`."""

    def at(self, rows: np.ndarray) -> Meeting:
        """Return some of the pairs."""
        return Meeting(*(part[..., rows] for part in self))


class Room(NamedTuple):
    """The faces of the four walls, m."""

    low: np.ndarray
    """[2]: x, z."""
    high: np.ndarray
    """[2]: x, z."""


def outlines(
    place: np.ndarray, yaw: np.ndarray, half: np.ndarray, radius: np.ndarray, present: np.ndarray
) -> Outlines:
    """Return the outlines of boxes: `place`, `half` [N, B, 2], the others [N, B]."""
    table = np.empty((*yaw.shape, 6))
    table[..., :2], table[..., 4:] = place, half
    sin, cos = np.sin(yaw), np.cos(yaw)
    table[..., 2], table[..., 3] = sin, cos
    return Outlines(table, plan_extents(sin, cos, half), radius, present)


def plan_extents(sin: np.ndarray, cos: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return how far boxes reach along x and z, [..., 2] m, by their yaws' sines and half sizes [..., 2]."""
    sin, cos = np.abs(sin), np.abs(cos)
    right, ahead = half[..., 0], half[..., 1]
    extents = np.empty(half.shape)
    extents[..., 0] = right * cos + ahead * sin
    extents[..., 1] = right * sin + ahead * cos
    return extents


def near_pairs(boxes: Outlines, pairs: np.ndarray, reach: np.ndarray | float) -> Pairs:
    """Return those of pairs [2, P] whose circles meet, enlarged by `reach` [N, B] or one for all, m."""
    one, other = pairs
    radius = boxes.radius + reach
    x, z = boxes.table[..., 0], boxes.table[..., 1]
    x, z = x[:, one] - x[:, other], z[:, one] - z[:, other]
    radius = radius[:, one] + radius[:, other]
    near = x * x + z * z < radius * radius
    near &= boxes.present[:, one] & boxes.present[:, other]
    area, pair = near.nonzero()
    return Pairs(area, one[pair], other[pair])


def meet(boxes: Outlines, pairs: Pairs) -> Meeting:
    """Find the best separating axes of pairs."""
    one, other = boxes.table[pairs.area, pairs.one].T, boxes.table[pairs.area, pairs.other].T
    x, z, sin, cos, right, ahead = one
    other_x, other_z, other_sin, other_cos, other_right, other_ahead = other
    x, z = x - other_x, z - other_z
    s, c = np.abs(sin * other_cos - cos * other_sin), np.abs(cos * other_cos + sin * other_sin)

    along = np.empty((4, len(x)))
    along[0] = x * other_cos - z * other_sin
    along[1] = x * other_sin + z * other_cos
    along[2] = x * cos - z * sin
    along[3] = x * sin + z * cos
    gaps = np.abs(along)
    gaps[0] -= other_right + right * c + ahead * s
    gaps[1] -= other_ahead + right * s + ahead * c
    # Of two parallel faces always the same one is taken.
    gaps[2] -= right + other_right * c + other_ahead * s + 1e-9
    gaps[3] -= ahead + other_right * s + other_ahead * c + 1e-9

    axis, rows = gaps.argmax(axis=0), np.arange(len(x))
    sign = np.where(along[axis, rows] < 0, -1.0, 1.0)
    normal = np.empty((2, len(x)))
    normal[0] = np.array([other_cos, other_sin, cos, sin])[axis, rows] * sign
    normal[1] = np.array([-other_sin, other_cos, -sin, cos])[axis, rows] * sign
    return Meeting(gaps[axis, rows], normal, axis, one, other)


def pair_contacts(
    boxes: Outlines, pairs: np.ndarray, motion: np.ndarray, turns: np.ndarray
) -> tuple[Contacts, Pairs]:
    """Return the contacts of pairs [2, P] of bodies, and all pairs that may overlap after the tick.

    `motion` [N, B, 3]: velocity (m/s; the spin is not looked at). `turns` bool [B]: which bodies contacts
    turn; of a pair of others one point is enough.
    """
    speed_x, speed_z = motion[..., 0], motion[..., 1]
    speed = np.sqrt(speed_x * speed_x + speed_z * speed_z)
    near = near_pairs(boxes, pairs, speed * TICK_S + CONTACT_GAP)
    if not near.area.size:
        return _NO_CONTACTS, near

    meeting = meet(boxes, near)
    approach = (motion[near.area, near.other] - motion[near.area, near.one]).T
    closing = approach[0] * meeting.normal[0] + approach[1] * meeting.normal[1]
    reach = np.maximum(closing, 0.0) * TICK_S + CONTACT_GAP
    rows = (meeting.gap < reach + MARGIN).nonzero()[0]
    if not rows.size:
        return _NO_CONTACTS, near.at(rows)
    near, meeting, reach = near.at(rows), meeting.at(rows), reach[rows]

    point, gap, meets = _edge(meeting)
    touches = meets & (gap < reach)
    one_point = ~(turns[near.one] | turns[near.other])
    touches &= ~one_point | (gap.argmin(axis=0) == _ENDS)
    end, pair = touches.nonzero()
    point = point[:, end, pair]
    contacts = Contacts(
        near.area[pair],
        near.one[pair],
        near.other[pair],
        meeting.normal[:, pair],
        point - meeting.one[:2, pair],
        point - meeting.other[:2, pair],
        gap[end, pair],
    )
    return contacts, near


def wall_contacts(boxes: Outlines, room: Room, motion: np.ndarray, turns: np.ndarray) -> Contacts:
    """Return the contacts of boxes with the walls that they are near and approach: their corners.

    `motion`, `turns`: as in `pair_contacts`. Of a body that contacts do not turn one point is enough.
    """
    reach = np.abs(motion[..., :2]) * TICK_S + CONTACT_GAP
    place = boxes.table[..., :2]
    gap = np.empty((2, *place.shape))
    np.subtract(place - room.low, boxes.extent, out=gap[0])
    np.subtract(room.high - place, boxes.extent, out=gap[1])
    near = gap < reach
    near &= boxes.present[..., None]
    side, area, body, axis = near.nonzero()
    if not area.size:
        return _NO_CONTACTS

    normal = np.zeros((2, len(area)))
    normal[axis, np.arange(len(area))] = 1.0 - 2.0 * side
    gap = gap[side, area, body, axis]
    turning = turns[body]
    if not turning.any():
        return _touches(area, body, normal, np.zeros(normal.shape), gap)

    # Bodies that are not turned have one point; of the others all corners that are near.
    arm = _corner_arms(boxes.table[area, body].T)  # [2, K, 4]
    along = (arm * normal[:, :, None]).sum(axis=0)
    beyond = along - along.min(axis=1, keepdims=True)  # from the nearest corner
    arm *= turning[:, None]
    beyond[~turning, 0], beyond[~turning, 1:] = 0.0, np.inf
    beyond += gap[:, None]
    which, corner = (beyond < reach[area, body, axis][:, None]).nonzero()
    return _touches(area[which], body[which], normal[:, which], arm[:, which, corner], beyond[which, corner])


def joined(first: Contacts, second: Contacts) -> Contacts:
    """Return the contacts of both."""
    if not first.area.size:
        return second
    if not second.area.size:
        return first
    return Contacts(*(np.concatenate(columns, axis=-1) for columns in zip(first, second, strict=True)))


def _touches(
    area: np.ndarray, body: np.ndarray, normal: np.ndarray, arm: np.ndarray, gap: np.ndarray
) -> Contacts:
    """Return contacts [K] of bodies with walls."""
    return Contacts(area, body, np.full(len(area), WALL), normal, arm, arm, gap)


def _edge(meeting: Meeting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the edge that faces the separating box, as far as it lies beside that one's face.

    Points [2, 2, K] (x or z, end), gaps [2, K] of them, and bool [K], whether there is such a piece.
    """
    mine = meeting.axis >= 2  # the face is that of the one
    face, edge = np.where(mine, meeting.one, meeting.other), np.where(mine, meeting.other, meeting.one)
    out_x, out_z = np.where(mine, -1.0, 1.0) * meeting.normal  # of the face
    across = (meeting.axis & 1).astype(bool)
    depth, width = np.where(across, face[5], face[4]), np.where(across, face[4], face[5])

    # The edge is that of the box's four which looks most against the face.
    _, _, sin, cos, right, ahead = edge
    facing_right, facing_ahead = cos * out_x - sin * out_z, sin * out_x + cos * out_z
    sideways = np.abs(facing_right) > np.abs(facing_ahead)
    sign = np.where(np.where(sideways, facing_right, facing_ahead) > 0, -1.0, 1.0)
    look_x, look_z = sign * np.where(sideways, cos, sin), sign * np.where(sideways, -sin, cos)
    reach, length = np.where(sideways, right, ahead), np.where(sideways, ahead, right)
    middle_x = edge[0] - face[0] + look_x * reach  # from the face's box
    middle_z = edge[1] - face[1] + look_z * reach
    way_x, way_z = look_z * length, -look_x * length

    # Cut the edge where it leaves the strip before the face: t from -1 to 1 along it.
    start, slope = middle_x * out_z - middle_z * out_x, way_x * out_z - way_z * out_x
    slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    centre, spread = -start / slope, width / np.abs(slope)
    t = np.empty((2, len(centre)))
    np.maximum(centre - spread, -1.0, out=t[0])
    np.minimum(centre + spread, 1.0, out=t[1])

    point = np.empty((2, *t.shape))
    point[0], point[1] = middle_x + t * way_x, middle_z + t * way_z
    gap = point[0] * out_x + point[1] * out_z - depth
    point += face[:2, None]
    return point, gap, t[0] <= t[1]


def _corner_arms(table: np.ndarray) -> np.ndarray:
    """Return the ways from the centres of boxes [6, K] to their corners, [2, K, 4]."""
    _, _, sin, cos, right, ahead = table[:, :, None]
    right, ahead = right * _CORNERS[0], ahead * _CORNERS[1]
    arms = np.empty((2, *right.shape))
    arms[0], arms[1] = right * cos + ahead * sin, ahead * cos - right * sin
    return arms
