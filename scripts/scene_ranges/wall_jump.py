"""Where WallJump's agent and block may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.plan import passed
from scene_ranges.ranges import Ranges


class WallJump(Ranges):
    """WallJump: agent on a line, block in a rectangle, one of five configurations."""

    HEIGHT = np.array([0.0, 4.0, 8.0, 8.0, 8.0])
    BIG = np.array([0, 0, 1, 1, 1])

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago
        self.watch(scene, "_place_blocks", self._block_placed)
        fixed_update = scene.fixed_update

        def watched() -> None:
            drawn = self.scene.configuration.copy() if self.scene.started else None
            fixed_update()
            self._configured(drawn)

        scene.fixed_update = watched

    def before(self) -> np.ndarray:
        """Return the headings, which a reset keeps."""
        return self.scene.bodies.yaw.copy()

    def begun(self, rows: np.ndarray, before: np.ndarray) -> None:
        """Check the agent and the drawn configuration."""
        bodies = self.scene.bodies
        self.within("begin: agent x", bodies.position[rows, 0], -9, 9)
        self.within("begin: agent y", bodies.position[rows, 1], 1, 1)
        self.within("begin: agent z", bodies.position[rows, 2], -12, -12)
        self.within("begin: velocities", [bodies.velocity[rows], bodies.block_velocity[rows]], 0, 0)
        self.within("begin: yaw changed by", bodies.yaw - before, 0, 0)
        self.within("begin: configuration", self.scene.configuration[rows], 0, 4)
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that bodies are on the platform or at most a tick past its edge, and not through a wall.

        An agent on the block has ground up to 1.5 m beyond the edge. A block gets as fast as agents run (31
        m/s, 0.62 m in a tick), and is pushed out of one by 0.2 m at most.
        """
        bodies = self.scene.bodies
        place = bodies.position[:, ::2]
        self.within("agent x", place[:, 0], -13, 13)
        self.within("agent z", place[:, 1], -17, 9)
        self.within("agent y", bodies.position[:, 1], 0.3, 12)
        self.within("block x", bodies.block[:, 0], -11.35, 11.35)
        self.within("block y", bodies.block[:, 1], 1.5, 1.5)
        self.within("block z", bodies.block[:, 2], -15.35, 7.35)
        wall = np.broadcast_to([0.0, -1.98, 10.0, 0.75], (len(place), 1, 4))
        below = bodies.position[:, 1] < bodies.wall_height / 2
        self.holds("nobody passes through the wall", ~(passed(self.last, place, wall) & below))
        self.last = place.copy()

    def _block_placed(self, rows: np.ndarray, before: None) -> None:
        block = self.scene.bodies.block[rows]
        self.within("begin: block x", block[:, 0], -8.1, 8.1)
        self.within("begin: block y", block[:, 1], 1.5, 1.5)
        self.within("begin: block z", block[:, 2], -6.27 - 3.5, -6.27 + 3.5)

    def _configured(self, drawn: np.ndarray | None) -> None:
        if drawn is None or not (drawn >= 0).any():
            return
        slots = np.flatnonzero(drawn >= 0)
        height = self.scene.bodies.wall_height[slots]
        self.within("wall's height beside the drawn one", height - self.HEIGHT[drawn[slots]], 0, 0)
        behavior = self.scene.agents.behavior[slots]
        self.within("behavior beside the drawn one", behavior - self.BIG[drawn[slots]], 0, 0)
