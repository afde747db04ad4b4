"""The laser of the food arena: a thick ray that freezes the first agent it meets.

Unity casts a sphere of radius 2 m, 25 m straight ahead from the middle of the agent; the first collider
decides, and what the sphere overlaps at its start is not seen: the floor always, the walls (one collider all
around) from 2 m, other things from about 2 m.

Legend: N areas, A agents and F balls of an area, S shots. Heights only change how wide a thing is for the
ray, because the ray is level.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.grid_food_collector.physics import BALL_RADIUS, WALL, FoodPhysics

RADIUS, LENGTH = 2.0, 25.0  # m
NOBODY = -1
_CORNERS = np.array([[1.0, 1.0, -1.0, -1.0], [1.0, -1.0, 1.0, -1.0]])[:, :, None]


def targets(physics: FoodPhysics, yaw: np.ndarray, shooting: np.ndarray) -> np.ndarray:
    """Return the agent int [N, A] that each shot of `shooting` bool [N, A] meets first, else -1.

    `yaw` [N, A], rad, clockwise seen from above, is that of shooters and targets.
    """
    hit = np.full(shooting.shape, NOBODY)
    area, shooter = np.nonzero(shooting)
    start = physics.agent_position[:, area, shooter]
    ahead = np.stack([np.sin(yaw[area, shooter]), np.cos(yaw[area, shooter])])

    offset = physics.agent_position[:, area] - start[:, :, None]
    travel = _to_boxes(offset, physics.agent_half[area], yaw[area], ahead)
    # No shot meets its shooter.
    travel[np.arange(area.size), shooter] = np.inf

    nearest = travel.argmin(axis=1)
    travel = travel[np.arange(area.size), nearest]
    meets = np.flatnonzero(travel <= LENGTH)
    if not meets.size:
        return hit

    # Balls and walls matter only to shots that reach an agent.
    start, ahead, balls = start[:, meets], ahead[:, meets], physics.ball_position[:, area[meets]]
    blocked = np.minimum(_to_balls(balls - start[:, :, None], ahead), _to_walls(start, ahead))
    meets = meets[travel[meets] <= blocked]
    hit[area[meets], shooter[meets]] = nearest[meets]

    return hit


def _to_boxes(offset: np.ndarray, half: np.ndarray, yaw: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the way [S, A], m, of the sphere to cubes at `offset` [3, S, A]; inf: never, or met at once.

    Seen from above a cube swollen by the sphere is two rectangles and four discs.
    """
    ways = np.full(yaw.shape, np.inf)
    dx, dz = ahead[:, :, None]
    along, aside = offset[0] * dx + offset[2] * dz, np.abs(offset[0] * dz - offset[2] * dx)

    # At any yaw a cube lies within the circle through its corners.
    reach = RADIUS + np.sqrt(2) * half
    near = (along > 0) & (along < LENGTH + reach) & (aside < reach)
    if not near.any():
        return ways

    shot = np.nonzero(near)[0]
    half, sin, cos = half[near], np.sin(yaw[near]), np.cos(yaw[near])
    x, height, z = offset[:, near]  # from here on in the cube's frame
    # The sphere counts with the disc that is left of it at the gap in height.
    height = np.maximum(np.abs(height) - half, 0.0)
    radius = np.sqrt(np.maximum(RADIUS**2 - height * height, 0.0))
    x, z = z * sin - x * cos, -x * sin - z * cos  # from the cube to the shooter
    dx, dz = ahead[0, shot] * cos - ahead[1, shot] * sin, ahead[0, shot] * sin + ahead[1, shot] * cos

    wide = half + radius
    rectangles = _to_rectangles(x, z, dx, dz, np.array([wide, half]), np.array([half, wide]))
    discs = _to_discs(_CORNERS[0] * half - x, _CORNERS[1] * half - z, dx, dz, radius)
    way = np.minimum(rectangles.min(axis=0), discs.min(axis=0))

    # What the sphere overlaps at its start is not seen.
    outside = np.maximum(np.abs(x) - half, 0.0) ** 2 + np.maximum(np.abs(z) - half, 0.0) ** 2
    ways[near] = np.where((outside > radius * radius) & (radius > 0), way, np.inf)

    return ways


def _to_balls(offset: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the way [S], m, to the first ball at `offset` [3, S, F]."""
    square = (RADIUS + BALL_RADIUS) ** 2 - offset[1] ** 2
    radius = np.sqrt(np.maximum(square, 0.0))
    way = _to_discs(offset[0], offset[2], ahead[0][:, None], ahead[1][:, None], radius)
    outside = offset[0] ** 2 + offset[2] ** 2 > square
    return np.where(outside & (square > 0), way, np.inf).min(axis=1, initial=np.inf)


def _to_walls(start: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the way [S], m, to the first wall."""
    place = start[::2]
    room = WALL - RADIUS - np.sign(ahead) * place
    way = (room / np.maximum(np.abs(ahead), 1e-12)).min(axis=0)
    return np.where(np.abs(place).max(axis=0) < WALL - RADIUS, way, np.inf)


def _to_discs(x: np.ndarray, z: np.ndarray, dx: np.ndarray, dz: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Return the way along (dx, dz) from the origin into discs at (x, z); inf: never."""
    along = x * dx + z * dz
    inner = radius * radius - (x * x + z * z - along * along)
    way = along - np.sqrt(np.maximum(inner, 0.0))
    return np.where((inner >= 0) & (way >= 0), way, np.inf)


def _to_rectangles(
    x: np.ndarray, z: np.ndarray, dx: np.ndarray, dz: np.ndarray, half_x: np.ndarray, half_z: np.ndarray
) -> np.ndarray:
    """Return the way along (dx, dz) from (x, z) into rectangles around the origin; inf: never."""
    slow_x, slow_z = (np.where(np.abs(step) < 1e-12, 1e-12, step) for step in (dx, dz))
    middle_x, middle_z = -x / slow_x, -z / slow_z
    reach_x, reach_z = half_x / np.abs(slow_x), half_z / np.abs(slow_z)
    enter = np.maximum(middle_x - reach_x, middle_z - reach_z)
    leave = np.minimum(middle_x + reach_x, middle_z + reach_z)
    return np.where((enter <= leave) & (enter >= 0), enter, np.inf)
