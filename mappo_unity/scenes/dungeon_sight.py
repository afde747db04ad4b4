"""What DungeonEscape's agents see: one frame of their ray sensor.

In: the bodies of `dungeon_room.py`. Out: observations. Knows no rules.

All rays are horizontal, so upright boxes are cut at the agent's height: rectangles and circles in the plane,
with the radius of the cast sphere that is left at the gap in height.
Legend: n agents, R rays, M colliders.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.dungeon_room import (
    AGENT_HALF,
    DRAGON_HALF,
    HALVES,
    NUM_AGENTS,
    PORTAL,
    PORTAL_YAW,
    DungeonRoom,
)
from mappo_unity.scenes.dungeon_spawn import (
    CARRIED_KEY_HALF,
    COLUMN,
    COLUMN_RADIUS,
    TOMB_DROP,
    TOMB_LOWER_HALF,
    TOMB_UPPER_HALF,
)
from mappo_unity.scenes.ground import CONTACT_GAP
from mappo_unity.scenes.rays import RaySensor, cast_rectangles, cast_spheres, flat_radius

WALL_TAG, AGENT_TAG, DRAGON_TAG, KEY_TAG, LOCK_TAG, PORTAL_TAG = range(6)
EYES = RaySensor(tags=6, rays_per_side=7, max_degrees=60, length=40)
CARRIED_KEY = (0.94, -0.37)  # m ahead of the dragon's centre and above it

_COLUMNS = np.array([[x, z] for x in (COLUMN[0], -COLUMN[0]) for z in (COLUMN[1], -COLUMN[1])])
_STILL = np.array(
    [
        [-12.75, 0.0, 0.25, 13.0, -0.5, 4.5],
        [12.75, 0.0, 0.25, 13.0, -0.5, 4.5],
        [0.0, -12.75, 12.5, 0.25, -0.5, 4.5],
        [0.0, 12.75, 12.5, 0.25, -0.5, 4.5],
        [0.015, 12.6, 1.5, 0.535, 0.085, 2.685],
        *([x, z, 0.85, 0.85, -0.185, 0.185] for x, z in _COLUMNS),
    ]
)  # x, z, half extents, lowest and highest y: walls, lock, the columns' bases
_STILL_TAGS = np.array([WALL_TAG] * 4 + [LOCK_TAG] + [WALL_TAG] * 4)
_MOVING_HALVES = np.array(
    [
        HALVES[PORTAL],
        *[AGENT_HALF] * NUM_AGENTS,
        DRAGON_HALF,
        CARRIED_KEY_HALF,
        CARRIED_KEY_HALF,
        TOMB_UPPER_HALF,
        TOMB_LOWER_HALF,
    ]
)
_MOVING_TAGS = np.array(
    [PORTAL_TAG, *[AGENT_TAG] * NUM_AGENTS, DRAGON_TAG, KEY_TAG, KEY_TAG, WALL_TAG, WALL_TAG]
)
_TAGS = np.concatenate([_STILL_TAGS, _MOVING_TAGS, [WALL_TAG] * len(_COLUMNS)])


def see(room: DungeonRoom, slots: np.ndarray, enabled: np.ndarray) -> np.ndarray:
    """Return one frame of the rays of `slots` [n], float32 [n, 120]; `enabled` bool [N, A]."""
    areas = slots // NUM_AGENTS
    origin, direction = EYES.casts(room.position[slots], room.yaw[slots])
    height = origin[:, 0, :, 1]  # [n, 1]
    origin, direction = origin[..., ::2], direction[..., ::2]
    centre, yaw, present = _moving(room, areas, enabled)
    low, high = centre[..., 1] - _MOVING_HALVES[:, 1], centre[..., 1] + _MOVING_HALVES[:, 1]
    still_radius = flat_radius(EYES.radius, height, _STILL[:, 4], _STILL[:, 5])
    radius = np.where(present, flat_radius(EYES.radius, height, low, high), 0.0)
    distance = np.concatenate(
        [
            cast_rectangles(
                origin,
                direction,
                still_radius[:, None],
                _STILL[:, :2],
                _STILL[:, 2:4],
                skip_gap=CONTACT_GAP,
            ),
            cast_rectangles(
                origin,
                direction,
                radius[:, None],
                centre[:, None, :, ::2],
                _MOVING_HALVES[:, ::2],
                yaw[:, None],
                skip_gap=CONTACT_GAP,
            ),
            cast_spheres(origin, direction, _COLUMNS, COLUMN_RADIUS + EYES.radius, CONTACT_GAP),
        ],
        axis=2,
    )
    return EYES.encode(distance, _TAGS)


def _moving(
    room: DungeonRoom, areas: np.ndarray, enabled: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres [n, M, 3], yaws and presence [n, M] of the boxes of `_MOVING_HALVES`."""
    count = len(areas)
    centre = np.empty((count, len(_MOVING_HALVES), 3))
    yaw = np.empty(centre.shape[:2])
    present = np.ones(centre.shape[:2], bool)
    ahead = np.stack([np.sin(room.dragon_yaw), np.zeros(len(enabled)), np.cos(room.dragon_yaw)], axis=1)
    carried = room.dragon_position + CARRIED_KEY[0] * ahead + (0.0, CARRIED_KEY[1], 0.0)
    lower = room.tomb_position - (0.0, TOMB_DROP, 0.0)
    centre[:, 0], yaw[:, 0] = (11.83, 1.83, -11.77), PORTAL_YAW
    centre[:, 1:4] = room.position.reshape(-1, NUM_AGENTS, 3)[areas]
    yaw[:, 1:4] = room.yaw.reshape(-1, NUM_AGENTS)[areas]
    present[:, 1:4] = enabled[areas]
    bodies = (
        (room.dragon_position, room.dragon_yaw, room.dragon_present),
        (carried, room.dragon_yaw, room.dragon_present),
        (room.key_position, room.key_yaw, room.key_present),
        (room.tomb_position, room.tomb_yaw, room.tomb_present),
        (lower, room.tomb_yaw, room.tomb_present),
    )
    for number, (place, turn, there) in enumerate(bodies, start=4):
        centre[:, number], yaw[:, number], present[:, number] = place[areas], turn[areas], there[areas]
    return centre, yaw, present
