"""Explicit contact rules of upright boxes: sliding on flat ground, pushing walls and each other.

Unity's agents are boxes that only turn about the vertical, so a contact is a plane between two upright
boxes, and a plain numpy rule replaces a rigid-body engine. It is needed where one runs, too: Unity's engine
(PhysX) lets the two friction anchors of a face carry the full Coulomb limit each, so a box slides with
0.6 + 0.6 = 1.2, and a soft-contact engine makes a fast box with that friction hop (leave its agent-floor
contact frictionless and call `slide`).

One tick (`TICK_S`) of a scene without an engine, in the order of PhysX:

    velocity += drive; velocity[:, 1] -= gravity * TICK_S; velocity *= 1 - drag * TICK_S
    gap, normal = box_gap(position - wall, yaw, half, wall_half)       # at the start of the tick
    near = gap < CONTACT_GAP
    impulse = stop(velocity[near], normal[near], gap[near])            # copies: write them back
    position += velocity * TICK_S + push_out(gap)[:, None] * normal

On level ground `slide(velocity, gravity * TICK_S * (1 - drag * TICK_S))` is all of it: per tick
v <- (v + drive) * (1 - drag * TICK_S) - 1.2 * g * TICK_S * (1 - drag * TICK_S).

Unity's axes: x right, y up, z forward, metres; yaw in radians, clockwise seen from above:
forward = (sin yaw, 0, cos yaw), right = (cos yaw, 0, -sin yaw). All arrays are float64.
"""

from __future__ import annotations

import numpy as np

TICK_S = 0.02
BOX_FRICTION = 1.2  # two anchors (faces and edges of boxes) with 0.6 each, the default material
POINT_FRICTION = 0.6  # one anchor: spheres
CONTACT_GAP = 0.02  # m: contacts and their callbacks exist from here downwards (0.01 a collider)
PUSH_OUT = 0.8  # share of a penetration that PhysX removes in a tick
MAX_PUSH_OUT = 10.0 * TICK_S  # m: at most 10 m/s; leaves no velocity behind


def slide(velocity: np.ndarray, impulse: np.ndarray | float, friction: float = BOX_FRICTION) -> None:
    """Reduce horizontal speed by at most `friction` * `impulse`, in place.

    `velocity` ``[n, 3]``, m/s. `impulse` ``[n]`` or one for all: the vertical contact impulse of the tick by
    mass, m/s, that is, the downward speed which the ground has taken; 0 for a box in the air.
    """
    flat = velocity[:, ::2]  # x and z: a view, so that `velocity` changes
    speed = np.sqrt(flat[:, 0] ** 2 + flat[:, 1] ** 2)
    loss = friction * impulse
    flat *= (np.maximum(speed - loss, 0.0) / np.maximum(speed, 1e-12))[:, None]


def plan_extent(yaw: np.ndarray, half: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the half-widths along world x and z, each ``[...]``, of boxes turned by `yaw`.

    `half`: half-sizes along the box's own right, up and forward. The extent is that of the corners, so
    x + extent is where the box touches a wall whose normal is -x.
    """
    sin, cos = np.abs(np.sin(yaw)), np.abs(np.cos(yaw))
    return half[0] * cos + half[2] * sin, half[0] * sin + half[2] * cos


def axis_gaps(
    offset: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray | tuple[float, float, float],
    other_half: np.ndarray | tuple[float, float, float],
    other_yaw: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gaps of upright boxes along all five candidate axes, and those axes.

    Separating axes of two upright boxes: the other's right, up, forward, and the box's right, forward.
    `offset` ``[n, 3]``: from the other box's centre to the box's; `yaw` ``[n]``; `half` and `other_half`,
    half-sizes ``[3]`` or ``[n, 3]`` along the boxes' own right, up, forward; `other_yaw` None: along the
    world's axes. Returns gaps ``[5, n]`` (negative: overlap) and unit normals ``[5, n, 3]`` that point from
    the other box to the box.
    """
    along, reach, sin, cos = _projections(offset, yaw, half, other_half, other_yaw)
    # Not np.sign: at an offset of 0 a normal must have length 1, too.
    sign = np.where(along < 0, -1.0, 1.0)
    normals = np.zeros((5, 3, len(offset)))
    normals[0, 0], normals[1, 1], normals[2, 2] = sign[0], sign[1], sign[2]
    normals[3, 0], normals[3, 2] = sign[3] * cos, -sign[3] * sin
    normals[4, 0], normals[4, 2] = sign[4] * sin, sign[4] * cos
    if other_yaw is not None:
        normals = _turned(normals.swapaxes(0, 1), other_yaw).swapaxes(0, 1)
    return np.abs(along) - reach, normals.swapaxes(1, 2)


def boxes_overlap(
    offset: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray | tuple[float, float, float],
    other_half: np.ndarray | tuple[float, float, float],
    other_yaw: np.ndarray | None = None,
) -> np.ndarray:
    """Return where upright boxes overlap, bool ``[n]``; arguments as for `axis_gaps`."""
    along, reach, _, _ = _projections(offset, yaw, half, other_half, other_yaw)
    return (np.abs(along) < reach).all(axis=0)


def box_gap(
    offset: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray | tuple[float, float, float],
    other_half: np.ndarray | tuple[float, float, float],
    other_yaw: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gap ``[n]`` between upright boxes (negative: depth) and its normal ``[n, 3]``.

    The axis of the largest gap, that is, of the least depth; arguments as for `axis_gaps`.
    """
    gaps, normals = axis_gaps(offset, yaw, half, other_half, other_yaw)
    axis, rows = gaps.argmax(axis=0), np.arange(len(offset))
    return gaps[axis, rows], normals[axis, rows]


def stop(
    velocity: np.ndarray,
    normal: np.ndarray,
    gap: np.ndarray,
    friction: np.ndarray | float = BOX_FRICTION,
) -> np.ndarray:
    """Stop boxes that approach something immovable, in place; return the impulse ``[n]`` by mass, m/s.

    `velocity`, `normal` ``[n, 3]``; `gap` ``[n]``, m, may still be closed within the tick. Inelastic;
    friction takes at most `friction` (``[n]`` or one for all) * impulse of the speed along the surface.
    """
    # A gap that is still open may be closed within the tick; only faster approach is stopped.
    speed = np.einsum("ni,ni->n", velocity, normal)
    impulse = np.maximum(-speed - np.maximum(gap, 0.0) / TICK_S, 0.0)
    rub = velocity - normal * speed[:, None]
    slip = np.sqrt(np.einsum("ni,ni->n", rub, rub))
    rub *= (np.minimum(friction * impulse / np.maximum(slip, 1e-12), 1.0))[:, None]
    velocity += normal * impulse[:, None]
    velocity -= rub
    return impulse


def stop_pair(
    velocity: np.ndarray,
    other_velocity: np.ndarray,
    normal: np.ndarray,
    gap: np.ndarray,
    inverse_mass: np.ndarray,
    other_inverse_mass: np.ndarray,
    friction: float = BOX_FRICTION,
) -> np.ndarray:
    """Stop two bodies from approaching by an inelastic impulse with friction, both in place.

    `velocity`, `other_velocity`, `normal` (from the other to the body) ``[n, 3]``; `gap` ``[n]``, m, may
    still be closed within the tick; `inverse_mass` ``[3]`` or ``[n, 3]``, 1/kg by axis, 0 where motion is
    frozen. Returns the normal impulse ``[n]``, kg m/s. Bodies with several contacts: call it in turns, 4-6
    times.
    """
    approach = velocity - other_velocity
    mobility = inverse_mass + other_inverse_mass
    speed = np.einsum("ni,ni->n", approach, normal)
    lack = np.maximum(-speed - np.maximum(gap, 0.0) / TICK_S, 0.0)

    impulse = lack / np.maximum((normal * normal * mobility).sum(axis=-1), 1e-12)
    push = normal * impulse[:, None]
    velocity += push * inverse_mass
    other_velocity -= push * other_inverse_mass

    # Friction stops the slip, but by no more than its share of the normal impulse.
    if friction:
        rub = approach - normal * speed[:, None]
        slip = np.sqrt(np.einsum("ni,ni->n", rub, rub))
        rub /= np.maximum(slip, 1e-12)[:, None]
        needed = slip / np.maximum((rub * rub * mobility).sum(axis=-1), 1e-12)
        rub *= np.minimum(needed, friction * impulse)[:, None]
        velocity -= rub * inverse_mass
        other_velocity += rub * other_inverse_mass
    return impulse


def push_out(gap: np.ndarray) -> np.ndarray:
    """Return how far ``[n]``, m, the engine moves overlapping bodies apart in one tick."""
    return np.minimum(PUSH_OUT * np.maximum(-gap, 0.0), MAX_PUSH_OUT)


def _projections(
    offset: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray | tuple[float, float, float],
    other_half: np.ndarray | tuple[float, float, float],
    other_yaw: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return offsets and summed extents along the five axes, ``[5, n]``, and sin, cos of the relative yaw."""
    half, other = np.asarray(half).T, np.asarray(other_half).T
    turn = yaw if other_yaw is None else yaw - other_yaw
    sin, cos = np.sin(turn), np.cos(turn)
    along, reach = np.empty((5, len(offset))), np.empty((5, len(offset)))
    x, y, z = along[:3] = offset.T if other_yaw is None else _turned(offset.T, -other_yaw)

    # The first three are the other's axes, the last two the body's own across and ahead.
    along[3] = x * cos - z * sin
    along[4] = x * sin + z * cos
    abs_sin, abs_cos = np.abs(sin), np.abs(cos)

    reach[0] = other[0] + half[0] * abs_cos + half[2] * abs_sin
    reach[1] = other[1] + half[1]
    reach[2] = other[2] + half[0] * abs_sin + half[2] * abs_cos
    reach[3] = half[0] + other[0] * abs_cos + other[2] * abs_sin
    reach[4] = half[2] + other[0] * abs_sin + other[2] * abs_cos
    return along, reach, sin, cos


def _turned(vector: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Return vectors ``[3, ..., n]`` turned clockwise (seen from above) by `yaw` ``[n]``."""
    x, y, z = vector
    sin, cos = np.sin(yaw), np.cos(yaw)
    return np.stack([x * cos + z * sin, y, z * cos - x * sin])
