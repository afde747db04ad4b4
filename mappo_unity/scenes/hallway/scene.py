"""Hallway: remember the symbol passed on the way, then touch the goal of the same symbol.

Facts: docs/scenes/Hallway.md. One agent an area; no engine: a box on level ground between walls, one solid
symbol block and two goals, in numpy over all areas. Area coordinates (x right, y up, z along the hall).
Legend: N areas = slots (one agent an area).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S, axis_gaps, box_gap, slide, stop
from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import cast_rectangles, flat_radius
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor

AGENT_HALF = (0.5, 0.5, 0.5)
REST_Y = 1.0  # of the agent's centre, on the floor
ROOM_HALF = (9.5, 24.75)  # x, z: inner faces of the walls
SYMBOL_HALF = (2.0, 2.0, 0.5)
GOAL_X = 7.0  # of both goals, left and right
PLATE_CENTRE, PLATE_HALF = (0.5, 22.29), (2.0, 0.05, 2.0)  # y, z of the centre
PANEL_CENTRE, PANEL_HALF = (2.5, 24.79), (2.04, 2.005, 0.5725)

RUN_SPEED = 1.5  # m/s of velocity change in a tick
TURN_RAD = np.radians(150.0) * TICK_S
DRAG_KEPT = 1.0 - 2.0 * TICK_S
MAX_STEP = 3000
DRIVE = np.array([0.0, RUN_SPEED, -RUN_SPEED, 0.0, 0.0])  # by action: none, forward, backward, right, left
TURN = np.array([0.0, 0.0, 0.0, TURN_RAD, -TURN_RAD])

EYES = RaySensor(tags=5, rays_per_side=2, max_degrees=70, length=12)
O_GOAL, X_GOAL, O_BLOCK, X_BLOCK, WALL = range(5)  # tags
TOUCH_GAP = 0.01  # m: nearer colliders are skipped by the rays, as those touched in recordings from Unity
# x, z of centre and half-sizes: right and left plate, right and left panel, four walls; the block's is last
_CENTRES = np.array(
    [(7, 22.29), (-7, 22.29), (7, 24.79), (-7, 24.79), (9.75, 0), (-9.75, 0), (0, 25), (0, -25)]
)
_HALVES = np.array([(2, 2)] * 2 + [(2.04, 0.5725)] * 2 + [(0.25, 25)] * 2 + [(10, 0.25)] * 2 + [(2, 0.5)])
_STATE = ("position", "velocity", "yaw", "symbol", "shows_x", "o_side")


class Hallway(Scene):
    """Run Hallway; parameter `gravity` (m/s^2, downward).

    State (N areas): `position`, `velocity` of the agent [N, 3], `yaw` [N] rad, `symbol` [N, 3] the shown
    block's centre, `shows_x` bool [N] (else O), `o_side` [N]: +1 where the O goal is right, -1 left.
    """

    NAME = "Hallway"
    DEFAULT_NUM_AREAS = 16
    BEHAVIORS = (
        Behavior(
            "Hallway?team=0",
            (EYES.sensor("RayPerceptionSensor", stack=3), Sensor("VectorSensor_size1", (1,), stack=3)),
            branches=(5,),
        ),
    )
    DECISION_PERIOD = 6
    MAX_STEP = MAX_STEP
    PARAMETERS = {"gravity": Parameter(2 * 9.81, at_once=True)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.position = np.tile([0.0, REST_Y, -15.0], (self.num_areas, 1))
        self.velocity = np.zeros((self.num_areas, 3))
        self.yaw = np.zeros(self.num_areas)

        self.symbol = np.tile([0.0, 2.5, 0.0], (self.num_areas, 1))
        self.shows_x = np.zeros(self.num_areas, bool)
        self.o_side = np.ones(self.num_areas)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Show a symbol, put the agent far back with any heading, place the goals."""
        count = len(slots)
        self.shows_x[slots] = self.rng.random(count) < 0.5
        # Only the O block is moved to a side; the X block stands at x = 0 in Unity, too.
        self.symbol[slots, 0] = np.where(self.shows_x[slots], 0.0, self.rng.uniform(-3, 3, count))
        self.symbol[slots, 2] = self.rng.uniform(-5, 5, count)

        self.position[slots, 0] = self.rng.uniform(-3, 3, count)
        self.position[slots, 1] = 1.5
        self.position[slots, 2] = self.rng.uniform(-20, -10, count)
        self.yaw[slots] = self.rng.uniform(0, 2 * np.pi, count)
        self.velocity[slots] = 0

        self.o_side[slots] = np.where(self.rng.random(count) < 0.5, 1.0, -1.0)

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the rays and the share of the time that has passed."""
        clock = (self.agents.step_count[slots] / MAX_STEP).astype(np.float32)
        return [self._rays(slots), clock[:, None]]

    def act(self, slots: np.ndarray) -> None:
        """Drive or turn; every tick costs 1/3000."""
        action = self.agents.discrete[:, 0]
        drive = DRIVE[action]  # an agent never drives and turns at once: the heading's order is free
        self.velocity[:, 0] += drive * np.sin(self.yaw)
        self.velocity[:, 2] += drive * np.cos(self.yaw)
        self.yaw += TURN[action]
        self.agents.reward -= np.float32(1 / MAX_STEP)

    def simulate(self) -> None:
        """Move the agents by one tick; a touched goal ends the episode with +1 (right) or -0.1 (wrong)."""
        velocity, start = self.velocity, self.position.copy()
        velocity[:, 1] -= self.parameters["gravity"] * TICK_S
        velocity *= DRAG_KEPT

        # Just as much as lands it on the floor; friction takes its share of the same impulse.
        landing = np.maximum((REST_Y - start[:, 1]) / TICK_S - velocity[:, 1], 0.0)
        velocity[:, 1] += landing
        slide(velocity, landing)

        self.position += velocity * TICK_S
        self._stop_at_walls()
        self._stop_at_symbols(start)
        self._touch_goals()

    def scene_state(self) -> dict[str, Any]:
        """Return the bodies, the shown symbols and the sides of the goals."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _rays(self, slots: np.ndarray) -> np.ndarray:
        """Cast the level rays at goals, walls and the block; the floor is not seen by them."""
        count, position = len(slots), self.position[slots]
        origin, direction = EYES.casts(position, self.yaw[slots])

        centres = np.empty((count, 1, 9, 2))
        centres[:, 0, :8] = _CENTRES
        centres[:, 0, 8] = self.symbol[slots][:, ::2]

        radius = np.full((count, 1, 9), EYES.radius)
        # The rays pass above the thin plates: only a part of the cast sphere meets them.
        plate = PLATE_CENTRE[0] + np.array([-PLATE_HALF[1], PLATE_HALF[1]])
        radius[:, 0, :2] = flat_radius(EYES.radius, position[:, 1:2], plate[:1], plate[1:])

        distance = cast_rectangles(
            origin[..., ::2], direction[..., ::2], radius, centres, _HALVES, skip_gap=TOUCH_GAP
        )

        tags = np.full((count, 9), WALL)
        # Columns 0 and 2 are plate and panel on the right, 1 and 3 those on the left.
        tags[:, 0:4:2] = np.where(self.o_side[slots] > 0, O_GOAL, X_GOAL)[:, None]
        tags[:, 1:4:2] = np.where(self.o_side[slots] > 0, X_GOAL, O_GOAL)[:, None]
        tags[:, 8] = np.where(self.shows_x[slots], X_BLOCK, O_BLOCK)

        return EYES.encode(distance, tags)

    def _stop_at_walls(self) -> None:
        # Along x and z a turned square reaches further.
        reach = AGENT_HALF[0] * (np.abs(np.sin(self.yaw)) + np.abs(np.cos(self.yaw)))

        for axis, inner in ((0, ROOM_HALF[0]), (2, ROOM_HALF[1])):
            place = self.position[:, axis]
            hit = np.flatnonzero(np.abs(place) + reach > inner)
            if hit.size:
                normal = np.zeros((hit.size, 3))
                normal[:, axis] = -np.sign(place[hit])
                self.position[hit, axis] = -normal[:, axis] * (inner - reach[hit])
                self._stop(hit, normal)

    def _stop_at_symbols(self, start: np.ndarray) -> None:
        """Put agents that have run into the block back before the side that they came from.

        That side's axis separated them at the `start` of the tick; the block is thinner than twice a
        tick's way, so the axis of least depth may be another one.
        """
        # 2.8 and 1.3 m: the block's half sizes and half the agent's diagonal (0.71 m), rounded up.
        way = np.abs(self.position - self.symbol)
        near = np.flatnonzero((way[:, 0] < 2.8) & (way[:, 2] < 1.3))
        if not near.size:
            return

        symbol, yaw = self.symbol[near], self.yaw[near]
        gaps, normals = axis_gaps(self.position[near] - symbol, yaw, AGENT_HALF, SYMBOL_HALF)
        hit = np.flatnonzero((gaps < 0).all(axis=0))
        if hit.size:
            before, _ = axis_gaps(start[near] - symbol, yaw, AGENT_HALF, SYMBOL_HALF)
            axis = before[:, hit].argmax(axis=0)
            normal = normals[axis, hit]
            self.position[near[hit]] -= gaps[axis, hit][:, None] * normal
            self._stop(near[hit], normal)

    def _stop(self, slots: np.ndarray, normal: np.ndarray) -> None:
        velocity = self.velocity[slots]
        stop(velocity, normal, np.zeros(len(slots)))
        self.velocity[slots] = velocity

    def _touch_goals(self) -> None:
        # Plates begin at z 20.29; half the agent's diagonal is 0.71 m.
        near = np.flatnonzero(self.position[:, 2] > 19.5)
        if not near.size:
            return

        # Only the goal of the agent's side can be in reach.
        side = np.where(self.position[near, 0] < 0, -1.0, 1.0)

        touched = np.zeros(near.size, bool)
        for (y, z), half in ((PLATE_CENTRE, PLATE_HALF), (PANEL_CENTRE, PANEL_HALF)):
            centre = np.stack([GOAL_X * side, np.full(near.size, y), np.full(near.size, z)], axis=1)
            gap, _ = box_gap(self.position[near] - centre, self.yaw[near], AGENT_HALF, half)
            touched |= gap < CONTACT_GAP

        if touched.any():
            slots = near[touched]
            touched_o = side[touched] == self.o_side[slots]
            self.set_reward(slots, np.where(touched_o != self.shows_x[slots], 1.0, -0.1))
            self.end_episode(slots)
