"""The soccer pitch from above: which surface a disc touches, where its way ends, and what is a goal.

Facts: docs/scenes/SoccerTwos.md. Axes are Unity's: x towards the purple goal, z to the left of it; metres.
All faces are one-sided: a disc behind one counts as inside it, however deep, so none is tunnelled.
The pitch is symmetric, so discs are folded into the corner x, z > 0; there, faces have outward normals.
Legend: n discs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

MARGIN = 0.02  # m: contacts exist from this gap downwards
SIDE_Z = 7.508  # inner faces of the long sides
_C, _S = math.sqrt(0.75), 0.5
CORNER_NORMAL = (_C, _S)  # of the corner walls, outward; their length runs along (s, -c)
CORNER_OFFSET = _C * 14.46 + _S * 6.41 - 0.4607 / 2  # of their inner faces along the normal
CORNER_LENGTH = 4.8
CORNER_END = (
    _S * 14.46 - _C * 6.41 + CORNER_LENGTH / 2
)  # of their inner faces along their length, at the mouth
NET_Z, NET_LENGTH = 4.15, 2.0  # inner faces of the nets' sides
POST_X = np.array([15.5, 15.47])  # front ends of the nets' sides: blue (x < 0), purple
BACK_X = np.array([17.373, 17.356])  # inner faces of the nets' backs
GOAL_FLOOR_X, GOAL_FLOOR_Z = 15.5, 4.25  # front edge and half-width of the goals' floors
BALL_HEIGHT = 0.5  # of the ball's centre above the goals' floors
BLOCK_X, BLOCK_Z = 15.01, 3.957  # inner face and half-width of the block that closes a blue goal
_ROUNDING = 1e-6  # m: a disc less deep than this has not hit anything
NUM_FEATURES = 5
# long side, corner wall, net's side, a mouth's edge, net's back or block
_SIDE, _CORNER, _NET, _EDGE, _BACK = range(NUM_FEATURES)
_NORMAL = np.array([[0.0, -_C, 0.0, 0.0, -1.0], [-1.0, -_S, -1.0, 0.0, 0.0]])
# as arrays: NumPy takes those twice as fast as Python's numbers
_ZERO, _ONE, _INF = np.array(0.0), np.array(1.0), np.array(np.inf)
_MARGIN, _DEEP = np.array(MARGIN), np.array(-_ROUNDING)
_COS, _SIN, _CORNER_STOP = np.array(_C), np.array(_S), np.array(CORNER_END)
_SIDE_GAP, _CORNER_GAP, _NET_GAP = np.array(SIDE_Z), np.array(CORNER_OFFSET), np.array(NET_Z)


class Gaps(NamedTuple):
    """Distances of discs from the pitch's features, m, inf where not faced; negative: penetration."""

    gap: np.ndarray
    """[5, n]: long side, corner wall, net's side, a mouth's edge, net's back or block."""
    beside_corner: np.ndarray
    """Whether the disc is beside the corner wall, bool [n], and not where this has ended; the gap is from
    its plane."""


class Faced(NamedTuple):
    """Features that discs touch, k of them."""

    disc: np.ndarray
    """Number of the disc, int64 [k]."""
    normal: np.ndarray
    """Unit normal off the surface, x and z, [2, k]."""
    gap: np.ndarray
    """m, [k]."""


class Pitch:
    """Answer questions about a pitch, whose blue goal may be closed by a block."""

    def __init__(self, blue_closed: bool = False) -> None:
        self.blue_closed = blue_closed
        # what differs between the ends, [6, 2] blue and purple, folded like the discs: the mouth's edge x
        # and z, where the net's sides begin, the back's x and half-width, and up to which z no edge is met
        ends = [
            (post, NET_Z, post, back, GOAL_FLOOR_Z, -1.0) for post, back in zip(POST_X, BACK_X, strict=True)
        ]

        if blue_closed:
            ends[0] = (BLOCK_X, BLOCK_Z, math.inf, BLOCK_X, BLOCK_Z, BLOCK_Z)

        self._ends = np.array(ends).T.copy()

    def gaps(self, at: np.ndarray, radius: np.ndarray) -> Gaps:
        """Return the distances from everything that they face of n discs `at` x, z [2, n].

        `radius` [5, n]: the discs' radii, once for each feature.
        """
        folded = np.abs(at)
        x, z = folded

        ends = self._ends.take(at[0] > _ZERO, 1)
        along = folded - ends[:2]
        squares = along * along

        gap = np.empty((NUM_FEATURES, len(x)))
        np.subtract(_SIDE_GAP, z, out=gap[_SIDE])
        np.subtract(_CORNER_GAP, _COS * x + _SIN * z, out=gap[_CORNER])
        np.subtract(_NET_GAP, z, out=gap[_NET])
        np.sqrt(squares[0] + squares[1], out=gap[_EDGE])
        np.subtract(ends[3], x, out=gap[_BACK])

        # a feature that the disc does not face, from where it is, is infinitely far
        in_net = x > ends[2]
        np.putmask(gap[_NET], ~in_net, _INF)
        np.putmask(gap[_EDGE], in_net | (z < ends[5]), _INF)
        np.putmask(gap[_BACK], z >= ends[4], _INF)

        gap -= radius
        return Gaps(gap, _SIN * x - _COS * z <= _CORNER_STOP)

    def contacts(self, at: np.ndarray, gaps: Gaps) -> Faced:
        """Return the contacts of n discs with walls, nets and block: all gaps below 0.02 m."""
        close = gaps.gap < _MARGIN
        close[_CORNER] &= gaps.beside_corner
        return self._faced(close, at, gaps.gap)

    def way(
        self, start: np.ndarray, end: np.ndarray, before: Gaps, after: Gaps, radius: np.ndarray
    ) -> tuple[Faced, np.ndarray]:
        """Return what ends the straight ways of n discs from `start` to `end` [2, n], and at which share.

        Each disc has at most one entry. The gaps are those at the ways' ends: negative, as deep as the
        discs would be.
        """
        hit = after.gap < _DEEP
        hit[_CORNER] &= before.beside_corner | after.beside_corner

        step = end - start
        step *= step
        # a way that meets an edge is at least as long as the gaps before and after it
        hit[_EDGE] |= before.gap[_EDGE] + after.gap[_EDGE] < np.sqrt(step[0] + step[1])

        if not np.count_nonzero(hit):
            return _NOTHING, _NOTHING.gap

        # faces and edges end ways by different formulas
        edge = np.flatnonzero(hit[_EDGE])
        hit[_EDGE] = False
        faced, share = _ends(self._faced(hit, end, after.gap), start, end)

        if edge.size:
            edges, until = self._edge_ways(edge, start, end, radius)
            faced, share = _joined(faced, edges), np.concatenate([share, until])

        order = np.lexsort((share, faced.disc))
        order = order[np.diff(faced.disc[order], prepend=-1) > 0]  # the first that ends a way

        return _part(faced, order), share[order]

    def goals(self, x: np.ndarray, z: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how often balls touch the blue goal's parts and the purple goal's, int64 [n] each.

        A ball touches a goal's floor with its lower half before its centre is above it, and a post (the
        front end of a net's side) from the pitch; both carry the goal's tag.
        """
        reach = radius + MARGIN
        floor_x = GOAL_FLOOR_X - math.sqrt(reach**2 - BALL_HEIGHT**2)

        purple = x > 0
        away_x, z = np.abs(x), np.abs(z)

        floor = (away_x > floor_x) & (z < GOAL_FLOOR_Z)
        away_x, away_z = away_x - POST_X[purple.astype(np.intp)], z - NET_Z
        post = away_x * away_x + away_z * away_z < reach**2

        parts = floor.astype(np.int64) + post
        blue = np.zeros_like(parts) if self.blue_closed else np.where(purple, 0, parts)

        return blue, np.where(purple, parts, 0)

    def _edge(self, x: np.ndarray) -> np.ndarray:
        """Return where the front edge of the mouth is at the ends of `x` [k], folded, [2, k]."""
        return self._ends[:2].take(x > 0, 1)

    def _faced(self, faced: np.ndarray, at: np.ndarray, gap: np.ndarray) -> Faced:
        """Return features with their normals: those `faced` [5, n] by the discs `at` x, z [2, n]."""
        (places,) = faced.reshape(-1).nonzero()  # much faster than two-dimensional
        feature, disc = np.divmod(places, faced.shape[1])

        at = at.take(disc, 1)
        normal = _NORMAL.take(feature, 1)

        edge = (feature == _EDGE).nonzero()[0]
        if edge.size:
            at_edge = at[:, edge]
            normal[:, edge] = _unit(np.abs(at_edge) - self._edge(at_edge[0]))

        # back from the folded corner to the quarter of the pitch that the disc is in
        normal *= np.copysign(_ONE, at)
        return Faced(disc, normal, gap.take(places))

    def _edge_ways(
        self, disc: np.ndarray, start: np.ndarray, end: np.ndarray, radius: np.ndarray
    ) -> tuple[Faced, np.ndarray]:
        """Return edges that end the ways of some discs, and at which shares.

        |m + s d| = r with m from the edge to the start and d the way: s = (-b - sqrt(b^2 - a c)) / a.
        """
        start, end, radius = start[:, disc], end[:, disc], radius[disc]

        m, d = start - np.copysign(self._edge(end[0]), end), end - start
        a, b = _dot(d, d), _dot(m, d)

        inside = b * b - a * (_dot(m, m) - (radius - _ROUNDING) ** 2)
        # on the way there, and the first root within the way
        hit = np.flatnonzero((b < 0) & (inside > 0) & (-b - np.sqrt(np.maximum(inside, 0)) < a))
        if not hit.size:
            return _NOTHING, _NOTHING.gap

        m, d = m[:, hit], d[:, hit]
        share = np.maximum((-b[hit] - np.sqrt(inside[hit])) / a[hit], 0.0)

        away = _unit(m + share * d)
        return Faced(disc[hit], away, _dot(away, m + d) - radius[hit]), share


_NOTHING = Faced(np.zeros(0, np.int64), np.zeros((2, 0)), np.zeros(0))


def _ends(faces: Faced, start: np.ndarray, end: np.ndarray) -> tuple[Faced, np.ndarray]:
    """Return those of some faces behind the ends of ways that the ways meet, and at which shares."""
    disc, normal, gap = faces
    start = start.take(disc, 1)
    step = end.take(disc, 1) - start

    advance = _dot(normal, step)  # negative: towards the face
    meets = advance < 0
    share = np.clip(1.0 - gap / np.where(meets, advance, -1.0), 0.0, 1.0)

    # beyond its end, the corner wall's plane is not a wall
    x, z = np.abs(start + share * step)
    meets &= (normal[0] == 0) | (normal[1] == 0) | (_S * x - _C * z <= CORNER_END)

    return _part(faces, meets), share[meets]


def _part(faces: Faced, rows: np.ndarray) -> Faced:
    return Faced(faces.disc[rows], faces.normal[:, rows], faces.gap[rows])


def _joined(one: Faced, other: Faced) -> Faced:
    return Faced(*(np.concatenate(parts, axis=-1) for parts in zip(one, other, strict=True)))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products of [2, k] with [2, k]."""
    products = a * b
    return products[0] + products[1]


def _unit(vector: np.ndarray) -> np.ndarray:
    """Return [2, k] divided by its length."""
    return vector / (np.sqrt(_dot(vector, vector)) + 1e-12)
