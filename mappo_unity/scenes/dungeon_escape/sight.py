"""What DungeonEscape's agents see: one frame of their ray sensor.

All rays are horizontal, so upright boxes are cut at the agent's height: rectangles and circles in the plane,
with the radius of the cast sphere that is left at the gap in height.
Legend: n agents, R rays, M colliders.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP
from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import cast_rectangles, cast_spheres, flat_radius, passes
from mappo_unity.scenes.dungeon_escape.layout import (
    AGENT_HALF,
    CARRIED_KEY,
    COLUMN,
    COLUMN_BASE_HALF,
    COLUMN_RADIUS,
    DRAGON,
    HALVES,
    KEY,
    KEY_HALF,
    LOCK,
    NUM_AGENTS,
    PORTAL,
    TOMB,
    TOMB_DROP,
    TOMB_LOWER_HALF,
    TOMB_UPPER_HALF,
    WALL,
)
from mappo_unity.scenes.dungeon_escape.room import DungeonRoom

WALL_TAG, AGENT_TAG, DRAGON_TAG, KEY_TAG, LOCK_TAG, PORTAL_TAG = range(6)
EYES = RaySensor(tags=6, rays_per_side=7, max_degrees=60, length=40)

_COLUMNS = np.array([[x, z] for x in (COLUMN[0], -COLUMN[0]) for z in (COLUMN[1], -COLUMN[1])])
_BASES = np.insert(_COLUMNS, 1, 0.0, axis=1)
_THINGS = [LOCK, PORTAL, DRAGON, KEY, TOMB]
_NUM_BASES, _NUM_BOXES = len(_BASES), len(_BASES) + len(_THINGS) + 2 + NUM_AGENTS
_HALVES = np.array(
    [
        *[COLUMN_BASE_HALF] * _NUM_BASES,
        *HALVES[[LOCK, PORTAL, DRAGON, KEY]],
        TOMB_UPPER_HALF,
        TOMB_LOWER_HALF,
        KEY_HALF,
        *[AGENT_HALF] * NUM_AGENTS,
    ]
)
_TAGS = np.array(
    [WALL_TAG] * _NUM_BASES
    + [LOCK_TAG, PORTAL_TAG, DRAGON_TAG, KEY_TAG, WALL_TAG, WALL_TAG, KEY_TAG]
    + [AGENT_TAG] * NUM_AGENTS
    + [WALL_TAG] * 2
)  # columns with their bases, boxes, the walls across and along
_COLUMN_REACH = COLUMN_RADIUS + EYES.radius


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
    # A column's shaft is met at every height, its base only low down.
    reach[:, :_NUM_BASES] = np.maximum(reach[:, :_NUM_BASES], _COLUMN_REACH)

    centre = centre[..., ::2]
    # Only pairs of a ray and a box that it can meet are looked at closely.
    agent, ray, box = np.nonzero(passes(origin, direction, centre[:, None], reach[:, None]))
    start, ahead, middle = origin[agent, 0, 0], direction[agent, ray, 0], centre[agent, box]
    travel = cast_rectangles(
        start, ahead, radius[agent, box], middle, _HALVES[box, ::2], yaw[agent, box], CONTACT_GAP
    )

    column = np.flatnonzero(box < _NUM_BASES)  # round above its square base
    shaft = cast_spheres(start[column], ahead[column], middle[column], _COLUMN_REACH, CONTACT_GAP)
    travel[column] = np.minimum(travel[column], shaft)
    distance[agent, ray, box] = travel

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
    shape = (len(enabled), _NUM_BOXES - NUM_AGENTS)  # first what all agents of an area see, [N, M - A]
    things = slice(_NUM_BASES, _NUM_BASES + len(_THINGS))
    centre, yaw, present = np.empty((*shape, 3)), np.zeros(shape), np.ones(shape, bool)

    centre[:, :_NUM_BASES] = _BASES
    centre[:, things], yaw[:, things] = room.thing[:, _THINGS], room.thing_yaw[:, _THINGS]
    present[:, things] = room.present[:, _THINGS]

    dragon_yaw = room.thing_yaw[:, DRAGON]
    # The dragon carries its key before it: from the front rays meet the key first.
    centre[:, -2:] = room.thing[:, [TOMB, DRAGON]]  # the tombstone's lower box, the dragon's key
    centre[:, -2:, 1] += (-TOMB_DROP, CARRIED_KEY[1])
    centre[:, -1, 0] += CARRIED_KEY[0] * np.sin(dragon_yaw)
    centre[:, -1, 2] += CARRIED_KEY[0] * np.cos(dragon_yaw)
    yaw[:, -2:], present[:, -2:] = room.thing_yaw[:, [TOMB, DRAGON]], room.present[:, [TOMB, DRAGON]]

    areas = slots // NUM_AGENTS
    others = np.arange(NUM_AGENTS) != (slots % NUM_AGENTS)[:, None]  # one's own eyes are inside one's body

    return (
        np.concatenate([centre, room.position.reshape(-1, NUM_AGENTS, 3)], axis=1)[areas],
        np.concatenate([yaw, room.yaw.reshape(-1, NUM_AGENTS)], axis=1)[areas],
        np.concatenate([present[areas], enabled[areas] & others], axis=1),
    )
