"""The two ray sensors of WallJump: level at the agent's height, and upward from above it.

The floor (not a listed tag) and what an agent stands on are not seen. Area coordinates: x right, y up,
z forward; metres.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import cast_boxes, cast_rectangles, flat_radius
from mappo_unity.scenes.wall_jump.bodies import (
    BLOCK_HALF,
    FLOOR_Y,
    GOAL_CENTRE,
    GOAL_HALF,
    WALL_HALF_X,
    WALL_HALF_Z,
    WALL_Z,
)

LEVEL = RaySensor(tags=3, rays_per_side=3, max_degrees=90, length=20)
UPWARD = RaySensor(tags=3, rays_per_side=3, max_degrees=90, length=20, start_offset=2.5, end_offset=5)
TAGS = np.arange(3)  # wall, goal, block: the order of the colliders below
TOUCH_GAP = 0.01  # m: nearer colliders are skipped by the rays, as those touched in recordings from Unity


def observe_rays(
    position: np.ndarray, yaw: np.ndarray, block: np.ndarray, wall_height: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return one frame of the upward and of the level sensor, float32 [n, 35] each.

    `position`, `block` [n, 3]; `yaw` [n] rad; `wall_height` [n]: H, the wall's top is at H / 2.
    """
    centre, half = np.empty((len(yaw), 1, 3, 3)), np.empty((len(yaw), 1, 3, 3))
    centre[:, 0, 0], centre[:, 0, 1], centre[:, 0, 2] = (0.0, 0.0, WALL_Z), GOAL_CENTRE, block
    half[:, 0, 0], half[:, 0, 1], half[:, 0, 2] = (WALL_HALF_X, 0.0, WALL_HALF_Z), GOAL_HALF, BLOCK_HALF

    half[:, 0, 0, 1] = np.maximum(wall_height / 2, 0.0)
    no_wall = wall_height / 2 <= FLOOR_Y

    # level rays need rectangles in plan only, met with what the sphere's radius is at their height
    origin, direction = LEVEL.casts(position, yaw)
    low, high = (centre - half)[..., 1], (centre + half)[..., 1]
    radius = flat_radius(LEVEL.radius, origin[..., 1], low, high)
    level = cast_rectangles(
        origin[..., ::2], direction[..., ::2], radius, centre[..., ::2], half[..., ::2], skip_gap=TOUCH_GAP
    )

    origin, direction = UPWARD.casts(position, yaw)
    # rays that start above the block rise away from it: nearly always they need no cast at it
    seen = 3 if (origin[..., 1] < high[:, :, 2] + UPWARD.cast_radius).any() else 2

    local, half = (origin - centre)[:, :, :seen], half[:, :, :seen]
    upward = cast_boxes(local, direction, UPWARD.cast_radius, half, TOUCH_GAP)

    level[no_wall, :, 0] = np.inf
    upward[no_wall, :, 0] = np.inf

    return UPWARD.encode(upward, TAGS[:seen]), LEVEL.encode(level, TAGS)
