"""Where balls and agents of SoccerTwos and StrikersVsGoalie may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.ranges import Ranges


class Soccer(Ranges):
    """Both soccer scenes: ball within 2.5 m, agents within 5 m of their places, yaw within 10 degrees."""

    RESET_HOOK = "_reset_fields"
    AGENTS: tuple[tuple[str, int, float], ...] = ()  # name, side (-1 blue, 1 purple), middle of x

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check all bodies of fields `rows` [n]; the places of z follow in a scene's own class."""
        physics = self.scene.physics
        x, _ = physics.position[:, :, rows]
        self.within("begin: ball x, z", physics.position[:, 0, rows], -2.5, 2.5)
        self.within("begin: all velocities", physics.velocity[:, :, rows], 0, 0)
        self.within("begin: ball spin", physics.spin[rows], 0, 0)
        self.within("begin: timer", self.scene.timer[rows], 0, 0)
        for agent, (name, side, middle) in enumerate(self.AGENTS):
            self.within(f"begin: {name} x", x[1 + agent], middle - 5, middle + 5)
            yaw = -side * np.degrees(self.scene.yaw[agent, rows])
            self.within(f"begin: {name} |yaw|, degrees", yaw, 80, 100)

    def tick(self) -> None:
        """Check that discs are inside the pitch: how far they reach beyond its faces.

        A ball that an agent drives into the corner between two walls is stopped at one of them, and is up to
        0.3 m deep in the other for a tick.
        """
        position = self.scene.physics.position
        x, z = np.abs(position[0]), np.abs(position[1])
        radius = np.where(np.arange(len(x)) == 0, 0.6242, 0.5)[:, None]
        self.within("reach beyond the long sides", z + radius - 7.508, -8, 0.35)
        corner = np.sqrt(0.75) * x + 0.5 * z + radius - 15.497
        self.within("reach beyond the corner walls", np.where(z > 4.3, corner, -1.0), -16, 0.35)
        self.within("reach beyond the nets' backs", x + radius - 17.373, -18, 0.15)
        self.within("reach beyond the nets' sides", np.where(x > 15.6, z + radius - 4.15, -1.0), -5, 0.15)
        self.within("ball |x|", x[0], 0, 15.127)


class SoccerTwos(Soccer):
    """SoccerTwos: one agent of each team on each side."""

    AGENTS = (("purple", 1, 8.19), ("blue", -1, -8.19), ("purple", 1, 8.19), ("blue", -1, -8.19))

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the places of z as well."""
        super().begun(rows, before)
        z = self.scene.physics.position[1, 1:, rows].T  # [agents, n]
        for team in (0, 1):
            self.within("begin: smaller z of a team", z[team::2].min(axis=0), -1.2, -1.2)
            self.within("begin: larger z of a team", z[team::2].max(axis=0), 1.2, 1.2)


class StrikersVsGoalie(Soccer):
    """StrikersVsGoalie: strikers on both sides, the goalie in the middle; a block in the blue goal."""

    AGENTS = (("striker", -1, -8.19), ("goalie", 1, 9.0), ("striker", -1, -8.19))

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the places of z as well."""
        super().begun(rows, before)
        z = self.scene.physics.position[1, 1:, rows].T
        self.within("begin: striker's z, larger", np.maximum(z[0], z[2]), 1.2, 1.2)
        self.within("begin: striker's z, smaller", np.minimum(z[0], z[2]), -1.2, -1.2)
        self.within("begin: goalie's z", z[1], 0, 0)

    def tick(self) -> None:
        """Check the block as well."""
        super().tick()
        x, z = self.scene.physics.position
        reach = np.array([0.6242, 0.5, 0.5, 0.5])[:, None] - x - 15.01
        self.within("reach beyond the block", np.where(np.abs(z) < 3.957, reach, -1.0), -34, 0.15)
