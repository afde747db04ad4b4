"""Casts of discs in a plane, all rays of all agents in one go, against discs and one-sided walls.

Arrays have their axes in the order (x and z, colliders, rays): NumPy is fastest where the long axis is the
last one. What depends on the caster only is worked out a caster, then copied to its rays.

A travel below 0, or NaN, means that nothing is met. `first_met` looks at the bits of these numbers and needs
no mask for them.
Legend: n casters, R rays (of all of them together), D discs, P walls.
"""

from __future__ import annotations

import numpy as np

_NUMBERS = 64  # colliders at most
_NUMBER_BITS = np.array(_NUMBERS - 1, np.uint64)


def unmet_discs(towards: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return |p - o|^2 - reach^2 [D, n], inf where the caster overlaps the disc at the start.

    `towards` [2, D, n]: p - o, from casters to discs; `reach` [D, 1]: radii of disc and cast together.
    """
    squares = towards * towards
    outside: np.ndarray = squares[0] + squares[1] - reach * reach
    np.putmask(outside, outside < 0, np.inf)
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
        length = np.sqrt(((end - begin) ** 2).sum(axis=1, keepdims=True))

        along = (end - begin) / length
        front = np.stack([along[:, 1], -along[:, 0]], axis=1)

        self._radius, self._half = radius, length / 2  # [P, 1]

        # matrix products are several times as fast as products of columns with rows. Places along a wall are
        # in halves of its length
        self._axes = np.concatenate([front, along / self._half])  # [2 P, 2]

        middle = np.tile((begin + end) / 2, (2, 1))
        self._zero = (self._axes * middle).sum(axis=1, keepdims=True)
        self._zero[: len(begin)] += radius

    def places(self, origin: np.ndarray) -> np.ndarray:
        """Return where casters `origin` [2, n] are: before the face and along it, [2, P, n].

        The first is the gap between disc and face, m; the second is 0 in the wall's middle, -1 and 1 at
        its ends.
        """
        place = self._axes @ origin
        place -= self._zero
        return place.reshape(2, len(self._half), -1)

    def touched(self, places: np.ndarray, gap: float) -> np.ndarray:
        """Return which walls, ends included, are nearer than `gap` to casters at `places`, bool [P, n]."""
        before = places[0] + self._radius
        beyond = np.maximum(np.abs(places[1]) - 1.0, 0.0) * self._half

        touched: np.ndarray = before * before + beyond * beyond < (self._radius + gap) ** 2
        return touched

    def cast(self, places: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return travels [P, R] until faces are met, ends excepted.

        `places` [2, P, R]: of each ray's caster, gaps NaN where the wall is not to be met, as one that the
        disc overlaps; `direction` [2, R]: unit vectors.
        """
        receding, slope = (self._axes @ direction).reshape(places.shape)

        with np.errstate(divide="ignore", invalid="ignore"):
            travel = np.divide(places[0], receding, out=receding)
            np.negative(travel, out=travel)
            slope *= travel

        slope += places[1]
        np.putmask(travel, np.abs(slope, out=slope) > 1.0, np.nan)

        return travel


def numbered(colliders: int, rays: int) -> np.ndarray:
    """Return the number of the collider in every place, uint64 [colliders, R], for `first_met`."""
    assert colliders <= _NUMBERS
    return np.repeat(np.arange(colliders, dtype=np.uint64)[:, None], rays, axis=1)


def first_met(travel: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return which collider [R] each ray meets first, given travels [colliders, R] and their `numbered`.

    The bits of floats >= 0, read as whole numbers, have the floats' order; those of inf, NaN and of
    negative numbers, whose sign is the highest bit, are larger than all of them. The colliders' numbers
    replace the lowest bits (2^-46 of a travel), so that the minimum tells which it was: several times as
    fast as argmin across rows. Of travels as good as equal the lower number is the first.
    """
    bits = np.bitwise_and(travel.view(np.uint64), ~_NUMBER_BITS)
    bits |= number

    first: np.ndarray = np.minimum.reduce(bits, axis=0) & _NUMBER_BITS
    return first.view(np.int64)
