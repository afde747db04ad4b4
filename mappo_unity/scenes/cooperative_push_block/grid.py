"""What CooperativePushBlock's agents see: a grid of 20 x 20 cells before them, one channel a tag.

Cell (h, w) is a square of 1 m, turned with the agent, with its middle at right = 9.5 - h, ahead = w + 0.5 of
the agent: the grid's centre is 10 m ahead. Of several things in a cell the one wins whose bounding box
(along the area's axes), at its point nearest to the cell's middle, is nearest to the grid's centre. Heights
do not matter: cells reach half a metre up and down from the agent's centre, and so meet everything.
Legend: n agents that look, M bodies of an area, P bodies in the grids of agents, K cells in
which something lies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.push_block.contacts import plan_extents, turns_of

CELLS = 20
CELL_HALF = 0.5  # m
CENTRE_AHEAD = 10.0  # m
WALL, AGENT, GOAL, SMALL, LARGE, VERY_LARGE = range(6)
NUM_TAGS = 6
NOTHING = -1
INNER, OUTER = 12.5, 13.0  # m: faces of the walls
GOAL_LOW, GOAL_HIGH, GOAL_HALF_X = -12.65, -8.35, 12.5  # m: z, z, x
_GOAL = 4  # after the walls on the left, right, behind and ahead
_FIXED_TAGS = np.array([WALL] * 4 + [GOAL], np.int8)
_LOW = (-OUTER, -OUTER), (INNER, -OUTER), (-INNER, -OUTER), (-INNER, INNER), (-GOAL_HALF_X, GOAL_LOW)
_HIGH = (-INNER, OUTER), (OUTER, OUTER), (INNER, -INNER), (INNER, OUTER), (GOAL_HALF_X, GOAL_HIGH)
_FIXED_BOUNDS = np.array((_LOW, _HIGH)).swapaxes(1, 2)  # [2, 2, 5], m: low and high, x and z
_EACH_TAG = np.arange(NUM_TAGS, dtype=np.int8)[:, None, None]
_RIGHT = (CELLS - 1) / 2 - np.arange(CELLS)  # m, of h
_AHEAD = np.arange(CELLS) + CELL_HALF  # m, of w


class View(NamedTuple):
    """Where the agents that look are; arrays [n]."""

    x: np.ndarray
    z: np.ndarray
    """Place, m."""
    sin: np.ndarray
    cos: np.ndarray
    """Of the yaw, clockwise from above."""


class Bodies(NamedTuple):
    """Boxes in the grids, and the cells that they lie in."""

    cell: np.ndarray
    """int [K]: (agent * 20 + h) * 20 + w."""
    pair: np.ndarray
    """int [K]: the body, of P."""
    tag: np.ndarray
    """int8 [P]."""
    bounds: np.ndarray
    """[2, 2, P], m: low and high ends of their bounding boxes, x and z."""


def look(
    view: View, place: np.ndarray, yaw: np.ndarray, half: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Return the grids, float32 [n, 6, 20, 20].

    `place`, `half` [n, M, 2], `yaw` [n, M]: the bodies of each looking agent's area; `tag` int8 [M]; `seen`
    bool [n, M]: False leaves a body out.
    """
    middle = np.empty((2, len(view.x), CELLS, CELLS))
    for part, start, right, ahead in ((0, view.x, view.cos, view.sin), (1, view.z, -view.sin, view.cos)):
        rows = start[:, None] + _RIGHT * right[:, None]
        np.add(rows[:, :, None], (_AHEAD * ahead[:, None])[:, None], out=middle[part])

    # Things are numbered: the fixed ones, then the bodies.
    spread = np.abs(view.sin) + np.abs(view.cos)  # half-width of a turned square of half-edge 1
    wall_cell, wall = _walls(view, middle, spread)
    goal_cell = _goal(middle, spread)
    goal = np.full(goal_cell.size, _GOAL)
    bodies = _bodies(view, place, yaw, half, tag, seen)

    cell = np.concatenate((wall_cell, goal_cell, bodies.cell))
    thing = np.concatenate((wall, goal, bodies.pair + len(_FIXED_TAGS)))
    tags = np.concatenate((_FIXED_TAGS, bodies.tag))[thing]
    winner = np.full(middle[0].size, NOTHING, np.int8)
    winner[cell] = tags

    # Where several things lie, written from the farthest to the nearest: the last one stays.
    contested = (np.bincount(cell, minlength=winner.size)[cell] > 1).nonzero()[0]
    cell, thing, tags = cell[contested], thing[contested], tags[contested]
    low, high = np.concatenate((_FIXED_BOUNDS, bodies.bounds), axis=2)[:, :, thing]
    point = np.minimum(np.maximum(middle.reshape(2, -1)[:, cell], low), high)
    agent = cell // CELLS**2
    away_x = point[0] - (view.x + CENTRE_AHEAD * view.sin)[agent]
    away_z = point[1] - (view.z + CENTRE_AHEAD * view.cos)[agent]
    order = np.argsort(-(away_x * away_x + away_z * away_z), kind="stable")
    winner[cell[order]] = tags[order]

    grid = winner.reshape(-1, 1, CELLS, CELLS) == _EACH_TAG
    return grid.astype(np.float32)


def _walls(view: View, middle: np.ndarray, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells with a wall, by their `middle` [2, n, 20, 20], and the number of the wall, int [K]."""
    reach = (CELL_HALF * spread)[:, None, None]
    far = np.abs(middle)
    farthest = np.maximum(far[0], far[1])
    touches = (farthest >= INNER - reach) & (farthest <= OUTER + reach) & _beside_corners(view, spread)
    cell = np.flatnonzero(touches)

    # Of the two that may meet in a corner the one in which the cell lies deeper.
    far, away = far.reshape(2, -1)[:, cell], middle.reshape(2, -1)[:, cell] > 0
    across = far[0] > far[1]
    return cell, np.where(across, away[0], 2 + away[1])


def _goal(middle: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the cells in which the goal's strip lies, by their `middle` [2, n, 20, 20]."""
    reach = (CELL_HALF * spread)[:, None, None]
    x, z = middle
    touches = (z <= GOAL_HIGH + reach) & (z >= GOAL_LOW - reach) & (np.abs(x) <= GOAL_HALF_X + reach)
    return np.flatnonzero(touches)


def _beside_corners(view: View, spread: np.ndarray) -> np.ndarray:
    """Return bool [n, 20, 20]: which cells a square of half-width 13 m around the area's middle overlaps.

    By the cells' own axes; by the area's axes their distance says it.
    """
    reach = (OUTER * spread)[:, None] + CELL_HALF
    right = _RIGHT + (view.x * view.cos - view.z * view.sin)[:, None]
    ahead = _AHEAD + (view.x * view.sin + view.z * view.cos)[:, None]
    return np.asarray((np.abs(right) <= reach)[:, :, None] & (np.abs(ahead) <= reach)[:, None])


def _bodies(
    view: View, place: np.ndarray, yaw: np.ndarray, half: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> Bodies:
    """Find the boxes in the grids, turned about the vertical, and their cells."""
    sin, cos = view.sin[:, None], view.cos[:, None]
    offset_x, offset_z = place[..., 0] - view.x[:, None], place[..., 1] - view.z[:, None]
    right, ahead = offset_x * cos - offset_z * sin, offset_x * sin + offset_z * cos
    radius = np.sqrt((half**2).sum(axis=2)) + CELL_HALF
    seen = seen & (np.abs(right) <= _RIGHT[0] + radius) & (ahead >= -radius) & (ahead <= CELLS + radius)
    agent, body = seen.nonzero()
    right, ahead, radius, half = right[seen], ahead[seen], radius[seen], half[seen]
    turn = turns_of(yaw[seen])
    turn_in_grid = turn * (view.cos + 1j * view.sin)[agent]

    # Only the cells around a body are looked at: h falls to the right.
    window = np.arange(int(2 * radius.max(initial=0.0)) + 1)
    h = np.ceil(_RIGHT[0] - right - radius).astype(np.int64)[:, None] + window
    w = np.ceil(ahead - radius - CELL_HALF).astype(np.int64)[:, None] + window
    beside = ((_RIGHT[0] - h) - right[:, None])[:, :, None]
    before = (w + CELL_HALF - ahead[:, None])[:, None]

    # Separating axes of two rectangles: the cell's two, then the body's two.
    s, c = -turn_in_grid.imag[:, None, None], turn_in_grid.real[:, None, None]
    half_x, half_z = half[:, 0, None, None], half[:, 1, None, None]
    spread = CELL_HALF * (np.abs(s) + np.abs(c))
    reach_right, reach_ahead = CELL_HALF + plan_extents(turn_in_grid, half).T[:, :, None, None]
    inside = (np.abs(beside) <= reach_right) & (np.abs(before) <= reach_ahead)
    inside &= np.abs(beside * c - before * s) <= half_x + spread
    inside &= np.abs(beside * s + before * c) <= half_z + spread
    inside &= ((h >= 0) & (h < CELLS))[:, :, None] & ((w >= 0) & (w < CELLS))[:, None]

    pair, i, j = inside.nonzero()
    cell = (agent[pair] * CELLS + h[pair, i]) * CELLS + w[pair, j]
    centre, extent = place[seen], plan_extents(turn, half)
    return Bodies(cell, pair, tag[body], np.array((centre - extent, centre + extent)).swapaxes(1, 2))
