"""Where DungeonEscape's agents begin: random spots that no body is near.

In: the bodies of an area. Out: new poses. Knows no rules.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mappo_unity.scenes.ground import box_gap

if TYPE_CHECKING:
    from mappo_unity.scenes.dungeon_room import DungeonRoom

RANGE = 6.25  # m: x and z of a spot, half the floor's half-width
SPAWN_Y = 1.0
QUERY_HALF = (2.5, 0.01, 2.5)  # m: an axis-aligned box around the spot that nothing may overlap
COLUMN = np.array([4.5, 4.0])  # x, z of one of the four columns
COLUMN_RADIUS = 0.718
CARRIED_KEY_HALF = (0.605, 0.23, 0.09)  # the free key's, too
TOMB_DROP = 0.85  # of the tombstone's lower box below the upper one
TOMB_UPPER_HALF = (0.525, 0.71, 0.165)
TOMB_LOWER_HALF = (0.605, 0.22, 0.26)
BODY_HALVES = np.array(
    [
        [0.5, 0.5, 0.5],
        [0.5, 0.5, 0.5],
        [0.5, 0.5, 0.5],
        [0.75, 0.75, 0.75],
        CARRIED_KEY_HALF,
        TOMB_LOWER_HALF,
        TOMB_UPPER_HALF,
    ]
)  # three agents, dragon, free key, the tombstone's lower and upper box
TRIES = 16  # drawn at once


def spawn_agents(room: DungeonRoom, areas: np.ndarray, rng: np.random.Generator, enabled: np.ndarray) -> None:
    """Place the agents of `areas` [n] one after the other, at rest, with a random heading.

    Bodies in the way, as in Unity: columns; agents, those not yet moved where they were (one's own body,
    too); the dragon, key and tombstone of the ended episode. `enabled` bool [N, A].
    """
    num_agents = enabled.shape[1]
    centre, yaw, present = _bodies(room, areas, enabled)
    for number in range(num_agents):
        slots = areas * num_agents + number
        spot = _free_spots(rng, centre, yaw, present)
        room.position[slots] = centre[:, number] = spot
        room.yaw[slots] = yaw[:, number] = rng.uniform(0.0, 2 * np.pi, len(areas))
        room.velocity[slots] = 0.0
        present[:, number] = True


def _bodies(
    room: DungeonRoom, areas: np.ndarray, enabled: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres [n, 7, 3], yaws [n, 7] and presence [n, 7] in the order of `BODY_HALVES`."""
    tomb = room.tomb_position[areas]
    num_areas, num_agents = enabled.shape
    agents = room.position.reshape(num_areas, num_agents, 3)[areas]
    others = (room.dragon_position[areas], room.key_position[areas], tomb - [0.0, TOMB_DROP, 0.0], tomb)
    centre = np.concatenate([agents, np.stack(others, axis=1)], axis=1)
    tomb_yaw = room.tomb_yaw[areas]
    turns = (room.dragon_yaw[areas], room.key_yaw[areas], tomb_yaw, tomb_yaw)
    yaw = np.concatenate([room.yaw.reshape(num_areas, num_agents)[areas], np.stack(turns, axis=1)], axis=1)
    there = (room.dragon_present, room.key_present, room.tomb_present, room.tomb_present)
    present = np.concatenate([enabled[areas], np.stack(there, axis=1)[areas]], axis=1)
    return centre, yaw, present


def _free_spots(
    rng: np.random.Generator, centre: np.ndarray, yaw: np.ndarray, present: np.ndarray
) -> np.ndarray:
    """Return a free spot [n, 3] for each of n areas: the first of uniform draws that overlaps nothing."""
    spot = np.full((len(centre), 3), SPAWN_Y)
    todo = np.arange(len(centre))
    while todo.size:
        drawn = np.full((len(todo), TRIES, 3), SPAWN_Y)
        drawn[:, :, ::2] = rng.uniform(-RANGE, RANGE, (len(todo), TRIES, 2))
        free = _is_free(drawn, centre[todo], yaw[todo], present[todo])
        found = free.any(axis=1)
        spot[todo[found]] = drawn[found, free[found].argmax(axis=1)]
        todo = todo[~found]
    return spot


def _is_free(spot: np.ndarray, centre: np.ndarray, yaw: np.ndarray, present: np.ndarray) -> np.ndarray:
    """Return bool [n, T]: at which spots [n, T, 3] the query box overlaps no column and no body [n, 7]."""
    beside = np.maximum(np.abs(np.abs(spot[:, :, ::2]) - COLUMN) - QUERY_HALF[0], 0.0)
    free = (beside**2).sum(axis=-1) > COLUMN_RADIUS**2
    shape = (*free.shape, len(BODY_HALVES))
    offset = (centre[:, None] - spot[:, :, None]).reshape(-1, 3)
    turned = np.broadcast_to(yaw[:, None], shape).ravel()
    halves = np.broadcast_to(BODY_HALVES, (*shape, 3)).reshape(-1, 3)
    gap, _ = box_gap(offset, turned, halves, QUERY_HALF)
    return free & ~((gap.reshape(shape) < 0.0) & present[:, None]).any(axis=-1)
