"""Where Walker's figures and targets may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.ranges import Ranges

AT_REST = {
    "hips": (0, 0.953, 0),
    "spine": (0, 1.17839, 0),
    "chest": (0, 1.44404, 0),
    "head": (0, 1.8935, 0),
    "armL": (-0.4125, 1.44404, 0),
    "forearmL": (-0.7425, 1.44404, 0),
    "handL": (-0.9735, 1.44404, 0),
    "armR": (0.4125, 1.44404, 0),
    "forearmR": (0.7425, 1.44404, 0),
    "handR": (0.9735, 1.44404, 0),
    "thighL": (-0.132, 0.689, 0),
    "shinL": (-0.132, 0.359, 0),
    "footL": (-0.132, 0.161, 0),
    "thighR": (0.132, 0.689, 0),
    "shinR": (0.132, 0.359, 0),
    "footR": (0.132, 0.161, 0),
}
ORDER = (
    *("hips", "chest", "spine", "head", "thighL", "shinL", "footL", "thighR", "shinR", "footR"),
    *("armL", "forearmL", "handL", "armR", "forearmR", "handR"),
)


class Walker(Ranges):
    """Walker: a T-pose in the middle with any yaw, a goal speed of 0.1 to 10 m/s; the target stays."""

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.rest = np.array([AT_REST[name] for name in ORDER])
        self.watch(scene, "_place_targets", self._target_placed)

    def before(self) -> np.ndarray | None:
        """Return where the targets are."""
        return self.scene.physics.target_position.copy() if self.scene.started else None

    def begun(self, rows: np.ndarray, before: np.ndarray | None) -> None:
        """Check pose, speeds, contact flags, goal speed, target."""
        physics = self.scene.physics
        w, y = physics.rotation[rows, :1, 0], physics.rotation[rows, :1, 2]
        self.within("begin: yaw, degrees", np.degrees(2 * np.arctan2(y, w)) % 360, 0, 360)
        turn = np.concatenate([w, 0 * w, y, 0 * w], axis=1)[:, None]
        self.within("begin: rotations other than the yaw", physics.rotation[rows] - turn, 0, 0)
        sin, cos = 2 * w * y, 1 - 2 * y * y
        x, up, z = self.rest.T
        rest = np.stack([x * cos + z * sin, up + 0 * cos, z * cos - x * sin], axis=2)
        self.within("begin: parts beside the T-pose", physics.position[rows] - rest, -1e-5, 1e-5)
        self.within("begin: angles", physics.angle[rows], 0, 0)
        self.within("begin: velocity and spin", [physics.velocity[rows], physics.spin[rows]], 0, 0)
        self.within("begin: goal speed", self.scene.goal_speed[rows], 0.1, 10)
        self.holds("contact flags are cleared", ~self.scene.grounded[rows].any(axis=1))
        if before is not None:
            self.within("begin: target moved by", physics.target_position - before, 0, 0)

    def tick(self) -> None:
        """Check that parts are above the ground and nothing flies away; Unity's walls are 12.375 m away."""
        physics = self.scene.physics
        self.within("part x, z", physics.position[:, :, ::2], -12.375, 12.375)
        self.within("part y", physics.position[:, :, 1], 0.1, 4.0)
        self.within("part speed, along an axis", physics.velocity, -40, 40)
        self.within("target x, z", physics.target_position[:, ::2], -12.6, 12.6)
        self.within("target y", physics.target_position[:, 1], 0.2, 3.0)

    def _target_placed(self, rows: np.ndarray, before: None) -> None:
        offset = self.scene.physics.target_position[rows] - (0.0, 1.0, 1.0)
        self.within("target placed: way from its anchor", np.hypot(offset[:, 0], offset[:, 2]), 0, 9)
        self.within("target placed: y above its anchor", offset[:, 1], 0, 0)
