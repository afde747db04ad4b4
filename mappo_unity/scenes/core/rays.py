"""Analytic casts of spheres along rays, vectorised, as Unity's ray sensors need them.

Every cast broadcasts over leading axes; a sensor of N agents with R rays against M colliders uses
[N, R, 1, 3] origins and directions against [N, 1, M, ...] or [M, ...] colliders and gives distances
[N, R, M], inf where nothing is hit. Distance is the travel of the sphere's centre. A collider that the
sphere overlaps at the start (or is nearer than `skip_gap`) is not reported, as the engine does; so an
agent's own collider needs no special care.

For horizontal rays `cast_rectangles` is the same as `cast_upright_boxes` in two dimensions, and faster.
"""

from __future__ import annotations

import numpy as np

_TINY = 1e-12
_FAR = 1e9  # m: past the end of any wall


def cast_spheres(
    origin: np.ndarray,
    direction: np.ndarray,
    centre: np.ndarray,
    reach: np.ndarray | float,
    skip_gap: float = 0.0,
) -> np.ndarray:
    """Return the travel until the centre comes within `reach` (both radii added) of `centre`.

    `origin`, unit `direction`, `centre`: [..., D], D = 2 or 3. `reach`: [...].
    Roots of t^2 + 2 b t + c = 0 with b = (o - p).d, c = |o - p|^2 - reach^2.
    """
    offset = origin - centre
    b = _dot(offset, direction)
    square = _dot(offset, offset)
    return _entry(b, square - np.square(reach), square < np.square(reach + skip_gap))


def cast_capsules(
    origin: np.ndarray,
    direction: np.ndarray,
    radius: np.ndarray | float,
    low: np.ndarray,
    high: np.ndarray,
    reach: np.ndarray | float,
    skip_gap: float = 0.0,
) -> np.ndarray:
    """Return the travel of a sphere of `radius` until it meets a capsule.

    `low`, `high`: the ends [..., 3] of the capsule's axis; `reach`: its own radius [...].
    """
    axis = high - low
    length = np.sqrt(_dot(axis, axis))
    unit = axis / np.maximum(length, _TINY)[..., None]
    total = reach + radius
    offset = origin - low
    along, slope = _dot(offset, unit), _dot(direction, unit)

    # The capsule's side: an endless cylinder, of which only the piece between the ends counts.
    side, lateral = offset - along[..., None] * unit, direction - slope[..., None] * unit
    a = np.maximum(_dot(lateral, lateral), _TINY)
    body = _entry(_dot(side, lateral) / a, (_dot(side, side) - np.square(total)) / a, False)
    with np.errstate(invalid="ignore"):  # inf * 0 where nothing is met
        place = along + body * slope
    body = np.where((place >= 0) & (place <= length), body, np.inf)

    caps = np.minimum(
        cast_spheres(origin, direction, low, total), cast_spheres(origin, direction, high, total)
    )

    # PhysX leaves out what a sphere touches where it starts.
    near = side + (along - np.clip(along, 0, length))[..., None] * unit
    touching = _dot(near, near) < np.square(total + skip_gap)
    return np.where(touching, np.inf, np.minimum(body, caps))


def cast_rectangles(
    origin: np.ndarray,
    direction: np.ndarray,
    radius: np.ndarray | float,
    centre: np.ndarray,
    half: np.ndarray,
    yaw: np.ndarray | float = 0.0,
    skip_gap: float = 0.0,
) -> np.ndarray:
    """Return the travel of a disc of `radius` until it meets a rectangle, all in the plane (x, z).

    `origin`, unit `direction`, `centre`, `half` (half extents): [..., 2]; `yaw`: [...] rad, clockwise from
    above. For a horizontal ray against an upright box use `flat_radius` as radius (0: never hit).
    """
    local, turned = _to_box(origin - centre, yaw), _to_box(direction, yaw)
    travel, within = _enter_slabs(local, turned, half, radius)
    touching = _beyond(local, half) < np.square(radius + skip_gap)

    # The enlarged rectangle has round corners: who enters beyond both edges is cast against a circle.
    corner = np.isfinite(travel) & (within == 0)
    if corner.any():
        start, ahead, extent = _pick((local, turned, half), corner)
        point = start + travel[corner][:, None] * ahead
        reach = np.broadcast_to(radius, corner.shape)[corner]
        travel[corner] = cast_spheres(start, ahead, np.copysign(extent, point), reach)
    return np.where(touching | (np.asarray(radius) <= 0), np.inf, travel)


def cast_upright_boxes(
    origin: np.ndarray,
    direction: np.ndarray,
    radius: np.ndarray | float,
    centre: np.ndarray,
    half: np.ndarray,
    yaw: np.ndarray | float = 0.0,
    skip_gap: float = 0.0,
) -> np.ndarray:
    """Return the travel of a sphere of `radius` until it meets a box turned by `yaw` about the vertical.

    `origin`, unit `direction`, `centre`, `half` (half extents): [..., 3]; `yaw`: [...] rad, clockwise.
    """
    return cast_boxes(_to_box(origin - centre, yaw), _to_box(direction, yaw), radius, half, skip_gap)


def cast_boxes(
    local: np.ndarray,
    direction: np.ndarray,
    radius: np.ndarray | float,
    half: np.ndarray,
    skip_gap: float = 0.0,
) -> np.ndarray:
    """Return the travel of a sphere until it meets a box, in the box's own frame (any orientation).

    `local`: origins relative to the box's centre, `direction`: unit, `half`: half extents; [..., 3].
    The sphere's centre meets the box rounded by `radius`: its faces (the entry into the larger box, where
    that lies on a face), else one of the capsules around the three edges next to the entry.
    """
    travel, within = _enter_slabs(local, direction, half, radius)
    touching = _beyond(local, half) < np.square(radius + skip_gap)
    edge = np.isfinite(travel) & (within < 2) & ~touching
    if edge.any():
        start, ahead, extent = _pick((local, direction, half), edge)
        point = start + travel[edge][:, None] * ahead
        reach = np.broadcast_to(radius, edge.shape)[edge]
        travel[edge] = _cast_edges(start, ahead, np.copysign(extent, point), reach)
    return np.where(touching, np.inf, travel)


def passes(
    origin: np.ndarray, direction: np.ndarray, centre: np.ndarray, reach: np.ndarray | float
) -> np.ndarray:
    """Return which rays come within `reach` of `centre` ahead: a cheap test before exact casts.

    `origin`, unit `direction`, `centre`: [..., D]; `reach` [...]: radius of a sphere around a collider, the
    cast sphere's radius added; negative: never.
    """
    offset = centre - origin
    along = _dot(offset, direction)
    beside = _dot(offset, offset) - along * along
    return (beside < np.square(reach)) & (along > -np.asarray(reach)) & (np.asarray(reach) >= 0)


def flat_radius(radius: float, height: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the radius at which a horizontally cast sphere meets an upright body, 0 if it passes by.

    `height` of the sphere's centre; the body reaches from `low` to `high`: sqrt(radius^2 - gap^2).
    """
    gap = np.maximum(np.maximum(low - height, height - high), 0.0)
    return np.sqrt(np.maximum(radius**2 - gap**2, 0.0))


def _cast_edges(
    local: np.ndarray, direction: np.ndarray, corner: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return the travel until the rounding of the three edges that meet in `corner`; all [n, 3]."""
    travel = np.full(len(local), np.inf)
    for axis in range(3):
        low, high = corner.copy(), corner.copy()
        low[:, axis], high[:, axis] = -np.abs(corner[:, axis]), np.abs(corner[:, axis])
        travel = np.minimum(travel, cast_capsules(local, direction, radius, low, high, 0.0))
    return travel


def _enter_slabs(
    local: np.ndarray, direction: np.ndarray, half: np.ndarray, radius: np.ndarray | float
) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays enter boxes of half extents `half + radius` (inf: they miss), and where on them.

    The second array counts the axes on which the point of entry lies within `half`. A ray that starts
    inside the larger box, outside its rounding, enters at its start. Works axis by axis: arrays of a
    short last axis are slow.
    """
    axes = [(local[..., i], direction[..., i], half[..., i]) for i in range(half.shape[-1])]
    enter: np.ndarray | float = 0.0
    leave: np.ndarray | float = np.inf
    for o, d, h in axes:
        # A ray along a face gets a tiny slope: its slab is left before the start, or not within reach.
        inverse = 1.0 / np.where(np.abs(d) < _TINY, _TINY, d)
        middle, width = -o * inverse, np.abs(inverse) * (h + radius)
        enter = np.maximum(enter, middle - width)
        leave = np.minimum(leave, middle + width)

    within = sum((np.abs(o + enter * d) <= h).astype(np.int8) for o, d, h in axes)
    return np.where(enter <= leave, enter, np.inf), np.asarray(within)


def _entry(b: np.ndarray, c: np.ndarray, touching: np.ndarray | bool) -> np.ndarray:
    """Return the first root t >= 0 of t^2 + 2 b t + c = 0, inf if there is none or c is inside already."""
    root = b * b - c
    hits = (root >= 0) & (b < 0) & (c >= 0) & ~np.asarray(touching)
    return np.where(hits, -b - np.sqrt(np.maximum(root, 0.0)), np.inf)


def _to_box(vector: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
    """Rotate (x, z) or (x, y, z) into the frame of a box turned by `yaw`: x along right, z along forward."""
    if np.ndim(yaw) == 0 and yaw == 0:
        return vector
    s, c = np.sin(yaw), np.cos(yaw)
    x, z = vector[..., 0], vector[..., -1]
    middle = [np.broadcast_to(vector[..., 1], (x * c).shape)] if vector.shape[-1] == 3 else []
    return np.stack([x * c - z * s, *middle, x * s + z * c], axis=-1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    total = a[..., 0] * b[..., 0]
    for i in range(1, a.shape[-1]):
        total = total + a[..., i] * b[..., i]
    return total


def _beyond(local: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return the squared distances of points from boxes."""
    gaps = [np.maximum(np.abs(local[..., i]) - half[..., i], 0.0) for i in range(half.shape[-1])]
    return np.asarray(sum(gap * gap for gap in gaps))


def _pick(arrays: tuple[np.ndarray, ...], where: np.ndarray) -> list[np.ndarray]:
    """Return the rows of broadcast arrays [..., D] at a mask [...]."""
    return [np.broadcast_to(array, (*where.shape, array.shape[-1]))[where] for array in arrays]
