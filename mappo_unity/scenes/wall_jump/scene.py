"""WallJump: reach the goal behind a wall of no, small or big height; the big one needs the block.

Facts: docs/scenes/WallJump.md. One agent an area; the wall's height of each episode decides whether the agent
requests decisions as SmallWallJump or as BigWallJump. Bodies: `bodies.py`. Legend: N areas = slots.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.ground import TICK_S
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.wall_jump.bodies import WallJumpBodies
from mappo_unity.scenes.wall_jump.sensors import observe_rays

SMALL, BIG = 0, 1  # behaviors
CONFIGURATIONS = 5
BEHAVIOR_OF = np.array([SMALL, SMALL, BIG, BIG, BIG])
HEIGHT_OF = np.array(["no_wall_height", "small_wall_height", *["big_wall_height"] * 3])
NOTHING_PENDING = -1

RUN_SPEED = 3.0  # m/s of velocity change in a tick
TURN = np.radians(300.0) * TICK_S * np.array([0.0, -1.0, 1.0])  # by action: none, left, right
FORWARD = np.array([0.0, 1.0, -1.0])  # none, forward, backward
SIDE = np.array([0.0, -0.6, 0.6])  # none, left, right
IN_AIR = 0.5  # share of the speed while not grounded
JUMP_S, JUMP_HEIGHT = np.float32(0.2), 2.75  # float32 as in Unity: 11 ticks
JUMP_RATE = 777.0 * TICK_S  # 1/s: desired velocity by distance from the jump's target
JUMP_CHANGE = 10.0  # m/s: velocity changes by at most this in a tick
FALLING = 111.0  # m/s^2, downward, beside gravity
TICK_REWARD = np.float32(-0.0005)
GROUND_CENTRE, OBS_SCALE = np.array([0.0, 0.0, -4.0]), 20.0

_SENSORS = (
    Sensor("OffsetRayPerceptionSensor", (35,), stack=6),
    Sensor("RayPerceptionSensor", (35,), stack=6),
    Sensor("VectorSensor_size4", (4,), stack=6),
)


class WallJump(Scene):
    """Run WallJump; parameters `no_wall_height`, `small_wall_height`, `big_wall_height` (m, 0 or less: no
    wall; its top stands at half of that) and `gravity` (m/s^2, downward).

    State (N areas): `bodies`; `jump_left_s` float32 [N], `jump_start_y` [N]; `configuration` int64 [N], drawn
    and not yet applied, or NOTHING_PENDING; `drive` [N, 3] m/s and `acceleration` [N] m/s^2 of this tick.
    """

    NAME = "WallJump"
    DEFAULT_NUM_AREAS = 24
    BEHAVIORS = (
        Behavior("SmallWallJump?team=0", _SENSORS, branches=(3, 3, 3, 2)),
        Behavior("BigWallJump?team=0", _SENSORS, branches=(3, 3, 3, 2)),
    )
    MAX_STEP = 2000
    PARAMETERS = {
        "no_wall_height": Parameter(0.0),
        "small_wall_height": Parameter(4.0),
        "big_wall_height": Parameter(8.0),
        "gravity": Parameter(2.75 * 9.81, at_once=True),
    }

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.bodies = WallJumpBodies(self.num_areas)

        self.jump_left_s = np.zeros(self.num_areas, np.float32)
        self.jump_start_y = np.zeros(self.num_areas)
        self.configuration = np.full(self.num_areas, NOTHING_PENDING)

        self.drive = np.zeros((self.num_areas, 3))
        self.acceleration = np.zeros(self.num_areas)
        self._frames: list[np.ndarray] | None = (
            None  # of all slots, from the decisions of a tick to its actions
        )

    def fixed_update(self) -> None:
        """Apply drawn configurations: the wall's height and the behavior.

        At the start all agents draw one and reload their policy, so that each sends a terminal record as
        SmallWallJump; later only those that move do.
        """
        if not self.started:
            self.configuration[:] = self.rng.integers(0, CONFIGURATIONS, self.num_areas)

        slots = (self.configuration != NOTHING_PENDING).nonzero()[0]
        if not slots.size:
            return

        drawn = self.configuration[slots]
        for name in dict.fromkeys(HEIGHT_OF):
            areas = slots[HEIGHT_OF[drawn] == name]
            self.bodies.wall_height[areas] = self.parameters.draw(name, len(areas))
        self.configuration[slots] = NOTHING_PENDING

        behavior = BEHAVIOR_OF[drawn]
        moves = (self.agents.behavior[slots] != behavior) | (not self.started)
        if moves.any():
            self.switch_behavior(slots[moves], behavior[moves])

    def begin_episode(self, slots: np.ndarray) -> None:
        """Place block and agent, draw a configuration; heading and a running jump stay."""
        self._place_blocks(slots)

        self.bodies.position[slots, 0] = 18 * (self.rng.random(len(slots)) - 0.5)
        self.bodies.position[slots, 1:] = 1.0, -12.0
        self.bodies.velocity[slots] = 0

        self.configuration[slots] = self.rng.integers(0, CONFIGURATIONS, len(slots))

    def decides(self) -> bool | np.ndarray:
        """Look once for both behaviors in a tick of decisions, which costs half as much."""
        asked = super().decides()
        self._frames = None if asked is False else self._look(np.arange(self.num_slots))
        return asked

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the upward rays, the level rays, and the place with the small ground check."""
        if self._frames is None:
            return self._look(slots)
        return [frame[slots] for frame in self._frames]

    def act(self, slots: np.ndarray) -> None:
        """Turn, drive and jump; every tick costs 0.0005, a fall of agent or block ends with -1."""
        bodies, action = self.bodies, self.agents.discrete.T
        self._frames = None
        self.agents.reward += TICK_REWARD
        grounded = bodies.grounded()

        sideways = SIDE[action[2]]
        ahead = FORWARD[action[0]] * (sideways == 0)  # a step to the side replaces it

        speed, sin, cos = np.where(grounded, 1.0, IN_AIR), np.sin(bodies.yaw), np.cos(bodies.yaw)
        direction = np.zeros((self.num_slots, 3))
        direction[:, 0] = speed * (ahead * sin + sideways * cos)
        direction[:, 2] = speed * (ahead * cos - sideways * sin)

        # a running jump is not begun again, and a jump needs ground below the feet's middle
        starts = (action[3] == 1) & (self.jump_left_s <= 0)
        if starts.any():
            starts &= bodies.stands_over()
            self.jump_left_s[starts] = JUMP_S
            self.jump_start_y[starts] = bodies.position[starts, 1]

        # after the direction: a turn counts from the next tick
        bodies.yaw += TURN[action[1]]
        self.drive = RUN_SPEED * direction

        jumps = self.jump_left_s > 0
        if jumps.any():
            self._steer_jumps(jumps.nonzero()[0], direction)

        falling = ~jumps & ~grounded
        self.acceleration = self.parameters["gravity"] + FALLING * falling
        self.jump_left_s -= np.float32(TICK_S)

        fallen = bodies.fallen()
        if fallen.any():
            self.set_reward(fallen, -1.0)
            self.end_episode(fallen)
            self._place_blocks(np.flatnonzero(fallen))

    def simulate(self) -> None:
        """Move the bodies by one tick; an agent in the goal and over ground ends with +1."""
        self.bodies.step(self.drive, self.acceleration)

        inside = self.bodies.in_goal()
        if inside.size:
            inside = inside[self.bodies.stands_over(inside)]
            if inside.size:
                self.set_reward(inside, 1.0)
                self.end_episode(inside)

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies, running jumps and pending configurations."""
        return {
            "bodies": self.bodies.get_state(),
            "jump_left_s": self.jump_left_s.copy(),
            "jump_start_y": self.jump_start_y.copy(),
            "configuration": self.configuration.copy(),
        }

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`; drives are of one tick only and need no restoring."""
        self.bodies.set_state(state["bodies"])
        self.jump_left_s[:] = state["jump_left_s"]
        self.jump_start_y[:] = state["jump_start_y"]
        self.configuration[:] = state["configuration"]
        self._frames = None

    def _look(self, slots: np.ndarray) -> list[np.ndarray]:
        bodies = self.bodies
        upward, level = observe_rays(
            bodies.position[slots], bodies.yaw[slots], bodies.block[slots], bodies.wall_height[slots]
        )

        vector = np.empty((len(slots), 4), np.float32)
        vector[:, :3] = (bodies.position[slots] - GROUND_CENTRE) / OBS_SCALE
        vector[:, 3] = bodies.stands_over(slots)

        return [upward, level, vector]

    def _place_blocks(self, slots: np.ndarray) -> None:
        bodies = self.bodies
        bodies.block[slots, 0] = self.rng.uniform(-8.1, 8.1, len(slots))
        bodies.block[slots, 2] = -6.27 + self.rng.uniform(-3.5, 3.5, len(slots))
        bodies.block_velocity[slots] = 0

    def _steer_jumps(self, slots: np.ndarray, direction: np.ndarray) -> None:
        """Move velocities towards the jump's target, at once; the drive is added by the physics step."""
        bodies = self.bodies
        # horizontally the target moves along with the agent's own drive
        way = direction[slots]
        way[:, 1] = self.jump_start_y[slots] + JUMP_HEIGHT - bodies.position[slots, 1]

        change = JUMP_RATE * way - bodies.velocity[slots]
        length = np.sqrt(np.einsum("ni,ni->n", change, change))
        bodies.velocity[slots] += change * np.minimum(1.0, JUMP_CHANGE / np.maximum(length, 1e-12))[:, None]
