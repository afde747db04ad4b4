"""What Pyramids' agents see: three ray sensors at three pitches.

Legend: n agents, R = 21 rays (seven a sensor), M colliders: still boxes along the axes, switch, cubes.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP
from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import cast_boxes, cast_upright_boxes, passes
from mappo_unity.scenes.pyramids.bodies import NUM_STONES, SWITCH_HALF, PyramidsBodies
from mappo_unity.scenes.pyramids.bricks import HALVES, NUM_BODIES, PyramidsBricks
from mappo_unity.scenes.pyramids.layout import BRICKS, INNER_WALLS, OUTER_WALLS, STONE_LAYERS

BLOCK_TAG, WALL_TAG, GOAL_TAG, SWITCH_OFF_TAG, SWITCH_ON_TAG, STONE_TAG = range(6)
EYES = tuple(
    RaySensor(tags=6, rays_per_side=3, max_degrees=degrees, length=35, end_offset=rise)
    for degrees, rise in ((70, 0), (65, 5), (75, 10))
)

_NUM_WALLS = len(OUTER_WALLS) + len(INNER_WALLS)
_NUM_STILL = _NUM_WALLS + NUM_STONES * len(STONE_LAYERS)
_WALL_CENTRES = np.concatenate([OUTER_WALLS[:, :3], INNER_WALLS[:, :3]])
_STILL_HALVES = np.concatenate(
    [OUTER_WALLS[:, 3:], INNER_WALLS[:, 3:], np.tile(STONE_LAYERS[:, 3:6], (NUM_STONES, 1))]
)
_UPRIGHT_HALVES = np.concatenate([_STILL_HALVES, [SWITCH_HALF]])
_RADIUS = np.repeat([eyes.cast_radius for eyes in EYES], [eyes.num_rays for eyes in EYES])  # [R]
_TAGS = np.array(
    [WALL_TAG] * _NUM_WALLS
    + [STONE_TAG] * (_NUM_STILL - _NUM_WALLS)
    + [SWITCH_OFF_TAG]
    + [BLOCK_TAG] * len(BRICKS)
    + [GOAL_TAG]
)


def see(
    bodies: PyramidsBodies, bricks: PyramidsBricks, switch_on: np.ndarray, areas: np.ndarray
) -> list[np.ndarray]:
    """Return one frame of each sensor of the agents of `areas` [n], three arrays float32 [n, 56].

    `switch_on` bool [N]: which switches are pressed.
    """
    casts = [eyes.casts(bodies.position[areas], bodies.yaw[areas]) for eyes in EYES]
    origin = casts[0][0][:, 0, 0]  # [n, 3]: all start at the agent's centre
    direction = np.concatenate([cast[1] for cast in casts], axis=1)[:, :, 0]  # [n, R, 3]

    distance = np.full((*direction.shape[:2], len(_TAGS)), np.inf)
    _cast_upright(bodies, areas, origin, direction, distance)

    piles = np.flatnonzero(bricks.present[areas])
    if piles.size:
        distance[piles, :, -NUM_BODIES:] = _cast_cubes(
            bricks.bodies[areas[piles]], origin[piles], direction[piles]
        )

    # a switch's tag says whether it is on; the other tags never change
    tags = np.tile(_TAGS, (len(areas), 1))
    tags[:, _NUM_STILL] = np.where(switch_on[areas], SWITCH_ON_TAG, SWITCH_OFF_TAG)

    ends = np.cumsum([eyes.num_rays for eyes in EYES])
    return [
        eyes.encode(distance[:, end - eyes.num_rays : end], tags)
        for eyes, end in zip(EYES, ends, strict=True)
    ]


def _cast_upright(
    bodies: PyramidsBodies, areas: np.ndarray, origin: np.ndarray, direction: np.ndarray, distance: np.ndarray
) -> None:
    """Write the travel to walls, stones and switches into `distance` [n, R, M]."""
    centre = np.empty((len(areas), _NUM_STILL + 1, 3))
    centre[:, :_NUM_WALLS] = _WALL_CENTRES

    stones = centre[:, _NUM_WALLS:_NUM_STILL].reshape(len(areas), NUM_STONES, len(STONE_LAYERS), 3)  # a view
    stones[..., ::2] = bodies.stone_root[areas][:, :, None] + STONE_LAYERS[:, [0, 2]]
    stones[..., 1] = bodies.stone_heights(areas)[:, None]

    centre[:, _NUM_STILL] = bodies.switch_position[areas]
    yaw = np.zeros(centre.shape[:2])
    yaw[:, _NUM_STILL] = bodies.switch_yaw[areas]

    # most rays pass most boxes by: only the others are cast
    agent, ray, box = np.nonzero(_passes_plan(origin, direction, centre))
    distance[agent, ray, box] = cast_upright_boxes(
        origin[agent],
        direction[agent, ray],
        _RADIUS[ray],
        centre[agent, box],
        _UPRIGHT_HALVES[box],
        yaw[agent, box],
        CONTACT_GAP,
    )


def _passes_plan(origin: np.ndarray, direction: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return bool [n, R, M]: which rays come near which upright box [n, M], seen from above."""
    flat = direction[..., ::2] / np.sqrt((direction[..., ::2] ** 2).sum(axis=-1, keepdims=True))
    reach = np.hypot(_UPRIGHT_HALVES[:, 0], _UPRIGHT_HALVES[:, 2]) + _RADIUS.max()
    return passes(origin[:, None, None, ::2], flat[:, :, None], centre[:, None, :, ::2], reach)


def _cast_cubes(poses: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the travel [m, R, B] to the cubes of piles, `poses` [m, B, 7] (x y z, quaternion w first)."""
    distance = np.full((*direction.shape[:2], NUM_BODIES), np.inf)

    reach = np.sqrt((HALVES**2).sum(axis=1)) + _RADIUS.max()
    near = passes(origin[:, None, None], direction[:, :, None], poses[:, None, :, :3], reach)
    agent, ray, cube = np.nonzero(near)

    turn = poses[agent, cube, 3:]
    local = _into_frame(turn, origin[agent] - poses[agent, cube, :3])
    ahead = _into_frame(turn, direction[agent, ray])

    distance[agent, ray, cube] = cast_boxes(local, ahead, _RADIUS[ray], HALVES[cube], CONTACT_GAP)
    return distance


def _into_frame(quaternion: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors [n, 3] rotated by the inverse of unit quaternions [n, 4] (w, x, y, z).

    v + w t + u x t, with u = -(x, y, z) and t = 2 u x v.
    """
    u = -quaternion[:, 1:]
    t = 2.0 * np.cross(u, vector)
    return vector + quaternion[:, :1] * t + np.cross(u, t)
