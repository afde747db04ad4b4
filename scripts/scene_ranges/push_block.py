"""Where PushBlock's agent and block may be."""

from __future__ import annotations

import numpy as np

from scene_ranges.plan import square_gap
from scene_ranges.ranges import Ranges


class PushBlock(Ranges):
    """PushBlock: block, then agent on free spots within 6.25 m, off the goal (its face is at z -8.35)."""

    SPOT_HALF = 2.5  # of the square around a spot that nothing may overlap, at the height of 1 m

    def before(self) -> dict[str, np.ndarray]:
        """Return the bodies of the ended episode."""
        boxes = self.scene.boxes
        return {name: getattr(boxes, name).copy() for name in ("place", "yaw", "height")}

    def begun(self, rows: np.ndarray, before: dict[str, np.ndarray]) -> None:
        """Check agent and block: at rest, on spots that nothing is near, headings kept."""
        boxes = self.scene.boxes
        place = boxes.place[rows]
        self.within("begin: x", place[:, :, 0], -6.25, 6.25)
        self.within("begin: z", place[:, :, 1], -8.35 + self.SPOT_HALF, 6.25)
        self.within("begin: y", boxes.height[rows], 1, 1)
        self.within("begin: velocities", [np.abs(boxes.motion[rows]).max(), boxes.fall[rows].max()], 0, 0)
        self.within("begin: yaw changed by", boxes.yaw[rows] - before["yaw"][rows], 0, 0)
        self.within("begin: width of the block", 2 * boxes.half[rows, 1], 2, 2)
        self._apart("the agent's spot from the block", place[:, 0], place[:, 1], boxes.yaw[rows, 1], 1.0)

        # Where the agent has been: its top, 1 m above the floor, is in the way of both.
        old, turn = before["place"][rows, 0], before["yaw"][rows, 0]
        for body, name in ((0, "agent's"), (1, "block's")):
            self._apart(f"the {name} spot from the agent's last place", place[:, body], old, turn, 0.5)

    def tick(self) -> None:
        """Check that bodies are inside the room, above the floor, and not in each other."""
        boxes = self.scene.boxes
        agent, block = boxes.place[:, 0], boxes.place[:, 1]
        yaw = boxes.yaw[:, 0]
        reach = 0.5 * (np.abs(np.sin(yaw)) + np.abs(np.cos(yaw)))
        for name, place, extent in (("agent", agent, reach), ("block", block, 1.0)):
            self.within(
                f"{name}: reach beyond the side walls", np.abs(place[:, 0]) + extent - 12.5, -13, 0.05
            )
            self.within(f"{name}: reach beyond the wall ahead", place[:, 1] + extent - 12.5, -22, 0.05)
            self.within(f"{name}: reach into the goal", -8.35 - place[:, 1] + extent, -22, 0.05)
        self.within("agent y", boxes.height[:, 0], 0.5, 1)
        self.within("block y", boxes.height[:, 1], 0.375, 1)
        self.within("block yaw", boxes.yaw[:, 1], 0, 0)
        self.within("gap of agent and block", square_gap(agent - block, yaw, (0.5, 0.5), 1.0), -0.05, 30)

    def _apart(self, what: str, spot: np.ndarray, body: np.ndarray, turn: np.ndarray, half: float) -> None:
        gap = square_gap(body - spot, turn, (half, half), self.SPOT_HALF)
        self.within(f"begin: {what}", gap, 0, np.inf)
