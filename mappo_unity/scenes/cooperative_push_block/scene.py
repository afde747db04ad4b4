"""CooperativePushBlock: three agents push six blocks of three sizes into the goal; large ones need several.

Facts: docs/scenes/CooperativePushBlock.md. Bodies and their contacts are those of PushBlock
(`push_block/bodies.py`), here with blocks that turn; the grid is in `grid.py`. Everything happens in the axes
of the area: nothing that an agent senses depends on the quarter turn that Unity gives an area at a reset.
Legend: N areas, A = 3 agents and 6 blocks of an area (its B = 9 bodies, agents first), S = N * A slots.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mlagents_envs.base_env import DimensionProperty

from mappo_unity.scenes.cooperative_push_block import grid
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
from mappo_unity.scenes.push_block.contacts import Room, as_complex, turns_of
from mappo_unity.scenes.push_block.spawn import SPAWN_Y, at_query_height, draw_spots

NUM_AGENTS, NUM_BLOCKS = 3, 6
NUM_BODIES = NUM_AGENTS + NUM_BLOCKS
BLOCK_HALVES = np.array([0.5, 0.5, 1.0, 1.0, 1.5, 1.5])  # m
BLOCK_MASSES = (10.0, 10.0, 100.0, 100.0, 150.0, 150.0)  # kg
BLOCK_REWARDS = np.array([1.0, 1.0, 2.0, 2.0, 3.0, 3.0])  # for the group
TAGS = np.repeat([grid.AGENT, grid.SMALL, grid.LARGE, grid.VERY_LARGE], [NUM_AGENTS, 2, 2, 2]).astype(np.int8)
TIME_LIMIT = 5000  # ticks since the area's reset
TICK_REWARD = np.float32(-0.5 / TIME_LIMIT)  # for the group
WALL, GOAL_FACE = 12.5, -8.35  # m
SPOT_HALF = 1.5  # m: half the width of the free square around a new spot
FLAT = (DimensionProperty.NONE, *[DimensionProperty.TRANSLATIONAL_EQUIVARIANCE] * 2)
GRID = Sensor(
    "GridSensor-OneHot", (grid.NUM_TAGS, grid.CELLS, grid.CELLS), dimension_property=FLAT, in_bytes=True
)


class CooperativePushBlock(Scene):
    """Run CooperativePushBlock; parameter `gravity` (m/s^2, downward)."""

    NAME = "CooperativePushBlock"
    DEFAULT_NUM_AREAS = 4
    BEHAVIORS = (
        Behavior("PushBlockCollab?team=0", (GRID, Sensor("RBSensor", (10,))), branches=(len(ACTIONS),)),
    )
    AREA_BEHAVIORS = (0,) * NUM_AGENTS
    AREA_GROUPS = (0,) * NUM_AGENTS
    PARAMETERS = {"gravity": Parameter(1.5 * 9.81, at_once=True)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        block = [(half, BLOCK_HALF_Y, half) for half in BLOCK_HALVES]
        self.boxes = SlidingBoxes(
            self.num_areas,
            half=np.array([AGENT_HALF] * NUM_AGENTS + block),
            mass=(AGENT_MASS,) * NUM_AGENTS + BLOCK_MASSES,
            drag=(AGENT_DRAG,) * NUM_AGENTS + (BLOCK_DRAG,) * NUM_BLOCKS,
            turns=(False,) * NUM_AGENTS + (True,) * NUM_BLOCKS,
            room=Room(np.full(2, -WALL), np.full(2, WALL)),
            gravity=self.parameters["gravity"],
        )
        self.boxes.place[:] = 1e3 * np.arange(1, NUM_BODIES + 1)[:, None]  # nowhere before the first reset
        self.slots = np.arange(self.num_slots).reshape(self.num_areas, NUM_AGENTS)
        self.timer = np.zeros(self.num_areas, np.int64)  # ticks since the area's reset
        self._drive = np.zeros((self.num_areas, NUM_BODIES), complex)

    def reset(self) -> None:
        """Reset the academy; only the first time are the areas made anew, as in Unity."""
        self._check_open()
        if not self.started:
            self._reset_areas(np.arange(self.num_areas))
        super().reset()

    def begin_episode(self, slots: np.ndarray) -> None:
        """Do nothing: all belongs to the area's reset."""

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the grids, and the velocity in the agent's frame (with a constant pose)."""
        area, agent = np.divmod(slots, NUM_AGENTS)
        boxes = self.boxes
        place, turn = as_complex(boxes.place)[area], turns_of(boxes.yaw)[area]
        row = np.arange(len(slots))
        mine = turn[row, agent]
        seen = boxes.present[area] & (np.arange(NUM_BODIES) != agent[:, None])
        view = grid.View(place[row, agent], mine)
        cells = grid.look(view, place, turn, as_complex(boxes.half)[area], TAGS, seen)

        velocity_x, velocity_z, _ = boxes.motion[area, agent].T
        velocity = (velocity_x + 1j * velocity_z) * mine.conj()
        body = np.zeros((len(slots), 10), np.float32)
        body[:, 0], body[:, 2] = velocity.real, velocity.imag
        body[:, 1] = boxes.fall[area, agent]
        body[:, 9] = 1.0  # the pose relative to the agent itself: no offset, no rotation
        return [cells, body]

    def act(self, slots: np.ndarray) -> None:
        """Turn the agents and set their changes of velocity."""
        action = self.agents.discrete[:, 0].reshape(self.slots.shape)
        drive, yaw = drives(action, self.boxes.yaw[:, :NUM_AGENTS])
        self._drive[:, :NUM_AGENTS], self.boxes.yaw[:, :NUM_AGENTS] = drive, yaw

    def controllers(self) -> None:
        """Count the areas' time, interrupt groups at its limit, then charge every group for the tick."""
        self.timer += 1
        late = self.timer >= TIME_LIMIT
        if np.count_nonzero(late):
            self._end_groups(late.nonzero()[0], interrupted=True)
        self.agents.group_reward += TICK_REWARD

    def simulate(self) -> None:
        """Move all bodies by one tick; blocks that enter the goal vanish for a reward, the last one ends."""
        boxes = self.boxes
        boxes.step(self._drive)
        blocks = slice(NUM_AGENTS, NUM_BODIES)
        entered = boxes.place[:, blocks, 1] - boxes.extent[:, blocks, 1] < GOAL_FACE
        entered &= boxes.present[:, blocks]
        if not np.count_nonzero(entered):
            return

        boxes.present[:, blocks] &= ~entered
        areas = np.flatnonzero(entered.any(axis=1))
        reward = entered[areas] @ BLOCK_REWARDS
        self.add_group_reward(self.slots[areas].ravel(), np.repeat(reward, NUM_AGENTS))
        self._end_groups(areas[~boxes.present[areas, blocks].any(axis=1)])

    def parameter_changed(self, name: str) -> None:
        """Apply gravity at once."""
        self.boxes.gravity = self.parameters["gravity"]

    def pass_time(self, share: np.ndarray) -> None:
        """Set the areas' timers."""
        self.timer[:] = share * TIME_LIMIT

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies and the areas' time."""
        return {"boxes": self.boxes.get_state(), "timer": self.timer.copy()}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`; drives are of one tick only and need no restoring."""
        self.boxes.gravity = self.parameters["gravity"]
        self.boxes.set_state(state["boxes"])
        self.timer[:] = state["timer"]

    def _end_groups(self, areas: np.ndarray, interrupted: bool = False) -> None:
        """End the groups' episodes and reset their areas [n]."""
        if areas.size:
            self.end_episode(self.slots[areas].ravel(), interrupted)
            self._reset_areas(areas)

    def _reset_areas(self, areas: np.ndarray) -> None:
        """Begin the areas anew: agents, then blocks at rest on free spots, with any heading."""
        boxes, count = self.boxes, len(areas)
        self.timer[areas] = 0
        for body in range(NUM_BODIES):
            # Agents that are not moved yet are in the way; blocks on the floor are too low to be.
            there = at_query_height(boxes.height[areas], boxes.rest) & boxes.present[areas]
            boxes.place[areas, body] = draw_spots(
                self.rng,
                SPOT_HALF,
                -WALL,
                boxes.place[areas],
                boxes.yaw[areas],
                boxes.half[areas],
                there,
            )
            boxes.height[areas, body] = SPAWN_Y
            boxes.yaw[areas, body] = self.rng.uniform(0.0, 2 * np.pi, count)
            boxes.motion[areas, body] = 0.0
            boxes.fall[areas, body] = 0.0
            boxes.present[areas, body] = True
