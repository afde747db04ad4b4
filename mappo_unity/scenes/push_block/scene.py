"""PushBlock: one agent pushes a block into the goal along one wall of the room.

Facts: docs/scenes/PushBlock.md. Bodies: `bodies.py`; rays: `sight.py`. Everything happens in the axes of the
area: nothing that an agent senses depends on the quarter turn that Unity gives an area at each reset.
Legend: N areas = slots; bodies of an area: agent, block.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.seven_actions import ACTIONS
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.push_block.agents import (
    AGENT_DRAG,
    AGENT_HALF,
    AGENT_MASS,
    BLOCK_DRAG,
    BLOCK_HALF_Y,
    drives,
)
from mappo_unity.scenes.push_block.bodies import SlidingBoxes
from mappo_unity.scenes.push_block.contacts import Room
from mappo_unity.scenes.push_block.sight import LEVEL, OFFSET, see
from mappo_unity.scenes.push_block.spawn import SPAWN_Y, at_query_height, draw_spots

AGENT, BLOCK = 0, 1  # bodies of an area
BLOCK_MASS = 10.0  # kg
MAX_STEP = 5000
WALL, GOAL_FACE = 12.5, -8.35  # m: inner faces; the goal is a solid box along the wall behind
SPOT_HALF = 2.5  # m: half the width of the free square around a new spot
MATERIAL_FRICTION = 0.6  # of what slides on the floor; the pair's is the mean of both
FACING_GOAL = np.pi  # rad: the agent's heading before its first turn
GOAL_REWARD = 5.0
_NO_LESS = -1e-9  # the open lower bound of what may be 0


class PushBlock(Scene):
    """Run PushBlock.

    Parameters, read at a reset: `block_scale` (m, the block's width), `static_friction` and
    `dynamic_friction` of the ground's material, `block_drag` (1/s); `gravity` (m/s^2, downward) acts at once.
    """

    NAME = "PushBlock"
    DEFAULT_NUM_AREAS = 32
    BEHAVIORS = (
        Behavior(
            "PushBlock?team=0",
            (
                Sensor("OffsetRayPerceptionSensor", (OFFSET.size,), stack=3),
                Sensor("RayPerceptionSensor", (LEVEL.size,), stack=3),
            ),
            branches=(len(ACTIONS),),
        ),
    )
    MAX_STEP = MAX_STEP
    PARAMETERS = {
        "block_scale": Parameter(2.0, above=0.0),
        "static_friction": Parameter(0.0, above=_NO_LESS),
        "dynamic_friction": Parameter(0.0, above=_NO_LESS),
        "block_drag": Parameter(BLOCK_DRAG, above=_NO_LESS),
        "gravity": Parameter(2.5 * 9.81, at_once=True),
    }

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.boxes = SlidingBoxes(
            self.num_areas,
            half=np.array([AGENT_HALF, (1.0, BLOCK_HALF_Y, 1.0)]),
            mass=(AGENT_MASS, BLOCK_MASS),
            drag=(AGENT_DRAG, BLOCK_DRAG),
            turns=(False, False),
            room=Room(np.array([-WALL, GOAL_FACE]), np.array([WALL, WALL])),
            gravity=self.parameters["gravity"],
        )
        self.boxes.yaw[:, AGENT] = FACING_GOAL
        self.boxes.place[:, BLOCK, 1] = 3.0  # beside the agent, before the first reset moves both
        self._drive = np.zeros((self.num_areas, 2), complex)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Put the block, then the agent, at rest on free spots; headings stay; read the parameters."""
        boxes = self.boxes
        for body in (BLOCK, AGENT):
            boxes.place[slots, body] = draw_spots(
                self.rng,
                SPOT_HALF,
                GOAL_FACE,
                boxes.place[slots],
                boxes.yaw[slots],
                boxes.half[slots],
                at_query_height(boxes.height[slots], boxes.rest),
            )
            boxes.height[slots, body] = SPAWN_Y
            boxes.motion[slots, body] = 0.0
            boxes.fall[slots, body] = 0.0

        # Last, as in Unity: the old size of the block decides which spots are free.
        self._read_parameters(slots)

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the rays that skim the walls' tops, and the level rays."""
        boxes = self.boxes
        position, half = np.empty((2, len(slots), 3)), np.empty((len(slots), 3))
        position[:, :, ::2] = boxes.place[slots].swapaxes(0, 1)
        position[:, :, 1] = boxes.height[slots].T
        half[:, ::2], half[:, 1] = boxes.half[slots, BLOCK], BLOCK_HALF_Y
        return list(see(position[AGENT], boxes.yaw[slots, AGENT], position[BLOCK], half))

    def act(self, slots: np.ndarray) -> None:
        """Drive or turn; every tick costs 1/5000."""
        drive, yaw = drives(self.agents.discrete[:, 0], self.boxes.yaw[:, AGENT])
        self._drive[:, AGENT], self.boxes.yaw[:, AGENT] = drive, yaw
        self.agents.reward -= np.float32(1 / MAX_STEP)

    def simulate(self) -> None:
        """Move agents and blocks by one tick; a block at the goal ends the episode with +5."""
        boxes = self.boxes
        boxes.step(self._drive)
        gap = boxes.place[:, BLOCK, 1] - boxes.half[:, BLOCK, 1] - GOAL_FACE
        reached = np.flatnonzero(gap < CONTACT_GAP)
        if reached.size:
            self.add_reward(reached, GOAL_REWARD)
            self.end_episode(reached)

    def parameter_changed(self, name: str) -> None:
        """Apply gravity at once; the others are read at a reset."""
        self.boxes.gravity = self.parameters["gravity"]

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies."""
        return {"boxes": self.boxes.get_state()}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`; drives are of one tick only and need no restoring."""
        self.boxes.gravity = self.parameters["gravity"]
        self.boxes.set_state(state["boxes"])

    def _read_parameters(self, slots: np.ndarray) -> None:
        boxes, count = self.boxes, len(slots)
        boxes.resize(slots, BLOCK, 0.5 * self.parameters.draw("block_scale", count)[:, None])
        boxes.kept[slots, BLOCK] = np.maximum(1.0 - self.parameters.draw("block_drag", count) * TICK_S, 0.0)
        # Of the floor and what slides on it the mean counts, and twice, for two anchors: see `ground.py`.
        hold, rub = (
            self.parameters.draw(name, count)[:, None] + MATERIAL_FRICTION
            for name in ("static_friction", "dynamic_friction")
        )
        boxes.set_friction(slots, hold, rub)
