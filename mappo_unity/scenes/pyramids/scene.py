"""Pyramids: press the switch, find the brick pyramid that appears, topple it and touch the goal on its top.

Facts: docs/scenes/Pyramids.md. This module holds the rules: rewards, episodes, resets, observations; bodies
are in `bodies.py` and `bricks.py`, rays in `sight.py`.
Legend: N areas = slots (one agent an area).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Sensor
from mappo_unity.scenes.pyramids.bodies import PyramidsBodies
from mappo_unity.scenes.pyramids.bricks import PyramidsBricks
from mappo_unity.scenes.pyramids.layout import ZONE_RANGE, ZONES
from mappo_unity.scenes.pyramids.sight import EYES, see

RUN_SPEED = 2.0  # m/s gained in a tick
TURN_RAD = np.radians(200.0 * 0.02)  # in a tick
GOAL_REWARD = 2.0

# One row an action: gained speed ahead (m/s), turn to the right (rad), in a tick.
ACTIONS = np.array([[0.0, 0.0], [RUN_SPEED, 0.0], [-RUN_SPEED, 0.0], [0.0, TURN_RAD], [0.0, -TURN_RAD]])


class Pyramids(Scene):
    """Run Pyramids; it has no parameters."""

    NAME = "Pyramids"
    DEFAULT_NUM_AREAS = 16
    BEHAVIORS = (
        Behavior(
            "Pyramids?team=0",
            (
                EYES[0].sensor("RayPerceptionSensor"),
                EYES[1].sensor("RayPerceptionSensor1"),
                EYES[2].sensor("RayPerceptionSensor2"),
                Sensor("VectorSensor_size4", (4,)),
            ),
            branches=(len(ACTIONS),),
        ),
    )
    MAX_STEP = 5000

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.bodies = PyramidsBodies(self.num_areas)
        self.bricks = PyramidsBricks(self.num_areas, self.num_threads)
        self.switch_on = np.zeros(self.num_areas, bool)
        self.brick_spot = np.zeros((self.num_areas, 2))  # x, z where the brick pyramid will appear

    def begin_episode(self, slots: np.ndarray) -> None:
        """Place agent, switch, six stone pyramids, and the spot of the brick pyramid, in nine zones."""
        zones = self.rng.permuted(np.tile(np.arange(len(ZONES)), (len(slots), 1)), axis=1)
        spots = ZONES[zones] + self.rng.uniform(-ZONE_RANGE, ZONE_RANGE, (*zones.shape, 2))
        yaw = np.radians(self.rng.integers(0, 360, len(slots)))

        # the third zone is kept for the brick pyramid, which appears when the switch is pressed
        self.brick_spot[slots] = spots[:, 2]
        self.bodies.place(slots, np.delete(spots, 2, axis=1), yaw)
        self.bricks.remove(slots)
        self.bricks.surround(slots, spots[:, 3:])

        self.switch_on[slots] = False

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the three ray sensors, and the switch's state with the velocity in the agent's frame."""
        vector = np.empty((len(slots), 4), np.float32)
        vector[:, 0] = self.switch_on[slots]
        vector[:, 1:] = self.bodies.local_velocity(slots)
        return [*see(self.bodies, self.bricks, self.switch_on, slots), vector]

    def act(self, slots: np.ndarray) -> None:
        """Take the price of a tick, turn the agents and set their changes of velocity."""
        self.agents.reward -= np.float32(1.0 / self.MAX_STEP)
        ahead, turn = ACTIONS[self.agents.discrete[:, 0]].T
        self.bodies.push(ahead, turn)

    def simulate(self) -> None:
        """Move all bodies by one tick; a touched switch turns on, a touched goal ends the episode."""
        bodies, bricks = self.bodies, self.bricks
        pressed = bodies.solve() & ~self.switch_on

        # where a pile is awake the bricks' engine moves the agent, too; `move` leaves their x and z alone
        awake = bricks.wake(bodies.position, bodies.velocity, bodies.switch_position, bodies.switch_spin)
        switch = (bodies.switch_position, bodies.switch_yaw)
        goal = bricks.step(bodies.position, bodies.velocity, bodies.yaw, switch)
        bodies.move(awake)

        # after the motion: a pile falls from the next tick on
        if pressed.any():
            areas = np.flatnonzero(pressed)
            self.switch_on[areas] = True
            bricks.appear(areas, self.brick_spot[areas])

        if goal.any():
            self.set_reward(goal, GOAL_REWARD)
            self.end_episode(goal)

    def scene_state(self) -> dict[str, Any]:
        """Return all bodies, the switches' state and the spots of the brick pyramids."""
        return {
            "bodies": self.bodies.get_state(),
            "bricks": self.bricks.get_state(),
            "switch_on": self.switch_on.copy(),
            "brick_spot": self.brick_spot.copy(),
        }

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        self.bodies.set_state(state["bodies"])
        self.bricks.set_state(state["bricks"])
        self.switch_on[:], self.brick_spot[:] = state["switch_on"], state["brick_spot"]
