"""Where agents and blocks begin: random spots that no body is near.

Unity draws a spot until a flat box around it, 1 m above the floor and along the world's axes, overlaps no
collider. An area turns by quarters only, so the box lies along the area's axes, too.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.push_block.contacts import as_complex, plan_extents, turns_of

RANGE = 6.25  # m: x and z of a spot, half the floor's half-width
SPAWN_Y = 1.0
QUERY_HALF_Y = 0.01
TRIES = 16  # drawn at once
MOST_ROUNDS = 1000  # of them; Unity would draw for ever


def draw_spots(
    rng: np.random.Generator,
    query: float,
    lowest: float,
    place: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray,
    there: np.ndarray,
) -> np.ndarray:
    """Return a free spot [n, 2] (x, z) for each of n areas: the first of uniform draws that overlaps nothing.

    `query`: half the width of the box, m; `lowest`: least z that it may reach; `place`, `half` [n, B, 2],
    `yaw`, `there` [n, B]: bodies, and which are in the way.

    Raises:
        ConfigError: none is found, since a body leaves no room.
    """
    spot = np.zeros((len(place), 2))
    todo = np.arange(len(place))

    for _ in range(MOST_ROUNDS):
        if not todo.size:
            return spot
        drawn = rng.uniform(-RANGE, RANGE, (len(todo), TRIES, 2))
        hit = _overlaps(drawn, query, place[todo], yaw[todo], half[todo]) & there[todo][:, None]
        free = ~hit.any(axis=2) & (drawn[:, :, 1] - query >= lowest)
        found = free.any(axis=1)
        spot[todo[found]] = drawn[found, free[found].argmax(axis=1)]
        todo = todo[~found]

    raise ConfigError(
        f"a block leaves no spot free in {MOST_ROUNDS * TRIES:,} draws: is env.params.block_scale too large? "
        "Unity's range is 0.5 to 4"
    )


def at_query_height(height: np.ndarray, half_y: np.ndarray) -> np.ndarray:
    """Return which bodies, by the heights of their centres, reach the spots' boxes, bool [...]."""
    return np.asarray(np.abs(height - SPAWN_Y) < half_y + QUERY_HALF_Y)


def _overlaps(
    spot: np.ndarray, query: float, place: np.ndarray, yaw: np.ndarray, half: np.ndarray
) -> np.ndarray:
    """Return bool [n, T, B]: which bodies the boxes around spots [n, T, 2] overlap."""
    offset = place[:, None] - spot[:, :, None]
    turn = turns_of(yaw)[:, None]
    sin, cos = -turn.imag, turn.real
    x, z = offset[..., 0], offset[..., 1]

    # Separating axes of two rectangles: the area's two, then the body's own two.
    extent = plan_extents(turn, as_complex(half)[:, None])
    beside = (np.abs(x) < query + extent.real) & (np.abs(z) < query + extent.imag)
    reach = query * (np.abs(sin) + np.abs(cos))
    right = np.abs(x * cos - z * sin) < half[:, None, :, 0] + reach
    ahead = np.abs(x * sin + z * cos) < half[:, None, :, 1] + reach
    return np.asarray(beside & right & ahead)
