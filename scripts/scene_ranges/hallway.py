"""Where Hallway's agent, symbol and goals may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.plan import passed
from scene_ranges.ranges import Ranges


class Hallway(Ranges):
    """Hallway: O at x within 3 m or X in the middle, agent at the far end, goals by a coin."""

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check symbol, agent and goals."""
        scene = self.scene
        shows_x, symbol = scene.shows_x[rows], scene.symbol[rows]
        self.within("begin: O block x", symbol[~shows_x, 0], -3, 3)
        self.within("begin: X block x", symbol[shows_x, 0], 0, 0)
        self.within("begin: block y", symbol[:, 1], 2.5, 2.5)
        self.within("begin: block z", symbol[:, 2], -5, 5)
        self.within("begin: agent x", scene.position[rows, 0], -3, 3)
        self.within("begin: agent y", scene.position[rows, 1], 1.5, 1.5)
        self.within("begin: agent z", scene.position[rows, 2], -20, -10)
        self.within("begin: agent velocity", scene.velocity[rows], 0, 0)
        self.within("begin: agent yaw, degrees", np.degrees(scene.yaw[rows]), 0, 360)
        self.within("begin: side of O, -1 or 1", np.abs(scene.o_side[rows]), 1, 1)
        self.within("begin: symbol and side, 0 .. 3", 2 * shows_x + (scene.o_side[rows] > 0), 0, 3)
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that the agent's box is inside the room, and did not pass through the block."""
        scene = self.scene
        place = scene.position[:, ::2]
        extent = 0.5 * (np.abs(np.sin(scene.yaw)) + np.abs(np.cos(scene.yaw)))
        self.within("reach beyond the side walls", np.abs(place[:, 0]) + extent - 9.5, -10, 0.15)
        self.within("reach beyond the end walls", np.abs(place[:, 1]) + extent - 24.75, -25, 0.15)
        self.within("agent y", scene.position[:, 1], 1, 1.5)
        block = np.concatenate([scene.symbol[:, None, ::2], np.full((len(place), 1, 2), (2.0, 0.5))], axis=2)
        self.holds("nobody passes through the block", ~passed(self.last, place, block))
        self.last = place.copy()
