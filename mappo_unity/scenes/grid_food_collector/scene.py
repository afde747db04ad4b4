"""GridFoodCollector: five agents an area collect good food, avoid bad food and freeze each other by laser.

Facts: docs/scenes/GridFoodCollector.md. Contacts: `physics.py`; laser: `laser.py`; observation:
`grid_sensor.py` of the core. Heights count from the floor, which lies 0.5 m above the area's origin in Unity.
Legend: N areas, A agents and F foods of an area; slot = area * A + agent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mlagents_envs.base_env import DimensionProperty

from mappo_unity.scenes.core import grid_sensor
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.grid_food_collector import laser as food_laser
from mappo_unity.scenes.grid_food_collector.physics import BALL_RADIUS, WALL, FoodPhysics

AGENTS, GOOD, BAD = 5, 25, 25  # of an area
FOOD, AGENT, WALLS, BAD_FOOD, FROZEN = range(5)  # channels of the grid
RANGE = 45.0  # m: half-width of the square of all spawns
AGENT_HEIGHT, RESPAWN_HEIGHT = 1.5, 2.5  # m, of the centres at a spawn
FOOD_HEIGHT = BALL_RADIUS  # Unity creates food 0.25 m lower, inside the floor, and the engine lifts it
WALL_LINES, WALL_HEIGHT = (WALL, WALL + 1.0), 2.5  # m: inner and outer faces
MOVE_SPEED = 2.0  # m/s a tick at full throttle
TURN_DEGREES = 6  # a tick, whatever the size of the turn action beyond TURN_THRESHOLD
TURN_THRESHOLD = 1e-3
SHOT_DRIVE, SHOT_KEPT = 0.5, 0.75  # shares of drive and of speed left while shooting
BRAKE_ABOVE, BRAKE_KEPT = 5.0, 0.95  # m/s; share of speed left in a tick
FROZEN_TICKS = 201  # the first tick more than 4 s later (the step is a little less than 0.02 s)
FLAT = (DimensionProperty.NONE, *[DimensionProperty.TRANSLATIONAL_EQUIVARIANCE] * 2)
GRID = Sensor(
    "GridSensor-OneHot", (5, grid_sensor.CELLS, grid_sensor.CELLS), dimension_property=FLAT, in_bytes=True
)


class GridFoodCollector(Scene):
    """Run GridFoodCollector; parameters `agent_scale` and `laser_length` (accepted, no effect)."""

    NAME = "GridFoodCollector"
    DEFAULT_NUM_AREAS = 4
    BEHAVIORS = (Behavior("GridFoodCollector?team=0", (GRID,), continuous=3, branches=(2,)),)
    AREA_BEHAVIORS = (0,) * AGENTS
    AREA_GROUPS = (-1,) * AGENTS
    MAX_STEP = 5000
    PARAMETERS = {"laser_length": Parameter(1.0, above=0.0), "agent_scale": Parameter(1.0, above=0.0)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.physics = FoodPhysics(self.num_areas, AGENTS, GOOD + BAD)
        shape = (self.num_areas, AGENTS)

        self.yaw_degrees = np.zeros(shape, np.int64)  # whole degrees: only these ever occur
        self.frozen = np.zeros(shape, bool)
        self.frozen_tick = np.zeros(shape, np.int64)
        self.laser_on = np.zeros(shape, bool)
        self.tick = 0  # of the scene, never reset

        self._drive = np.zeros((3, *shape))
        self._new_food = False
        self._food_tags = np.repeat([FOOD, BAD_FOOD], [GOOD, BAD])
        self._food_rewards = np.repeat([1.0, -1.0], [GOOD, BAD])

    def reset(self) -> None:
        """Reset the academy; this alone makes all food anew."""
        self._new_food = True
        super().reset()

    def begin_episode(self, slots: np.ndarray) -> None:
        """Put agents at rest anywhere, 1 m above the floor; food stays where it is."""
        if self._new_food:
            self._new_food = False
            self._create_food()

        area, agent = np.divmod(slots, AGENTS)
        physics, num = self.physics, len(slots)
        physics.agent_velocity[:, area, agent] = 0
        physics.agent_position[1, area, agent] = AGENT_HEIGHT
        physics.agent_position[::2, area, agent] = self.rng.uniform(-RANGE, RANGE, (2, num))
        physics.agent_half[area, agent] = 0.5 * self.parameters.draw("agent_scale", num)

        self.yaw_degrees[area, agent] = self.rng.integers(0, 360, num)
        self.frozen[area, agent] = False
        self.laser_on[area, agent] = False
        self._drive[:, area, agent] = 0
        self._turn_bodies()

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the grids of food, agents, walls, bad food and frozen agents around `slots`."""
        area, agent = np.divmod(slots, AGENTS)
        physics = self.physics
        place, yaw = physics.agent_position[:, area, agent], physics.agent_yaw[area, agent]
        # The agent's size spreads the cells of its grid; the cells themselves stay as large.
        scale = 2 * physics.agent_half[area, agent]
        view = grid_sensor.View(place[0], place[2], np.sin(yaw), np.cos(yaw), scale)

        food = physics.ball_position[:, area] - place[:, :, None]
        others = physics.agent_position[:, area] - place[:, :, None]
        parts = [
            grid_sensor.spheres(view, food, BALL_RADIUS, np.broadcast_to(self._food_tags, food.shape[1:])),
            grid_sensor.upright_boxes(
                view,
                others,
                physics.agent_half[area],
                physics.agent_yaw[area] - yaw[:, None],
                np.where(self.frozen[area], FROZEN, AGENT),
                np.arange(AGENTS) != agent[:, None],
            ),
            grid_sensor.square_lines(view, WALL_LINES, WALLS, place[1] <= WALL_HEIGHT),
        ]

        return [grid_sensor.one_hot(view, GRID.shape[0], parts)]

    def act(self, slots: np.ndarray) -> None:
        """Push, turn and shoot; agents act one after another, so a shot can stop a later agent at once."""
        shape = self.frozen.shape
        throttle = np.clip(self.agents.continuous.astype(np.float64), -1, 1).reshape(*shape, 3)
        command = self.agents.discrete[:, 0].reshape(shape) > 0
        turn = np.where(np.abs(throttle[:, :, 2]) > TURN_THRESHOLD, np.sign(throttle[:, :, 2]), 0)
        turned = (self.yaw_degrees - TURN_DEGREES * turn.astype(np.int64)) % 360  # positive: to the left

        # Shots first: whom an earlier agent freezes is not active in this tick.
        active = self._shoot(command, turned)
        self.laser_on = active & command

        # The push goes along the heading before the turn.
        self._push(throttle, active)
        self.yaw_degrees = np.where(active, turned, self.yaw_degrees)
        self._turn_bodies()

        self.tick += 1

    def simulate(self) -> None:
        """Advance physics; food that agents touch is eaten and falls in anywhere with its speed kept."""
        area, agent, food = self.physics.step(self._drive)
        self._drive[:] = 0

        if area.size:
            reward = self._food_rewards[food]
            # An agent may eat several at once, of which an indexed sum would count one.
            self.agents.reward += np.bincount(area * AGENTS + agent, reward, self.num_slots).astype(
                np.float32
            )
            self.physics.ball_position[::2, area, food] = self.rng.uniform(-RANGE, RANGE, (2, area.size))
            self.physics.ball_position[1, area, food] = RESPAWN_HEIGHT

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies and who is frozen since when."""
        arrays = {name: getattr(self, name).copy() for name in _STATE}
        return {"physics": self.physics.get_state(), "tick": self.tick, **arrays}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        self.physics.set_state(state["physics"])
        self.tick = state["tick"]
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _create_food(self) -> None:
        physics = self.physics
        physics.ball_position[1] = FOOD_HEIGHT
        physics.ball_position[::2] = self.rng.uniform(-RANGE, RANGE, physics.ball_position[::2].shape)
        physics.ball_velocity[...] = 0
        physics.ball_spin[...] = 0

    def _shoot(self, command: np.ndarray, turned: np.ndarray) -> np.ndarray:
        """Freeze who is hit, thaw who has waited; return who is free to act, bool [N, A].

        For the rays everybody has turned already, also those who act later: 6 degrees of a box.
        """
        thawing = self.frozen & (self.tick - self.frozen_tick >= FROZEN_TICKS)
        free = ~self.frozen | thawing

        hits = np.full(command.shape, food_laser.NOBODY)
        if (command & free).any():
            yaw = np.radians(np.where(free, turned, self.yaw_degrees))
            hits = food_laser.targets(self.physics, yaw, command & free)

        areas = np.flatnonzero((hits >= 0).any(axis=1))
        frozen, hits = self.frozen[areas], hits[areas]

        for agent in range(AGENTS if areas.size else 0):  # in turn: whom an earlier one stops does not act
            frozen[:, agent] &= ~thawing[areas, agent]
            free[areas, agent] = ~frozen[:, agent]
            shot = np.flatnonzero(~frozen[:, agent] & (hits[:, agent] >= 0))
            # Who is frozen already does not wait any longer for a second shot.
            shot = shot[~frozen[shot, hits[shot, agent]]]
            frozen[shot, hits[shot, agent]] = True
            self.frozen_tick[areas[shot], hits[shot, agent]] = self.tick

        self.frozen &= ~thawing
        self.frozen[areas] = frozen
        return free

    def _push(self, throttle: np.ndarray, active: np.ndarray) -> None:
        """Set the drives of this tick and brake at once who shoots or is fast."""
        velocity = self.physics.agent_velocity
        velocity *= np.where(self.laser_on, SHOT_KEPT, 1.0)
        squared = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
        velocity *= np.where(squared > BRAKE_ABOVE**2, BRAKE_KEPT, 1.0)

        speed = np.where(self.laser_on, MOVE_SPEED * SHOT_DRIVE, MOVE_SPEED) * active
        ahead, right = throttle[:, :, 0] * speed, throttle[:, :, 1] * speed
        sin, cos = np.sin(self.physics.agent_yaw), np.cos(self.physics.agent_yaw)
        self._drive[0] = ahead * sin + right * cos
        self._drive[2] = ahead * cos - right * sin

    def _turn_bodies(self) -> None:
        self.physics.agent_yaw[...] = np.radians(self.yaw_degrees)


_STATE = ("yaw_degrees", "frozen", "frozen_tick", "laser_on", "_drive")
