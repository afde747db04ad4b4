"""Casts of discs in a plane, all rays of all agents in one go, against discs and one-sided walls.

In: casters, their rays, colliders. Out: how far each ray goes until it meets each collider. Knows no soccer.
Arrays have their axes in the order (x and z, colliders, rays): NumPy is fastest where the long axis is the
last one. What depends on the caster only is worked out a caster, then copied to its rays.

A travel below 0, or NaN, means that nothing is met. `first_met` looks at the bits of these numbers and needs
no mask for them.
Legend: n casters, R rays (of all of them together), D discs, P walls.
"""

from __future__ import annotations

import numpy as np


def unmet_discs(towards: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return |p - o|^2 - reach^2 [D, n], inf where the caster overlaps the disc at the start.

    `towards` [2, D, n]: p - o, from casters to discs; `reach` [D, 1]: radii of disc and cast together.
    """
    squares = towards * towards
    outside = squares[0] + squares[1] - reach * reach
    outside[outside < 0] = np.inf
    return outside


def cast_discs(towards: np.ndarray, outside: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return travels [D, R] until discs are met.

    Arguments as in `unmet_discs`, but a ray: [2, D, R] and [D, R]; `direction` [2, R]: unit vectors.
    The first root of t^2 - 2 a t + c = 0 with a = (p - o).d, c = |p - o|^2 - reach^2: negative behind the
    caster, NaN beside the disc.
    """
    ahead = towards[0] * direction[0]
    ahead += towards[1] * direction[1]
    root = ahead * ahead
    root -= outside
    with np.errstate(invalid="ignore"):
        np.sqrt(root, out=root)
    return np.subtract(ahead, root, out=root)


class Walls:
    """Walls of which a cast disc meets only the front.

    `begin`, `end` [P, 2]: each wall's face; its front is to the right of the way from `begin` to `end`
    (seen from above, x right, z up). Ends that stand free are to be cast as discs.
    """

    def __init__(self, begin: np.ndarray, end: np.ndarray, radius: float) -> None:
        """`radius` of the cast disc, m."""
        length = np.sqrt(((end - begin) ** 2).sum(axis=1))
        along = (end - begin) / length[:, None]
        self._radius = radius
        self._half = length[:, None] / 2  # [P, 1]
        self._middle = ((begin + end) / 2).T[:, :, None]  # [2, P, 1]
        self._along = along.T[:, :, None].copy()
        self._front = np.stack([along[:, 1], -along[:, 0]])[:, :, None]

    def places(self, origin: np.ndarray) -> np.ndarray:
        """Return where casters `origin` [2, n] are, m: before the face and along it, [2, P, n].

        The first is the gap between disc and face, the second counts from the wall's middle.
        """
        away = origin[:, None] - self._middle
        place = np.empty_like(away)
        for number, axis in enumerate((self._front, self._along)):
            parts = away * axis
            np.add(parts[0], parts[1], out=place[number])
        place[0] -= self._radius
        return place

    def touched(self, places: np.ndarray, gap: float) -> np.ndarray:
        """Return which walls, ends included, are nearer than `gap` to casters at `places`, bool [P, n]."""
        before = places[0] + self._radius
        beyond = np.maximum(np.abs(places[1]) - self._half, 0.0)
        return before * before + beyond * beyond < (self._radius + gap) ** 2

    def cast(self, places: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return travels [P, R] until faces are met, ends excepted.

        `places` [2, P, R]: of each ray's caster, gaps NaN where the wall is not to be met, as one that the
        disc overlaps; `direction` [2, R]: unit vectors.
        """
        closing = self._front[0] * direction[0]
        closing += self._front[1] * direction[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            travel = np.divide(places[0], closing, out=closing)
            np.negative(travel, out=travel)
            at = self._along[0] * direction[0]
            at += self._along[1] * direction[1]
            at *= travel
        at += places[1]
        travel[np.abs(at, out=at) > self._half] = np.nan
        return travel


def first_met(travel: np.ndarray) -> np.ndarray:
    """Return which collider [R] each ray meets first, given travels [colliders, R]; contiguous.

    The bits of floats >= 0, read as whole numbers, have the floats' order; those of inf, NaN and of
    negative numbers, whose sign is the highest bit, are larger than all of them.
    """
    first: np.ndarray = travel.view(np.uint64).argmin(axis=0)
    return first
