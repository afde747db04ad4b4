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
_EDGE = 3  # the feature that is a vertical edge, not a face


class Faced(NamedTuple):
    """Surfaces that discs face: row of the disc int64, unit normal off the surface, gap in m; all [k]."""

    row: np.ndarray
    normal_x: np.ndarray
    normal_z: np.ndarray
    gap: np.ndarray


class Pitch:
    """Answer questions about a pitch, whose blue goal may be closed by a block."""

    def __init__(self, blue_closed: bool = False) -> None:
        self.blue_closed = blue_closed
        closed = np.array([blue_closed, False])
        # the mouth, by end: a face (the net's side, or the block), its start, and its front edge
        self._mouth_x = np.where(closed, 1.0, 0.0)  # outward normal: along x for a block, along z for a net
        self._mouth_offset = np.where(closed, BLOCK_X, NET_Z)
        self._edge_x = np.where(closed, BLOCK_X, POST_X)
        self._edge_z = np.where(closed, BLOCK_Z, NET_Z)
        self._back = np.where(closed, np.inf, BACK_X)

    def limits(self, radius: np.ndarray) -> np.ndarray:
        """Return what discs' |z|, corner distance and |x| pass near a surface, [3, *radius.shape]."""
        return np.stack([SIDE_Z - radius, CORNER_OFFSET - radius, self._edge_x.min() - radius]) - MARGIN

    @staticmethod
    def near(x: np.ndarray, z: np.ndarray, limits: np.ndarray) -> np.ndarray:
        """Return which discs may be within the margin of a surface, bool as `x`, given their `limits`."""
        x, z = np.abs(x), np.abs(z)
        return (z > limits[0]) | (_C * x + _S * z > limits[1]) | (x > limits[2])

    def contacts(self, x: np.ndarray, z: np.ndarray, radius: np.ndarray) -> Faced:
        """Return the contacts of n discs with walls, nets and block: all gaps below 0.02 m."""
        normal_x, normal_z, gap = self._features(x, z, radius)
        feature, row = np.nonzero(gap < MARGIN)
        return Faced(row, normal_x[feature, row], normal_z[feature, row], gap[feature, row])

    def way(
        self, x: np.ndarray, z: np.ndarray, to_x: np.ndarray, to_z: np.ndarray, radius: np.ndarray
    ) -> tuple[np.ndarray, Faced]:
        """Return the share of their straight ways that n discs can go [n], and the surfaces that end them.

        The gaps are those at the ways' ends: negative, as deep as the discs would be.
        """
        normal_x, normal_z, gap = self._features(to_x, to_z, radius)
        step_x, step_z = to_x - x, to_z - z
        advance = normal_x * step_x + normal_z * step_z  # negative: towards the surface
        hit = (gap < -_ROUNDING) & (advance < 0)
        hit[_EDGE] = False
        share = np.ones_like(gap)
        np.divide(gap, advance, out=share, where=hit)
        share[hit] = np.maximum(1.0 - share[hit], 0.0)
        beyond = _S * np.abs(x + share[1] * step_x) - _C * np.abs(z + share[1] * step_z) > CORNER_END
        share[1, beyond] = 1.0  # it passed the end of the corner wall
        self._edge_ways((share, normal_x, normal_z, gap), (x, z), (step_x, step_z), radius)
        first = share.argmin(axis=0)
        nearest = share[first, np.arange(len(x))]
        row = np.flatnonzero(nearest < 1)
        first = first[row]
        return nearest, Faced(row, normal_x[first, row], normal_z[first, row], gap[first, row])

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

    def _features(
        self, x: np.ndarray, z: np.ndarray, radius: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return unit normals x, z [5, n] and gaps [5, n], inf where a disc does not face the feature.

        Features: long side, corner wall, the mouth's face, the mouth's front edge, the net's back.
        """
        ax, az = np.abs(x), np.abs(z)
        end = (x > 0).astype(np.intp)
        mouth_x = self._mouth_x[end]
        normal_x, normal_z, gap = np.zeros((3, 5, len(x)))
        normal_z[0] = -1
        gap[0] = SIDE_Z - az
        normal_x[1], normal_z[1] = -_C, -_S
        gap[1] = np.where(_S * ax - _C * az > CORNER_END, np.inf, CORNER_OFFSET - _C * ax - _S * az)
        along_x, along_z = ax - self._edge_x[end], az - self._edge_z[end]
        facing = np.where(mouth_x > 0, along_z < 0, along_x > 0)
        normal_x[2], normal_z[2] = -mouth_x, mouth_x - 1
        gap[2] = np.where(facing, self._mouth_offset[end] - np.where(mouth_x > 0, ax, az), np.inf)
        distance = np.sqrt(along_x * along_x + along_z * along_z) + 1e-12
        normal_x[3], normal_z[3] = along_x / distance, along_z / distance
        gap[3] = np.where(facing, np.inf, distance)
        normal_x[4] = -1
        gap[4] = np.where(az < GOAL_FLOOR_Z, self._back[end] - ax, np.inf)
        gap -= radius
        normal_x *= np.copysign(1.0, x)
        normal_z *= np.copysign(1.0, z)
        return normal_x, normal_z, gap

    def _edge_ways(
        self,
        entries: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        start: tuple[np.ndarray, np.ndarray],
        step: tuple[np.ndarray, np.ndarray],
        radius: np.ndarray,
    ) -> None:
        """Enter hits of the mouth's front edges into shares, normals x, z and gaps, each [5, n].

        |m + s d| = r with m from the edge to the start and d the way: s = (-b - sqrt(b^2 - a c)) / a.
        """
        end = (start[0] > 0).astype(np.intp)
        m_x = start[0] - np.copysign(self._edge_x[end], start[0])
        m_z = start[1] - np.copysign(self._edge_z[end], start[1])
        a = step[0] ** 2 + step[1] ** 2
        b = m_x * step[0] + m_z * step[1]
        inside = b * b - a * (m_x * m_x + m_z * m_z - (radius - _ROUNDING) ** 2)
        row = np.flatnonzero((b < 0) & (inside > 0))
        if not row.size:
            return
        at = np.maximum((-b[row] - np.sqrt(inside[row])) / a[row], 0.0)
        row, at = row[at < 1], at[at < 1]
        away_x, away_z = m_x[row] + at * step[0][row], m_z[row] + at * step[1][row]
        distance = np.sqrt(away_x * away_x + away_z * away_z) + 1e-12
        away_x, away_z = away_x / distance, away_z / distance
        to_x, to_z = m_x[row] + step[0][row], m_z[row] + step[1][row]
        entered = (at, away_x, away_z, away_x * to_x + away_z * to_z - radius[row])
        for entry, value in zip(entries, entered, strict=True):
            entry[_EDGE, row] = value
