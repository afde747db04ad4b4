"""Unity's grid sensor: a square of cells around an agent, each showing the tag of what lies in it.

Cell (h, w) of a grid has its middle at right = (19.5 - h) * scale, ahead = (w - 19.5) * scale of its agent:
w grows forwards, h to the left. It is tested with a box of half-sizes 0.5, 0.01, 0.5 m (not scaled) at the
height of the agent's centre, turned with the agent. Of several things in a cell the one wins whose
bounding-box point nearest to the middle of the cell is nearest to the agent; at a tie the later painted.

Legend: n agents, P shapes in sight, K cells across a shape, M painted cells.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CELLS = 40
MIDDLE = (CELLS - 1) / 2
CELL_HALF, CELL_HALF_HEIGHT = 0.5, 0.01  # m


class View(NamedTuple):
    """Where the sensing agents stand; arrays [n]."""

    x: np.ndarray
    z: np.ndarray
    """Place, m."""
    sin: np.ndarray
    cos: np.ndarray
    """Of the yaw, clockwise seen from above."""
    scale: np.ndarray
    """Distance of two cells, m."""


class Painted(NamedTuple):
    """Cells that shapes lie in, each with its tag and the shape's bounding box."""

    row: np.ndarray
    """int [M]: agent."""
    cell: np.ndarray
    """int [M]: h * 40 + w."""
    tag: np.ndarray
    """int [M]."""
    shape: np.ndarray
    """int [M]: column of `box`."""
    box: np.ndarray
    """[5, P], m, relative to the agent, world axes: low x, high x, low z, high z, height between."""


def spheres(view: View, offset: np.ndarray, radius: float, tag: np.ndarray) -> Painted:
    """Paint spheres at `offset` [3, n, m] (world axes, m, from the agents) with tags int [n, m].

    Cells see the disc that a sphere shows at their height.
    """
    height = np.maximum(np.abs(offset[1]) - CELL_HALF_HEIGHT, 0.0)
    disc = np.sqrt(np.maximum(radius * radius - height * height, 0.0))
    row, column, (h, w), (right, ahead) = _in_sight(view, offset, disc + CELL_HALF, disc > 0)
    disc = disc[row, column]

    # A disc touches a cell if the cell's nearest point is within it.
    dx, dz = (np.maximum(np.abs(side) - CELL_HALF, 0.0) for side in (right, ahead))
    inside = (dx * dx)[:, :, None] + (dz * dz)[:, None, :] <= (disc * disc)[:, None, None]
    inside &= _in_grid(h, w)
    x, y, z = offset[:, row, column]
    box = np.stack([x - radius, x + radius, z - radius, z + radius, np.maximum(np.abs(y) - radius, 0.0)])
    return _painted(inside, h, w, row, tag[row, column], box)


def upright_boxes(
    view: View, offset: np.ndarray, half: np.ndarray, yaw: np.ndarray, tag: np.ndarray, seen: np.ndarray
) -> Painted:
    """Paint cubes of half-edges `half` [n, m] turned by `yaw` [n, m] relative to the agents, rad.

    `offset` and `tag` as in `spheres`; `seen` bool [n, m]: False leaves a cube out.
    """
    seen = seen & (np.abs(offset[1]) <= half + CELL_HALF_HEIGHT)
    row, column, (h, w), (right, ahead) = _in_sight(view, offset, np.sqrt(2) * half + CELL_HALF, seen)
    half, turn = half[row, column, None, None], yaw[row, column, None, None]
    sin, cos = np.sin(turn), np.cos(turn)
    spread = np.abs(sin) + np.abs(cos)  # half-width of a turned square of half-edge 1
    right, ahead = right[:, :, None], ahead[:, None, :]

    # Separating axes of two squares: the cell's two, then the cube's two.
    inside = np.maximum(np.abs(right), np.abs(ahead)) <= CELL_HALF + half * spread
    inside &= np.abs(right * cos - ahead * sin) <= half + CELL_HALF * spread
    inside &= np.abs(right * sin + ahead * cos) <= half + CELL_HALF * spread
    inside &= _in_grid(h, w)
    x, y, z = offset[:, row, column]

    # The bounding box lies along the world's axes: by it the nearest of two shapes is found.
    world = np.arctan2(view.sin, view.cos)[row] + turn[:, 0, 0]
    half = half[:, 0, 0]
    reach = half * (np.abs(np.sin(world)) + np.abs(np.cos(world)))
    box = np.stack([x - reach, x + reach, z - reach, z + reach, np.maximum(np.abs(y) - half, 0.0)])
    return _painted(inside, h, w, row, tag[row, column], box)


def square_lines(view: View, lines: tuple[float, ...], tag: int, seen: np.ndarray) -> Painted:
    """Paint squares around the origin, of half-edges `lines` (m, ascending): vertical faces of walls.

    `seen` bool [n]: False where the cells pass above them.
    The bounding box is that of the outermost square. Cells are turned squares of half-edge 0.5 m: one is
    painted where it touches a square but does not lie within it (separating axes).
    """
    near = np.maximum(np.abs(view.x), np.abs(view.z)) + np.sqrt(2) * (MIDDLE * view.scale + 1) >= lines[0]
    rows = np.flatnonzero(near & seen)
    x, z, sin, cos, scale = (part[rows, None] for part in view)
    right = (MIDDLE - np.arange(CELLS)) * scale  # of h
    ahead = -right  # of w: (w - 19.5) * scale
    spread = np.abs(sin) + np.abs(cos)

    # How far the middles of all cells are from the origin along the world's axes.
    world_x, world_z = right * cos, -right * sin
    world_x += x
    world_z += z
    world_x = np.abs(world_x[:, :, None] + (ahead * sin)[:, None, :])
    world_z = np.abs(world_z[:, :, None] + (ahead * cos)[:, None, :])
    reach = np.maximum(world_x, world_z, out=world_x)

    # The world's two axes, then the cells' own two.
    on_right = np.abs(right + (x * cos - z * sin))
    on_ahead = np.abs(ahead + (x * sin + z * cos))
    extent = (CELL_HALF * spread)[:, :, None]

    inside = np.zeros(reach.shape, bool)
    for line in lines:
        touches = (reach >= line - extent) & (reach <= line + extent)
        touches &= (on_right <= line * spread + CELL_HALF)[:, :, None]
        touches &= (on_ahead <= line * spread + CELL_HALF)[:, None, :]
        inside |= touches

    x, z = x[:, 0], z[:, 0]
    outer = lines[-1]
    box = np.stack([-outer - x, outer - x, -outer - z, outer - z, np.zeros(rows.size)])
    every = np.broadcast_to(np.arange(CELLS), (rows.size, CELLS))
    return _painted(inside, every, every, rows, np.full(rows.size, tag), box)


def one_hot(view: View, num_tags: int, parts: list[Painted]) -> np.ndarray:
    """Return the grids float32 [n, num_tags, 40, 40] of everything painted."""
    boxes = np.cumsum([0] + [part.box.shape[1] for part in parts])
    row, cell, tag = (np.concatenate([part[i] for part in parts]) for i in range(3))
    shape = np.concatenate([part.shape + start for part, start in zip(parts, boxes[:-1], strict=True)])

    # Nearly every cell has one shape: whoever wrote last owns it, and only disputed cells are compared.
    key = row * CELLS**2 + cell  # of all agents' cells in a row
    number = np.arange(key.size)
    owner = np.empty(len(view.x) * CELLS**2, np.int64)  # read only where it is written
    owner[key] = number
    wins = owner[key] == number
    if not wins.all():
        owner[key[~wins]] = -1
        rivals = np.flatnonzero(owner[key] == -1)
        box = np.concatenate([part.box for part in parts], axis=1)[:, shape[rivals]]
        order = rivals[np.argsort(-_distance(view, row[rivals], cell[rivals], box), kind="stable")]
        owner[key[order]] = order  # the last one written stays: the nearest
        wins = owner[key] == number

    grid = np.zeros((len(view.x), num_tags, CELLS, CELLS), np.float32)
    grid.reshape(-1)[(row[wins] * num_tags + tag[wins]) * CELLS**2 + cell[wins]] = 1.0
    return grid


def _in_sight(
    view: View, offset: np.ndarray, reach: np.ndarray, seen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Find shapes whose cells may lie in the grid; a shape spans `reach` [n, m] m around its middle.

    Returns agent and column int [P]; h and w int [P, K] of the cells around them (K: the most that any
    needs; some lie outside the grid); and the way from the shape's middle to the cells' middles [P, K],
    m: to the right for h, ahead for w.
    """
    x, _, z = offset
    sin, cos, scale = view.sin[:, None], view.cos[:, None], view.scale[:, None]
    right, ahead = x * cos - z * sin, x * sin + z * cos
    limit = MIDDLE * scale + reach
    seen = seen & (np.abs(right) <= limit) & (np.abs(ahead) <= limit)
    row, column = np.nonzero(seen)
    right, ahead, reach, step = right[seen], ahead[seen], reach[seen], view.scale[row]

    # h falls to the right, so a shape's first h is that of its right edge.
    count = int((2 * reach / step).max(initial=0.0)) + 1
    first_h = np.ceil(MIDDLE - (right + reach) / step)
    first_w = np.ceil(MIDDLE + (ahead - reach) / step)
    h, w = first_h[:, None] + np.arange(count), first_w[:, None] + np.arange(count)

    step, right, ahead = step[:, None], right[:, None], ahead[:, None]
    ways = (MIDDLE - h) * step - right, (w - MIDDLE) * step - ahead
    return row, column, (h.astype(np.int64), w.astype(np.int64)), ways


def _in_grid(h: np.ndarray, w: np.ndarray) -> np.ndarray:
    return ((h >= 0) & (h < CELLS))[:, :, None] & ((w >= 0) & (w < CELLS))[:, None, :]


def _painted(
    inside: np.ndarray, h: np.ndarray, w: np.ndarray, row: np.ndarray, tag: np.ndarray, box: np.ndarray
) -> Painted:
    """Collect the cells where `inside` [P, K, K] holds."""
    shape, i, j = np.nonzero(inside)
    return Painted(row[shape], h[shape, i] * CELLS + w[shape, j], tag[shape], shape, box)


def _distance(view: View, row: np.ndarray, cell: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the squared distance [M], m^2, from agents to the points of boxes nearest to cells."""
    h, w = np.divmod(cell, CELLS)
    right, ahead = (MIDDLE - h) * view.scale[row], (w - MIDDLE) * view.scale[row]
    sin, cos = view.sin[row], view.cos[row]
    x = np.clip(right * cos + ahead * sin, box[0], box[1])
    z = np.clip(ahead * cos - right * sin, box[2], box[3])
    return x * x + z * z + box[4] * box[4]
