"""Where Basic's agents may be."""

from __future__ import annotations

import numpy as np

from scene_ranges.ranges import Ranges


class Basic(Ranges):
    """Basic: place 10 of 0 to 20, a new agent every episode."""

    RESET_HOOK = "enable"

    def before(self) -> int:
        """Return the next free agent id."""
        return int(self.scene.agents.next_id)

    def begun(self, rows: np.ndarray, before: int) -> None:
        """Check the place and the id."""
        self.within("begin: place", self.scene.position[rows], 10, 10)
        self.holds("ids of new agents are new", self.scene.agents.agent_id[rows] >= before)

    def tick(self) -> None:
        """Check the places between the goals."""
        self.within("place", self.scene.position, 8, 16)
