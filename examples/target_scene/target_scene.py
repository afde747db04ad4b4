"""Target: a point walks over a square of 2 x 2 m and must reach a target.

The worked example of mappo_unity/scenes/README.md: a scene outside this project's repository.
Legend: N areas = slots (one agent an area), n those that a hook is called for.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.shapes import BLUE, FLOOR, GREEN, Camera, Drawing, Shape, ball, box
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.registry import SceneRecord

STEP = 0.1  # metres along each axis that the largest action moves the point
STEP_REWARD, REACHED_REWARD = -0.02, 1.0


class Target(Scene):
    """Run Target; its parameter `radius` (metres) says how near is near enough."""

    NAME = "Target"
    BEHAVIORS = (Behavior("Target?team=0", (Sensor("WayToTarget", (2,)),), continuous=2),)
    DECISION_PERIOD = 1
    MAX_STEP = 100
    PARAMETERS = {"radius": Parameter(0.2, above=0.0)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.position = np.zeros((self.num_areas, 2))  # x, z
        self.target = np.zeros((self.num_areas, 2))
        self.radius = np.zeros(self.num_areas)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Put the point and its target anywhere."""
        self.position[slots], self.target[slots] = self.rng.uniform(-1, 1, (2, len(slots), 2))
        self.radius[slots] = self.parameters.draw("radius", len(slots))  # for each area its own

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the way to the target [n, 2], in metres along x and z."""
        return [(self.target[slots] - self.position[slots]).astype(np.float32)]

    def act(self, slots: np.ndarray) -> None:
        """Walk; who is near enough earns 1 and begins anew, everybody else loses a little."""
        moved = self.position[slots] + STEP * np.clip(self.agents.continuous[slots], -1, 1)
        self.position[slots] = np.clip(moved, -1, 1)

        gap = np.linalg.norm(self.target[slots] - self.position[slots], axis=1)
        reached = gap < self.radius[slots]
        self.add_reward(slots, np.where(reached, REACHED_REWARD, STEP_REWARD))
        self.end_episode(slots[reached])

    def scene_state(self) -> dict[str, Any]:
        """Return where everything is."""
        return {name: getattr(self, name).copy() for name in ("position", "target", "radius")}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Put everything where it was."""
        for name in ("position", "target", "radius"):
            getattr(self, name)[:] = state[name]


def shapes(scene: Target, area: int) -> list[Shape]:
    """Return the floor, the target and the point of an area."""
    (x, z), (target_x, target_z) = scene.position[area], scene.target[area]
    floor = box((0, -0.05, 0), (1.1, 0.05, 1.1), FLOOR, shadow=False)
    return [floor, ball((target_x, 0.1, target_z), 0.1, GREEN), ball((x, 0.1, z), 0.1, BLUE)]


DRAWING = Drawing(shapes, Camera((0.0, 0.0, 0.0), 4.0, yaw=0.0, pitch=50.0))
RECORD = SceneRecord("Target", "target_scene:Target", drawing="target_scene:DRAWING")
