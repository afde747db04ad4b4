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
    LOCK,
    NUM_AGENTS,
    PORTAL,
    PORTAL_YAW,
    WALL,
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
from mappo_unity.scenes.rays import RaySensor, cast_rectangles, cast_spheres, flat_radius, passes

WALL_TAG, AGENT_TAG, DRAGON_TAG, KEY_TAG, LOCK_TAG, PORTAL_TAG = range(6)
EYES = RaySensor(tags=6, rays_per_side=7, max_degrees=60, length=40)
CARRIED_KEY = (0.94, -0.37)  # m ahead of the dragon's centre and above it

_COLUMNS = np.array([[x, z] for x in (COLUMN[0], -COLUMN[0]) for z in (COLUMN[1], -COLUMN[1])])
# Boxes along the axes (lock, the columns' bases): centre, half extents. Then boxes with a yaw.
_STILL = np.array([[0.015, 1.385, 12.6, *HALVES[LOCK]], *([x, 0, z, 0.85, 0.185, 0.85] for x, z in _COLUMNS)])
_TURNED_HALVES = np.array(
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
_HALVES = np.concatenate([_STILL[:, 3:], _TURNED_HALVES])
_NUM_STILL, _NUM_BOXES = len(_STILL), len(_HALVES)
_TAGS = np.array(
    [LOCK_TAG]
    + [WALL_TAG] * len(_COLUMNS)
    + [PORTAL_TAG, *[AGENT_TAG] * NUM_AGENTS, DRAGON_TAG, KEY_TAG, KEY_TAG, WALL_TAG, WALL_TAG]
    + [WALL_TAG] * len(_COLUMNS)
    + [WALL_TAG] * 2
)  # boxes, columns, the walls across and along


def see(room: DungeonRoom, slots: np.ndarray, enabled: np.ndarray) -> np.ndarray:
    """Return one frame of the rays of `slots` [n], float32 [n, 120]; `enabled` bool [N, A]."""
    origin, direction = EYES.casts(room.position[slots], room.yaw[slots])
    height = origin[:, 0, :, 1]  # [n, 1]
    origin, direction = origin[..., ::2], direction[..., ::2]  # [n, 1, 1, 2], [n, R, 1, 2]
    distance = np.full((*direction.shape[:2], len(_TAGS)), np.inf)
    centre, yaw, present = _boxes(room, slots, enabled)
    low, high = centre[..., 1] - _HALVES[:, 1], centre[..., 1] + _HALVES[:, 1]
    radius = np.where(present, flat_radius(EYES.radius, height, low, high), 0.0)  # [n, M]
    reach = np.where(radius > 0, radius + np.hypot(_HALVES[:, 0], _HALVES[:, 2]), -1.0)
    centre = centre[..., ::2]
    agent, ray, box = np.nonzero(passes(origin, direction, centre[:, None], reach[:, None]))
    distance[agent, ray, box] = cast_rectangles(
        origin[agent, 0, 0],
        direction[agent, ray, 0],
        radius[agent, box],
        centre[agent, box],
        _HALVES[box, ::2],
        yaw[agent, box],
        CONTACT_GAP,
    )
    columns = cast_spheres(origin, direction, _COLUMNS, COLUMN_RADIUS + EYES.radius, CONTACT_GAP)
    distance[:, :, _NUM_BOXES:-2] = columns
    distance[:, :, -2:] = _cast_walls(origin[:, :, 0], direction[:, :, 0])
    return EYES.encode(distance, _TAGS)


def _cast_walls(origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the travel [n, R, 2] to the wall ahead along x and along z, met from inside."""
    # A ray that a touched wall lets through passes the ends of the other walls, 13 m from the middle.
    gap = WALL - np.sign(direction) * origin - EYES.radius
    travel = gap / np.maximum(np.abs(direction), 1e-12)
    beside = np.abs(origin[..., ::-1] + travel * direction[..., ::-1])  # the other coordinate by then
    return np.where((gap < CONTACT_GAP) | (beside > 13.0), np.inf, travel)


def _boxes(
    room: DungeonRoom, slots: np.ndarray, enabled: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres [n, M, 3], yaws and presence [n, M] of the boxes of `_HALVES`."""
    first, areas = _NUM_STILL, slots // NUM_AGENTS
    centre = np.empty((len(slots), _NUM_BOXES, 3))
    yaw = np.zeros(centre.shape[:2])
    present = np.ones(centre.shape[:2], bool)
    ahead = np.stack([np.sin(room.dragon_yaw), np.zeros(len(enabled)), np.cos(room.dragon_yaw)], axis=1)
    carried = room.dragon_position + CARRIED_KEY[0] * ahead + (0.0, CARRIED_KEY[1], 0.0)
    lower = room.tomb_position - (0.0, TOMB_DROP, 0.0)
    centre[:, :first] = _STILL[:, :3]
    centre[:, first], yaw[:, first] = (11.83, 1.83, -11.77), PORTAL_YAW
    agents = slice(first + 1, first + 1 + NUM_AGENTS)
    centre[:, agents] = room.position.reshape(-1, NUM_AGENTS, 3)[areas]
    yaw[:, agents] = room.yaw.reshape(-1, NUM_AGENTS)[areas]
    present[:, agents] = enabled[areas]
    present[np.arange(len(slots)), agents.start + slots % NUM_AGENTS] = False  # the eyes are inside it
    bodies = (
        (room.dragon_position, room.dragon_yaw, room.dragon_present),
        (carried, room.dragon_yaw, room.dragon_present),
        (room.key_position, room.key_yaw, room.key_present),
        (room.tomb_position, room.tomb_yaw, room.tomb_present),
        (lower, room.tomb_yaw, room.tomb_present),
    )
    for number, (place, turn, there) in enumerate(bodies, start=agents.stop):
        centre[:, number], yaw[:, number], present[:, number] = place[areas], turn[areas], there[areas]
    return centre, yaw, present
