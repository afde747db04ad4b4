"""What PushBlock's agents see: level rays at their own height, and level rays that skim the walls' tops.

Areas are seen from above: every collider is a rectangle, met with what is left of the cast sphere's radius at
the gap in height. The offset rays run 2 m above the floor once the agent stands, where their sphere touches
the height of the walls' tops; a recording of Unity's scene (docs/scenes/PushBlock.md) shows that they report
the walls, as if by rays without width, and never the goal.
Legend: n agents, R rays, M colliders.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import cast_rectangles, flat_radius

LEVEL = RaySensor(tags=3, rays_per_side=3, max_degrees=90, length=12)
OFFSET = RaySensor(tags=3, rays_per_side=3, max_degrees=90, length=12, start_offset=1.5, end_offset=1.5)
BLOCK_TAG, GOAL_TAG, WALL_TAG = range(3)
WALL_TOP = 1.5 + 1e-5  # m; the little more stands for the depth to which an agent sinks in
GOAL_Z, GOAL_HALF = -10.5, (12.5, 2.15)  # m: x, z
WALL_GAP = 0.01  # m: nearer walls are skipped by the rays, as in recordings from Unity
BLOCK_GAP = -0.005  # a pushed block is seen at 0 m; one that has been run into is skipped while it overlaps

# x, z of centres and half sizes: the walls right, left, ahead, behind; then the goal
_CENTRES = np.array([(12.75, 0), (-12.75, 0), (0, 12.75), (0, -12.75), (0, GOAL_Z)])
_HALVES = np.array([(0.25, 13), (0.25, 13), (12.5, 0.25), (12.5, 0.25), GOAL_HALF])
_NUM_WALLS = 4
_TAGS = np.array([WALL_TAG] * _NUM_WALLS + [GOAL_TAG, BLOCK_TAG])


def see(
    position: np.ndarray, yaw: np.ndarray, block: np.ndarray, block_half: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return one frame of the offset rays and of the level rays, float32 [n, 35] each.

    `position` [n, 3] and `yaw` [n] of the agents; `block`, `block_half` [n, 3]: centres and half sizes.
    """
    origin, direction = LEVEL.casts(position, yaw)
    height = origin[:, :, :, 1]
    start, way = origin[..., ::2], direction[..., ::2]
    distance = np.empty((*direction.shape[:2], len(_TAGS)))

    # Walls and goal reach above a level ray, so that the whole sphere meets them.
    distance[:, :, :-1] = cast_rectangles(start, way, LEVEL.radius, _CENTRES, _HALVES, skip_gap=WALL_GAP)
    low, high = block[:, 1] - block_half[:, 1], block[:, 1] + block_half[:, 1]
    radius = flat_radius(LEVEL.radius, height, low[:, None, None], high[:, None, None])
    distance[:, :, -1:] = cast_rectangles(
        start,
        way,
        radius,
        block[:, None, None, ::2],
        block_half[:, None, None, ::2],
        skip_gap=BLOCK_GAP,
    )

    radius = flat_radius(OFFSET.radius, height + OFFSET.start_offset, np.float64(-0.5), np.float64(WALL_TOP))
    above = cast_rectangles(start, way, radius, _CENTRES[:_NUM_WALLS], _HALVES[:_NUM_WALLS])
    return OFFSET.encode(above, _TAGS[:_NUM_WALLS]), LEVEL.encode(distance, _TAGS)
