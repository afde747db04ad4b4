"""What CooperativePushBlock's agents see: a grid of 20 x 20 cells before them, one channel a tag.

Cell (h, w) is a square of 1 m, turned with the agent, with its middle at right = 9.5 - h, ahead = w + 0.5 of
the agent: the grid's centre is 10 m ahead. Of several things in a cell the one wins whose bounding box
(along the area's axes), at its point nearest to the cell's middle, is nearest to the grid's centre. Heights
do not matter: cells reach half a metre up and down from the agent's centre, and so meet everything.
Vectors in the plane are complex numbers, as in `push_block/contacts.py`.
Legend: n agents that look, M bodies of an area, P bodies in the grids of agents, K cells in
which something lies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.push_block.contacts import plan_extents

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
_EACH_TAG = np.arange(NUM_TAGS, dtype=np.int8)[:, None]
_CELL, _MIDDLE_CELL = np.arange(CELLS), (CELLS - 1) / 2
_MIDDLES = np.array((_MIDDLE_CELL - _CELL, _CELL + CELL_HALF))  # m: to the right of h, ahead of w
_MIDDLE = (_MIDDLES[0][:, None] + 1j * _MIDDLES[1]).ravel()  # of all cells, right + i ahead


class View(NamedTuple):
    """Where the agents that look are; arrays complex [n]."""

    place: np.ndarray
    """m, x + iz."""
    turn: np.ndarray
    """Their right."""


class Bodies(NamedTuple):
    """Boxes in the grids, and the cells that they lie in."""

    cell: np.ndarray
    """int [K]: (agent * 20 + h) * 20 + w."""
    body: np.ndarray
    """int [K]: which of P."""
    tag: np.ndarray
    """int8 [P]."""
    bounds: np.ndarray
    """[2, 2, P], m: low and high ends of their bounding boxes, x and z."""


def look(
    view: View, place: np.ndarray, turn: np.ndarray, half: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Return the grids, float32 [n, 6, 20, 20].

    `place`, `turn`, `half` complex [n, M]: the bodies of each looking agent's area (x + iz; their right; half
    sizes right + i forward); `tag` int8 [M]; `seen` bool [n, M]: False leaves a body out.
    """
    middle = _MIDDLE * view.turn[:, None] + view.place[:, None]

    # Things are numbered: the fixed ones, then the bodies.
    wall_cell, wall, goal_cell = _fixed(view, middle)
    goal = np.full(goal_cell.size, _GOAL)
    bodies = _bodies(view, place, turn, half, tag, seen)

    cell = np.concatenate((wall_cell, goal_cell, bodies.cell))
    thing = np.concatenate((wall, goal, bodies.body + len(_FIXED_TAGS)))
    tags = np.concatenate((_FIXED_TAGS, bodies.tag)).take(thing)
    winner = np.full(middle.size, NOTHING, np.int8)
    winner[cell] = tags

    # Where several things lie, written from the farthest to the nearest: the last one stays.
    contested = (np.bincount(cell, minlength=winner.size).take(cell) > 1).nonzero()[0]
    cell, thing, tags = cell.take(contested), thing.take(contested), tags.take(contested)
    low, high = np.concatenate((_FIXED_BOUNDS, bodies.bounds), axis=2).take(thing, axis=2)
    at = middle.reshape(-1).take(cell)
    x, z = np.minimum(np.maximum(np.array((at.real, at.imag)), low), high)
    centre = (view.place + CENTRE_AHEAD * 1j * view.turn).take(cell // CELLS**2)
    away_x, away_z = x - centre.real, z - centre.imag
    order = np.argsort(-(away_x * away_x + away_z * away_z), kind="stable")
    winner[cell.take(order)] = tags.take(order)

    grid = winner.reshape(-1, 1, CELLS**2) == _EACH_TAG
    return grid.astype(np.float32).reshape(-1, NUM_TAGS, CELLS, CELLS)


def _fixed(view: View, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the cells with a wall and the number of the wall, then the cells with the goal, int [K] each.

    `middle` complex [n, 400]: the cells' middles, m.
    """
    spread = np.abs(view.turn.real) + np.abs(view.turn.imag)  # half-width of a turned square of half-edge 1
    reach = (CELL_HALF * spread)[:, None]
    far_x, far_z = np.abs(middle.real), np.abs(middle.imag)

    # The walls make a frame around the room. Separating axes: the area's, then the cells' own.
    farthest = np.maximum(far_x, far_z)
    framed = np.abs(farthest - 0.5 * (INNER + OUTER)) <= reach + 0.5 * (OUTER - INNER)
    place = (view.place * view.turn.conj()).view(float).reshape(-1, 2, 1)  # in the grid's axes
    within = np.abs(_MIDDLES + place) <= (OUTER * spread + CELL_HALF)[:, None, None]
    framed &= (within[:, 0, :, None] & within[:, 1, None]).reshape(framed.shape)
    cell = framed.reshape(-1).nonzero()[0]

    # Of the two that may meet in a corner the one in which the cell lies deeper.
    at = middle.reshape(-1).take(cell)
    across = far_x.reshape(-1).take(cell) > far_z.reshape(-1).take(cell)
    wall = np.where(across, at.real > 0, 2 + (at.imag > 0))

    goal = np.abs(middle.imag - 0.5 * (GOAL_LOW + GOAL_HIGH)) <= reach + 0.5 * (GOAL_HIGH - GOAL_LOW)
    goal &= far_x <= GOAL_HALF_X + reach
    return cell, wall, goal.reshape(-1).nonzero()[0]


def _bodies(
    view: View, place: np.ndarray, turn: np.ndarray, half: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> Bodies:
    """Find the boxes in the grids, turned about the vertical, and their cells; arguments as for `look`."""
    # Where a body is, in cells: the middle of cell (h, w) is (h, w).
    into_grid = view.turn.conj()
    offset = (place - view.place[:, None]) * into_grid[:, None]
    radius = np.abs(half) + CELL_HALF
    at = np.array((_MIDDLE_CELL - offset.real, offset.imag - CELL_HALF))
    shown = (np.abs(at - _MIDDLE_CELL) <= radius + _MIDDLE_CELL).all(axis=0) & seen
    row = shown.reshape(-1).nonzero()[0]
    agent, body = np.divmod(row, shown.shape[1])
    place, turn, half, radius = (part.reshape(-1).take(row) for part in (place, turn, half, radius))
    at = at.reshape(2, -1).take(row, axis=1)

    # Only the cells around a body are looked at.
    window = np.arange(int(2 * radius.max(initial=0.0)) + 1)
    index = np.ceil(at - radius)[:, :, None] + window
    beside, before = away = index - at[:, :, None]

    # Separating axes of two rectangles: the cell's two, then the body's two.
    turn_in_grid = turn * into_grid.take(agent)
    extent = plan_extents(turn_in_grid, half).view(float).reshape(-1, 2).T + CELL_HALF
    near = (np.abs(away) <= extent[:, :, None]) & (np.abs(index - _MIDDLE_CELL) < CELLS / 2)
    inside = near[0][:, :, None] & near[1][:, None]

    cos, sin = turn_in_grid.real[:, None], turn_in_grid.imag[:, None]
    spread = CELL_HALF * (np.abs(cos) + np.abs(sin))
    right, ahead = (half.real[:, None] + spread)[..., None], (half.imag[:, None] + spread)[..., None]
    inside &= np.abs((beside * cos)[:, :, None] - (before * sin)[:, None]) <= right
    inside &= np.abs((beside * sin)[:, :, None] + (before * cos)[:, None]) <= ahead

    h, w = index.astype(np.int64)
    cell = (agent[:, None] * CELLS**2 + h * CELLS)[:, :, None] + w[:, None]
    found = inside.reshape(-1).nonzero()[0]
    extent = plan_extents(turn, half)
    bounds = np.array((place - extent, place + extent)).view(float).reshape(2, -1, 2).swapaxes(1, 2)
    return Bodies(cell.reshape(-1).take(found), found // len(window) ** 2, tag.take(body), bounds)
