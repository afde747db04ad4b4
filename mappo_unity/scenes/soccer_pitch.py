"""The soccer pitch from above: which surface a disc touches, where its way ends, and what is a goal.

In: centres and radii of discs. Out: contacts, ends of ways, goals. Knows no velocities and no rules.
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
_CORNER, _MOUTH, _EDGE, _BLOCK = 1, 2, 3, 5  # features: side, corner, net's side, mouth's edge, back, block
_NORMAL_X = np.array([0.0, -_C, 0.0, 0.0, -1.0, -1.0])
_NORMAL_Z = np.array([-1.0, -_S, -1.0, 0.0, 0.0, 0.0])


class Gaps(NamedTuple):
    """Distances of discs from the pitch's features, m, inf where not faced; negative: penetration."""

    gap: np.ndarray
    """[5, n]: long side, corner wall, the mouth's face (net's side, or block), its front edge, net's back."""
    past_end: np.ndarray
    """Whether the corner wall has ended where the disc is, bool [n]; the gap is then that from its plane."""


class Faced(NamedTuple):
    """Features that discs touch: number of the disc int64, unit normal off the surface, gap in m; all [k]."""

    disc: np.ndarray
    normal_x: np.ndarray
    normal_z: np.ndarray
    gap: np.ndarray


class Pitch:
    """Answer questions about a pitch, whose blue goal may be closed by a block."""

    def __init__(self, blue_closed: bool = False) -> None:
        self.blue_closed = blue_closed

    def gaps(self, x: np.ndarray, z: np.ndarray, radius: np.ndarray) -> Gaps:
        """Return the distances of n discs from everything that they face."""
        ax, az = np.abs(x), np.abs(z)
        purple = x > 0
        gap = np.empty((5, len(x)))
        np.subtract(SIDE_Z, az, out=gap[0])
        np.subtract(CORNER_OFFSET, _C * ax + _S * az, out=gap[1])
        edge_x, edge_z = self._edge(purple)
        along_x, along_z = ax - edge_x, az - edge_z
        beside = along_x > 0
        gap[2] = np.where(beside, NET_Z - az, np.inf)
        gap[4] = np.where(az < GOAL_FLOOR_Z, np.where(purple, BACK_X[1], BACK_X[0]) - ax, np.inf)
        if self.blue_closed:
            beside = np.where(purple, beside, along_z < 0)
            gap[2] = np.where(purple, gap[2], np.where(beside, BLOCK_X - ax, np.inf))
            gap[4, ~purple] = np.inf
        gap[3] = np.where(beside, np.inf, np.sqrt(along_x * along_x + along_z * along_z))
        gap -= radius
        return Gaps(gap, _S * ax - _C * az > CORNER_END)

    def contacts(self, x: np.ndarray, z: np.ndarray, gaps: Gaps) -> Faced:
        """Return the contacts of n discs with walls, nets and block: all gaps below 0.02 m."""
        close = gaps.gap < MARGIN
        close[_CORNER] &= ~gaps.past_end
        feature, disc = np.nonzero(close)
        return self._faced(feature, disc, x, z, gaps.gap[feature, disc])

    def way(
        self,
        start: np.ndarray,
        end: np.ndarray,
        before: Gaps,
        after: Gaps,
        radius: np.ndarray,
    ) -> tuple[Faced, np.ndarray]:
        """Return what ends the straight ways of n discs from `start` to `end` [2, n], and at which share.

        Each disc has at most one entry. The gaps are those at the ways' ends: negative, as deep as the
        discs would be.
        """
        hit = after.gap < -_ROUNDING
        hit[_CORNER] &= ~(before.past_end & after.past_end)
        step_x, step_z = end - start
        # a way that meets an edge is at least as long as the gaps before and after it
        hit[_EDGE] |= before.gap[_EDGE] + after.gap[_EDGE] < np.sqrt(step_x * step_x + step_z * step_z)
        if not hit.any():
            return _NOTHING, _NOTHING.gap
        edge = np.flatnonzero(hit[_EDGE])
        hit[_EDGE] = False
        feature, disc = np.nonzero(hit)
        faced = self._faced(feature, disc, end[0], end[1], after.gap[feature, disc])
        faced, share = _ends(faced, start, end)
        if edge.size:
            edges, until = self._edge_ways(edge, start, end, radius)
            faced, share = _joined(faced, edges), np.concatenate([share, until])
        order = np.lexsort((share, faced.disc))
        order = order[np.diff(faced.disc[order], prepend=-1) > 0]  # the first that ends a way
        return Faced(*(each[order] for each in faced)), share[order]

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

    def _edge(self, purple: np.ndarray) -> tuple[np.ndarray, np.ndarray | float]:
        """Return where the front edge of a mouth is, by end: of a net's side (post), or of the block."""
        if not self.blue_closed:
            return np.where(purple, POST_X[1], POST_X[0]), NET_Z
        return np.where(purple, POST_X[1], BLOCK_X), np.where(purple, NET_Z, BLOCK_Z)

    def _faced(
        self, feature: np.ndarray, disc: np.ndarray, x: np.ndarray, z: np.ndarray, gap: np.ndarray
    ) -> Faced:
        """Return features with their normals, given their gaps [k] and the positions of all discs."""
        x, z = x[disc], z[disc]
        if self.blue_closed:
            feature = np.where((feature == _MOUTH) & (x < 0), _BLOCK, feature)
        normal_x, normal_z = _NORMAL_X[feature], _NORMAL_Z[feature]
        edge = np.flatnonzero(feature == _EDGE)
        if edge.size:
            edge_x, edge_z = self._edge(x > 0)
            away_x, away_z = (np.abs(x) - edge_x)[edge], (np.abs(z) - edge_z)[edge]
            distance = np.sqrt(away_x * away_x + away_z * away_z) + 1e-12
            normal_x[edge], normal_z[edge] = away_x / distance, away_z / distance
        return Faced(disc, normal_x * np.copysign(1.0, x), normal_z * np.copysign(1.0, z), gap)

    def _edge_ways(
        self, disc: np.ndarray, start: np.ndarray, end: np.ndarray, radius: np.ndarray
    ) -> tuple[Faced, np.ndarray]:
        """Return edges that end the ways of some discs, and at which shares.

        |m + s d| = r with m from the edge to the start and d the way: s = (-b - sqrt(b^2 - a c)) / a.
        """
        (x, z), (to_x, to_z), radius = start[:, disc], end[:, disc], radius[disc]
        edge_x, edge_z = self._edge(to_x > 0)
        m_x, m_z = x - np.copysign(edge_x, to_x), z - np.copysign(edge_z, to_z)
        d_x, d_z = to_x - x, to_z - z
        a, b = d_x * d_x + d_z * d_z, m_x * d_x + m_z * d_z
        inside = b * b - a * (m_x * m_x + m_z * m_z - (radius - _ROUNDING) ** 2)
        hit = np.flatnonzero((b < 0) & (inside > 0) & (-b - np.sqrt(np.maximum(inside, 0)) < a))
        if not hit.size:
            return _NOTHING, _NOTHING.gap
        m_x, m_z, d_x, d_z = m_x[hit], m_z[hit], d_x[hit], d_z[hit]
        share = np.maximum((-b[hit] - np.sqrt(inside[hit])) / a[hit], 0.0)
        away_x, away_z = m_x + share * d_x, m_z + share * d_z
        distance = np.sqrt(away_x * away_x + away_z * away_z) + 1e-12
        away_x, away_z = away_x / distance, away_z / distance
        gap = away_x * (m_x + d_x) + away_z * (m_z + d_z) - radius[hit]
        return Faced(disc[hit], away_x, away_z, gap), share


_NOTHING = Faced(np.zeros(0, np.int64), *np.zeros((3, 0)))


def _ends(faces: Faced, start: np.ndarray, end: np.ndarray) -> tuple[Faced, np.ndarray]:
    """Return those of some faces behind the ends of ways that the ways meet, and at which shares."""
    disc, normal_x, normal_z, gap = faces
    (x, z), (to_x, to_z) = start[:, disc], end[:, disc]
    step_x, step_z = to_x - x, to_z - z
    advance = normal_x * step_x + normal_z * step_z  # negative: towards the face
    meets = advance < 0
    share = np.clip(1.0 - gap / np.where(meets, advance, -1.0), 0.0, 1.0)
    at_x, at_z = np.abs(x + share * step_x), np.abs(z + share * step_z)
    meets &= (normal_x == 0) | (normal_z == 0) | (_S * at_x - _C * at_z <= CORNER_END)
    return Faced(*(each[meets] for each in faces)), share[meets]


def _joined(*parts: Faced) -> Faced:
    return Faced(*(np.concatenate(each) for each in zip(*parts, strict=True)))
