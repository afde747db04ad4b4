"""Where DungeonEscape's agents begin: random spots that no body is near."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import box_gap
from mappo_unity.scenes.dungeon_escape.layout import (
    AGENT_HALF,
    COLUMN,
    COLUMN_RADIUS,
    DRAGON,
    HALVES,
    KEY_HALF,
    NUM_AGENTS,
    TOMB_LOWER_HALF,
    TOMB_UPPER_HALF,
)

RANGE = 6.25  # m: x and z of a spot, half the floor's half-width
SPAWN_Y = 1.0
QUERY_HALF = (2.5, 0.01, 2.5)  # m: an axis-aligned box around the spot that nothing may overlap
BODY_HALVES = np.array(
    [*[AGENT_HALF] * NUM_AGENTS, HALVES[DRAGON], KEY_HALF, TOMB_UPPER_HALF, TOMB_LOWER_HALF]
)
TRIES = 16  # drawn at once


def draw_poses(
    rng: np.random.Generator, centre: np.ndarray, yaw: np.ndarray, present: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [n, A, 3] and yaws [n, A] for the agents of n areas, drawn one agent after the other.

    Bodies in the way, as in Unity: columns, and `centre` [n, 7, 3], `yaw`, `present` [n, 7] of the bodies in
    the order of `BODY_HALVES`: agents, those not yet moved where they were (one's own body, too); the
    dragon, key and tombstone of the ended episode.
    """
    centre, yaw, present = centre.copy(), yaw.copy(), present.copy()

    for number in range(NUM_AGENTS):
        centre[:, number] = _free_spots(rng, centre, yaw, present)
        yaw[:, number] = rng.uniform(0.0, 2 * np.pi, len(yaw))
        # Also one that was gone is in the way of the next, once it has a place.
        present[:, number] = True

    return centre[:, :NUM_AGENTS], yaw[:, :NUM_AGENTS]


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
    # A column is round: it is clear of the box if the box's nearest point is.
    beside = np.maximum(np.abs(np.abs(spot[:, :, ::2]) - COLUMN) - QUERY_HALF[0], 0.0)
    free = (beside**2).sum(axis=-1) > COLUMN_RADIUS**2

    shape = (*free.shape, len(BODY_HALVES))
    offset = (centre[:, None] - spot[:, :, None]).reshape(-1, 3)
    turned = np.broadcast_to(yaw[:, None], shape).ravel()
    halves = np.broadcast_to(BODY_HALVES, (*shape, 3)).reshape(-1, 3)
    gap, _ = box_gap(offset, turned, halves, QUERY_HALF)
    return free & ~((gap.reshape(shape) < 0.0) & present[:, None]).any(axis=-1)
