"""What CooperativePushBlock's agents see: a grid of 20 x 20 cells before them, one channel a tag.

Cell (h, w) is a square of 1 m, turned with the agent, with its middle at right = 9.5 - h, ahead = w + 0.5 of
the agent: the grid's centre is 10 m ahead. Of several things in a cell the one wins whose bounding box
(along the area's axes), at its point nearest to the cell's middle, is nearest to the grid's centre. Heights
do not matter: cells reach half a metre up and down from the agent's centre, and so meet everything.
Legend: n agents that look, M bodies of an area, P pairs of an agent and a body in its grid, K painted cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CELLS = 20
CELL_HALF = 0.5  # m
CENTRE_AHEAD = 10.0  # m
WALL, AGENT, GOAL, SMALL, LARGE, VERY_LARGE = range(6)
NUM_TAGS = 6
NOTHING = -1
INNER, OUTER = 12.5, 13.0  # m: faces of the walls
GOAL_LOW, GOAL_HIGH, GOAL_HALF_X = -12.65, -8.35, 12.5  # m: z, z, x
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


class Painted(NamedTuple):
    """Cells that something lies in."""

    cell: np.ndarray
    """int [K]: (agent * 20 + h) * 20 + w."""
    tag: np.ndarray
    """int [K]."""
    point: np.ndarray
    """[2, K]: x, z of the point that decides how near it is, m."""


def look(
    view: View, place: np.ndarray, yaw: np.ndarray, half: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Return the grids, float32 [n, 6, 20, 20].

    `place`, `half` [n, M, 2], `yaw` [n, M]: the bodies of each looking agent's area; `tag` int [M]; `seen`
    bool [n, M]: False leaves a body out.
    """
    middle_x = view.x[:, None] + _RIGHT * view.cos[:, None], _AHEAD * view.sin[:, None]
    middle_z = view.z[:, None] - _RIGHT * view.sin[:, None], _AHEAD * view.cos[:, None]
    x = middle_x[0][:, :, None] + middle_x[1][:, None]
    z = middle_z[0][:, :, None] + middle_z[1][:, None]
    parts = [_walls(view, x, z), _goal(view, x, z), _bodies(view, x, z, place, yaw, half, tag, seen)]

    cell, tags = np.concatenate([part.cell for part in parts]), np.concatenate([part.tag for part in parts])
    winner = np.full(x.size, NOTHING, np.int8)
    winner[cell] = tags

    # Where several things lie, written from the farthest to the nearest: the last one stays.
    contested = (np.bincount(cell, minlength=x.size)[cell] > 1).nonzero()[0]
    point = np.concatenate([part.point for part in parts], axis=1)[:, contested]
    cell, tags = cell[contested], tags[contested]
    agent = cell // CELLS**2
    away_x = point[0] - (view.x + CENTRE_AHEAD * view.sin)[agent]
    away_z = point[1] - (view.z + CENTRE_AHEAD * view.cos)[agent]
    order = np.argsort(-(away_x * away_x + away_z * away_z), kind="stable")
    winner[cell[order]] = tags[order]

    grid = winner.reshape(-1, 1, CELLS, CELLS) == _EACH_TAG
    return grid.astype(np.float32)


def _walls(view: View, x: np.ndarray, z: np.ndarray) -> Painted:
    """Paint the four walls: two of 26 m along z, two of 25 m along x between them."""
    reach = (CELL_HALF * (np.abs(view.sin) + np.abs(view.cos)))[:, None, None]
    far_x, far_z = np.abs(x), np.abs(z)
    farthest = np.maximum(far_x, far_z)
    touches = (farthest >= INNER - reach) & (farthest <= OUTER + reach) & _beside_corners(view)
    cell = np.flatnonzero(touches)

    # The nearest point of that wall, of the two that may meet in a corner, in which the cell lies deeper.
    x, z = x.ravel()[cell], z.ravel()[cell]
    across = np.abs(x) > np.abs(z)
    face = np.where(across, x, z)
    on_face = np.copysign(np.clip(np.abs(face), INNER, OUTER), face)
    along_x = np.clip(x, -INNER, INNER)
    point = np.stack(
        [np.where(across, on_face, along_x), np.where(across, np.clip(z, -OUTER, OUTER), on_face)]
    )
    return Painted(cell, np.full(cell.size, WALL), point)


def _goal(view: View, x: np.ndarray, z: np.ndarray) -> Painted:
    """Paint the goal's strip."""
    spread = np.abs(view.sin) + np.abs(view.cos)
    reach = (CELL_HALF * spread)[:, None, None]
    touches = (z <= GOAL_HIGH + reach) & (z >= GOAL_LOW - reach) & (np.abs(x) <= GOAL_HALF_X + reach)
    cell = np.flatnonzero(touches)
    point = np.stack(
        [
            np.clip(x.ravel()[cell], -GOAL_HALF_X, GOAL_HALF_X),
            np.clip(z.ravel()[cell], GOAL_LOW, GOAL_HIGH),
        ]
    )
    return Painted(cell, np.full(cell.size, GOAL), point)


def _beside_corners(view: View) -> np.ndarray:
    """Return bool [n, 20, 20]: which cells a square of half-width 13 m around the area's middle overlaps.

    By the cells' own axes; by the area's axes their distance says it.
    """
    reach = (OUTER * (np.abs(view.sin) + np.abs(view.cos)))[:, None] + CELL_HALF
    right = _RIGHT + (view.x * view.cos - view.z * view.sin)[:, None]
    ahead = _AHEAD + (view.x * view.sin + view.z * view.cos)[:, None]
    return np.asarray((np.abs(right) <= reach)[:, :, None] & (np.abs(ahead) <= reach)[:, None])


def _bodies(
    view: View,
    x: np.ndarray,
    z: np.ndarray,
    place: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray,
    tag: np.ndarray,
    seen: np.ndarray,
) -> Painted:
    """Paint boxes that are turned about the vertical."""
    sin, cos = view.sin[:, None], view.cos[:, None]
    offset_x, offset_z = place[..., 0] - view.x[:, None], place[..., 1] - view.z[:, None]
    right, ahead = offset_x * cos - offset_z * sin, offset_x * sin + offset_z * cos
    radius = np.sqrt((half**2).sum(axis=2)) + CELL_HALF
    seen = seen & (np.abs(right) <= _RIGHT[0] + radius) & (ahead >= -radius) & (ahead <= CELLS + radius)
    agent, body = seen.nonzero()
    right, ahead, radius, half = right[seen], ahead[seen], radius[seen], half[seen]
    turn = yaw[seen] - np.arctan2(view.sin, view.cos)[agent]

    # Only the cells around a body are looked at: h falls to the right.
    window = np.arange(int(2 * radius.max(initial=0.0)) + 1)
    h = np.ceil(_RIGHT[0] - right - radius).astype(np.int64)[:, None] + window
    w = np.ceil(ahead - radius - CELL_HALF).astype(np.int64)[:, None] + window
    beside = ((_RIGHT[0] - h) - right[:, None])[:, :, None]
    before = (w + CELL_HALF - ahead[:, None])[:, None]

    # Separating axes of two rectangles: the cell's two, then the body's two.
    s, c = np.sin(turn)[:, None, None], np.cos(turn)[:, None, None]
    half_x, half_z = half[:, 0, None, None], half[:, 1, None, None]
    spread = CELL_HALF * (np.abs(s) + np.abs(c))
    inside = (np.abs(beside) <= CELL_HALF + half_x * np.abs(c) + half_z * np.abs(s)) & (
        np.abs(before) <= CELL_HALF + half_x * np.abs(s) + half_z * np.abs(c)
    )
    inside &= np.abs(beside * c - before * s) <= half_x + spread
    inside &= np.abs(beside * s + before * c) <= half_z + spread
    inside &= ((h >= 0) & (h < CELLS))[:, :, None] & ((w >= 0) & (w < CELLS))[:, None]

    pair, i, j = inside.nonzero()
    cell = (agent[pair] * CELLS + h[pair, i]) * CELLS + w[pair, j]
    return Painted(cell, tag[body[pair]], _bounds_point(seen, place, yaw, half, pair, (x, z), cell))


def _bounds_point(
    seen: np.ndarray,
    place: np.ndarray,
    yaw: np.ndarray,
    half: np.ndarray,
    pair: np.ndarray,
    middles: tuple[np.ndarray, np.ndarray],
    cell: np.ndarray,
) -> np.ndarray:
    """Return the points [2, K] of the bodies' bounding boxes that are nearest to the cells' middles."""
    s, c = np.abs(np.sin(yaw[seen])), np.abs(np.cos(yaw[seen]))
    extent = np.stack([half[:, 0] * c + half[:, 1] * s, half[:, 0] * s + half[:, 1] * c])[:, pair]
    centre = place[seen].T[:, pair]
    middle = np.stack([part.ravel()[cell] for part in middles])
    return np.asarray(np.clip(middle, centre - extent, centre + extent))
