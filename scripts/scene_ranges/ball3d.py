"""Where 3DBall's cubes and balls may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.ranges import SLACK, Ranges


class Ball3D(Ranges):
    """3DBall: cube turned by up to 10 degrees about x, then z; ball 4 m above it, at rest."""

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check cube and ball; the ball's position counts from the cube."""
        w, x, y, z = self.scene.cube_rotation[rows].T
        self.within("begin: cube about x, degrees", np.degrees(2 * np.arctan2(x, w)), -10, 10)
        self.within("begin: cube about z, degrees", np.degrees(2 * np.arctan2(z, w)), -10, 10)
        self.holds("cube turned about x, then z, only", np.abs(w * y + x * z) < SLACK)
        ball = self.scene.ball_position[rows]
        self.within("begin: ball x", ball[:, 0], -1.5, 1.5)
        self.within("begin: ball y", ball[:, 1], 4, 4)
        self.within("begin: ball z", ball[:, 2], -1.5, 1.5)
        self.within("begin: ball velocity", self.scene.ball_velocity[rows], 0, 0)

    def tick(self) -> None:
        """Check the cube's tilt and the ball, which may pass the limits of a fall by one tick's way.

        A ball on a corner of the cube is lifted to 4.7 m at most; a turn about one axis changes the other
        component a little beyond its limit.
        """
        x, y, z = self.scene.ball_position.T
        self.within("ball y", y, -2.3, 4.8)
        self.within("ball |x|, |z|", np.maximum(np.abs(x), np.abs(z)), 0, 3.3)
        self.within("cube quaternion x, z", self.scene.cube_rotation[:, 1::2], -0.35, 0.35)
