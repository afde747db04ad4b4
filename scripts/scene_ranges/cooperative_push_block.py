"""Where CooperativePushBlock's agents and blocks may be."""

from __future__ import annotations

import numpy as np

from scene_ranges.plan import square_gap
from scene_ranges.ranges import Ranges


class CooperativePushBlock(Ranges):
    """CooperativePushBlock: agents, then six blocks on free spots within 6.25 m, any heading."""

    RESET_HOOK = "_reset_areas"
    SPOT_HALF = 1.5  # of the square around a spot that nothing may overlap, at the height of 1 m
    HALF = np.array([0.5] * 5 + [1.0] * 2 + [1.5] * 2)
    PAIRS = np.triu_indices(9, 1)

    def before(self) -> dict[str, np.ndarray]:
        """Return the bodies of the ended episode."""
        boxes = self.scene.boxes
        return {name: getattr(boxes, name).copy() for name in ("place", "yaw")}

    def begun(self, rows: np.ndarray, before: dict[str, np.ndarray]) -> None:
        """Check areas `rows` [n]: everything is there, at rest, on spots that were free in turn."""
        scene, boxes = self.scene, self.scene.boxes
        place, yaw = boxes.place[rows], boxes.yaw[rows]
        self.within("begin: x, z", place, -6.25, 6.25)
        self.within("begin: y", boxes.height[rows], 1, 1)
        self.within("begin: yaw, degrees", np.degrees(yaw), 0, 360)
        self.within("begin: velocities", [np.abs(boxes.motion[rows]).max(), boxes.fall[rows].max()], 0, 0)
        self.within("begin: timer", scene.timer[rows], 0, 0)
        self.holds("all blocks are there", boxes.present[rows].all(axis=1))
        for body in range(9):
            for other in range(9):
                # Placed before; or an agent where it has been, its top 1 m above the floor.
                there, turn = place[:, other], yaw[:, other]
                if other >= body:
                    there, turn = before["place"][rows, other], before["yaw"][rows, other]
                if other < max(body, 3):
                    half = (self.HALF[other], self.HALF[other])
                    gap = square_gap(there - place[:, body], turn, half, self.SPOT_HALF)
                    self.within("begin: spot's square from a body", gap, 0, np.inf)

    def tick(self) -> None:
        """Check that bodies are inside the room, above the floor, not in each other, and not in the goal."""
        boxes = self.scene.boxes
        spread = np.abs(np.sin(boxes.yaw)) + np.abs(np.cos(boxes.yaw))
        beyond = np.abs(boxes.place).max(axis=2) + self.HALF * spread - 12.5
        self.within("reach beyond the walls", beyond[boxes.present], -13, 0.05)
        self.within("agent y", boxes.height[:, :3], 0.5, 1)
        self.within("block y", boxes.height[:, 3:], 0.375, 1)
        self.within("timer", self.scene.timer, 0, 5000)
        in_goal = (boxes.place[:, 3:, 1] - (self.HALF * spread)[:, 3:] < -8.35) & boxes.present[:, 3:]
        self.holds("blocks in the goal vanish", ~in_goal)
        self.holds("some block is left", boxes.present[:, 3:].any(axis=1))
        one, other = self.PAIRS
        both = boxes.present[:, one] & boxes.present[:, other]
        self.within("gap of two bodies", self._gaps(one, other)[both], -0.05, 40)

    def _gaps(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the gaps [N, P] of boxes and others, in the frames of the others."""
        boxes = self.scene.boxes
        x, z = (boxes.place[:, one] - boxes.place[:, other]).reshape(-1, 2).T
        yaw = boxes.yaw[:, other].ravel()
        offset = np.stack([x * np.cos(yaw) - z * np.sin(yaw), x * np.sin(yaw) + z * np.cos(yaw)], axis=1)
        shape = (self.scene.num_areas, len(one))
        half, square = (np.broadcast_to(self.HALF[body], shape).ravel() for body in (one, other))
        gap = square_gap(offset, boxes.yaw[:, one].ravel() - yaw, (half, half), square)
        return gap.reshape(shape)
