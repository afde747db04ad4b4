"""Where GridFoodCollector's agents and food may be."""

from __future__ import annotations

import numpy as np

from scene_ranges.ranges import Ranges


class GridFoodCollector(Ranges):
    """GridFoodCollector: agents within 45 m, any whole degree, at rest; food falls in within 45 m."""

    AGENTS = 5

    def before(self) -> np.ndarray | None:
        """Return where the food is, unless it is to be made anew."""
        return None if self.scene._new_food else self.scene.physics.ball_position.copy()

    def begun(self, rows: np.ndarray, before: np.ndarray | None) -> None:
        """Check agents and food; heights count from the floor, 0.5 m above Unity's origin."""
        area, agent = np.divmod(rows, self.AGENTS)
        scene, physics = self.scene, self.scene.physics
        self.within("begin: agent x, z", physics.agent_position[::2, area, agent], -45, 45)
        self.within("begin: agent y", physics.agent_position[1, area, agent], 1.5, 1.5)
        self.within("begin: agent velocity", physics.agent_velocity[:, area, agent], 0, 0)
        self.within("begin: agent yaw, whole degrees", scene.yaw_degrees[area, agent], 0, 359)
        yaw = np.degrees(physics.agent_yaw[area, agent])
        self.within("begin: body's yaw beside it", yaw - scene.yaw_degrees[area, agent], 0, 0)
        self.holds("agents are not frozen", ~scene.frozen[area, agent])
        if before is None:
            self.within("begin: new food x, z", physics.ball_position[::2], -45, 45)
            self.within("begin: new food y", physics.ball_position[1], 0.75, 0.75)  # lifted: the page says so
        else:
            self.within("begin: food moved by", physics.ball_position - before, 0, 0)

    def tick(self) -> None:
        """Check food that falls in, and that bodies are between floor and walls (faces at 50 m).

        An agent's centre may be 0.1 m past the face for a tick, as in DungeonEscape.
        """
        physics = self.scene.physics
        x, y, z = physics.ball_position
        new = y == 2.5
        if new.any():
            self.within("eaten food falls in at x, z", [x[new], z[new]], -45, 45)
        self.within("food x, z", physics.ball_position[::2], -50, 50)
        self.within("food y", y, 0.6, 5.0)
        self.within("agent x, z", physics.agent_position[::2], -50.1, 50.1)
        self.within("agent y", physics.agent_position[1], 0.3, 5.0)
