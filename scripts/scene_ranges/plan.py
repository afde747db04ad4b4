"""Bodies seen from above: gaps between them, and ways through walls."""

from __future__ import annotations

import numpy as np


def square_gap(
    offset: np.ndarray,
    turn: np.ndarray,
    half: tuple[np.ndarray | float, np.ndarray | float],
    square: np.ndarray | float,
) -> np.ndarray:
    """Return the gap [n] along the best separating axis between rectangles and upright squares, in plan.

    `offset` [n, 2] (x, z) of a rectangle with half sizes `half`, turned by `turn` [n] rad (clockwise from
    above), from a square of half size `square` along the axes; negative where they overlap.
    """
    sin, cos = np.sin(turn), np.cos(turn)
    x, z = offset.T
    along_x = np.abs(x) - square - half[0] * np.abs(cos) - half[1] * np.abs(sin)
    along_z = np.abs(z) - square - half[0] * np.abs(sin) - half[1] * np.abs(cos)
    reach = square * (np.abs(sin) + np.abs(cos))
    right = np.abs(x * cos - z * sin) - half[0] - reach
    ahead = np.abs(x * sin + z * cos) - half[1] - reach
    return np.maximum.reduce([along_x, along_z, right, ahead])


def passed(start: np.ndarray, end: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """Return bool [N]: who got from one side of a thin wall to its other side in one tick.

    `start`, `end` [N, 2]: x, z (NaN: begun since); `walls` [N or 1, K, 4]: x, z, half sizes along x and z.
    """
    before, after = start[:, None] - walls[..., :2], end[:, None] - walls[..., :2]
    half = walls[..., 2:]
    changed = before * after < 0  # [N, K, 2]
    beside = np.maximum(np.abs(before), np.abs(after)) < half
    thin_x = half[..., 0] < half[..., 1]
    through = np.where(thin_x, changed[..., 0] & beside[..., 1], changed[..., 1] & beside[..., 0])
    return np.asarray(through.any(axis=1))
