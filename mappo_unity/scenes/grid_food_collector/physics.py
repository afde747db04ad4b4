"""Physics of the food arena: upright boxes (agents) and rolling balls (food) on a floor within four walls.

Plain numpy, all areas at once; why no rigid-body engine: fifty free balls an area cost MuJoCo three to five
times as much, and the doubled friction of boxes needs explicit rules anyway (`ground.py`).

A tick follows Unity's engine: free motion; contacts of the poses at the start (gaps below 0.02 m count);
inelastic impulses, friction after them (`solver.py`); motion; penetrations shrink without leaving a velocity
behind. Legend: N areas, A agents, F balls of an area, B = N * (A + F) bodies, C contacts. Vectors
are component first, Unity's axes (x right, y up, z forward), metres from the middle of the area's floor.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import (
    BOX_FRICTION,
    CONTACT_GAP,
    POINT_FRICTION,
    TICK_S,
    box_gap,
    push_out,
)
from mappo_unity.scenes.grid_food_collector.solver import NONE, Contacts, Solver, joined

GRAVITY = 9.81  # m/s^2
WALL = 50.0  # m: inner faces
AGENT_MASS, AGENT_HALF = 10.0, 0.5  # kg; m, at scale 1
AGENT_KEPT = 1.0 - 0.5 * TICK_S  # drag 0.5/s
BALL_MASS, BALL_RADIUS = 5.0, 0.75  # kg, m; no drag
SPIN_KEPT = 1.0 - 0.05 * TICK_S  # angular drag 0.05/s
MAX_SPIN = 7.0  # rad/s: the engine's limit for bodies that set none
BALL_INERTIA = 0.4 * BALL_MASS * BALL_RADIUS**2  # solid sphere


class FoodPhysics:
    """Hold and step the bodies of all areas.

    Attributes, float64, to be read and written in place: `agent_position`, `agent_velocity` [3, N, A];
    `ball_position`, `ball_velocity`, `ball_spin` [3, N, F] (m, m/s, rad/s); `agent_half` [N, A], half an
    agent's edge, m; `agent_yaw` [N, A], rad, clockwise seen from above.
    """

    def __init__(self, num_areas: int, num_agents: int, num_balls: int) -> None:
        self._shape = (num_areas, num_agents + num_balls)
        self._num_agents, self._num_balls = num_agents, num_balls
        self._num_bodies = num_areas * (num_agents + num_balls)
        self._position, self._velocity, self._spin = np.zeros((3, 3, self._num_bodies + 1))  # last: walls

        agent = np.tile(np.arange(num_agents + num_balls) < num_agents, num_areas)
        self._solver = Solver(
            np.append(np.where(agent, 1 / AGENT_MASS, 1 / BALL_MASS), 0.0),
            np.append(np.where(agent, 0.0, 1 / BALL_INERTIA), 0.0),
            BALL_RADIUS,
        )

        self._reach = np.full(self._shape, BALL_RADIUS)  # from the centre down to the lowest point
        # A view: half an agent's edge is also how far down it reaches.
        self.agent_half = self._reach[:, :num_agents]
        self.agent_half[...] = AGENT_HALF
        self.agent_yaw = np.zeros((num_areas, num_agents))
        self.agent_position, self.ball_position = self._views(self._position)
        self.agent_velocity, self.ball_velocity = self._views(self._velocity)
        _, self.ball_spin = self._views(self._spin)

        self._agent_pairs = np.triu_indices(num_agents, 1)
        self._compare_in_circle()

    def step(self, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by one tick; `drive` [3, N, A]: velocity changes of the agents, m/s.

        Returns area, agent and ball (int [K] each) of all touches between agents and balls.
        """
        self._move_freely(drive)

        touches = self._agent_ball_contacts()
        contacts = joined([touches, self._ball_contacts(), self._agent_contacts(), self._wall_contacts()])

        # The floor is no contact of the list: it bounds the vertical velocity of all bodies.
        floor_gap = self._position[1, :-1] - self._reach.reshape(-1)
        near_floor = floor_gap < CONTACT_GAP
        slowest = np.where(near_floor, np.maximum(floor_gap, 0.0) / -TICK_S, -np.inf)
        lift = self._solver.solve(contacts, self._velocity, self._spin, slowest)
        self._rub_floor(lift.reshape(self._shape))

        # What is pushed apart after the motion keeps no velocity from it.
        self._position += self._velocity * TICK_S
        self._solver.separate(contacts, self._position)
        self._position[1, :-1] += push_out(floor_gap)

        # In a touch the one is the ball, the other the agent.
        area, agent = np.divmod(touches.other, self._shape[1])
        return area, agent, touches.one % self._shape[1] - self._num_agents

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all poses, velocities and sizes."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    # ---- free motion ------------------------------------------------------------------------------------

    def _move_freely(self, drive: np.ndarray) -> None:
        self._velocity[1, :-1] -= GRAVITY * TICK_S
        self.agent_velocity += drive
        self.agent_velocity *= AGENT_KEPT

        spin = self.ball_spin
        spin *= SPIN_KEPT
        squared = spin[0] ** 2 + spin[1] ** 2 + spin[2] ** 2
        if squared.max() > MAX_SPIN**2:
            spin *= MAX_SPIN / np.sqrt(np.maximum(squared, MAX_SPIN**2))

    # ---- contacts ---------------------------------------------------------------------------------------

    def _agent_ball_contacts(self) -> Contacts:
        """Find balls at agents: the box's nearest point to the centre of the ball."""
        x, y, z = (
            self.ball_position[axis][:, None, :] - self.agent_position[axis][:, :, None] for axis in range(3)
        )

        # A coarse look from above: at any yaw a box lies within the circle through its corners.
        near = x * x + z * z < (BALL_RADIUS + CONTACT_GAP + np.sqrt(2) * self.agent_half[:, :, None]) ** 2
        area, agent, ball = np.nonzero(near)
        if not area.size:
            return NONE

        x, y, z = x[near], y[near], z[near]
        yaw, half = self.agent_yaw[area, agent], self.agent_half[area, agent]
        sin, cos = np.sin(yaw), np.cos(yaw)
        local = np.stack([x * cos - z * sin, y, x * sin + z * cos])
        offset = local - np.clip(local, -half, half)
        distance = np.sqrt((offset * offset).sum(axis=0))

        touch = distance < BALL_RADIUS + CONTACT_GAP
        offset, distance, sin, cos = offset[:, touch], distance[touch], sin[touch], cos[touch]
        # The normal is turned back into the area's axes.
        right, up, ahead = offset / np.maximum(distance, 1e-9)
        normal = np.stack([right * cos + ahead * sin, up, ahead * cos - right * sin])

        first = area[touch] * self._shape[1]
        return Contacts(
            first + self._num_agents + ball[touch],
            first + agent[touch],
            normal,
            distance - BALL_RADIUS,
            np.full(distance.size, POINT_FRICTION),
        )

    def _ball_contacts(self) -> Contacts:
        """Find balls at balls."""
        num, circle = self._num_balls, self._circle
        circle[:, :, :num] = self.ball_position[::2]
        # The first half again: so each ball has the balls that follow it in one window.
        circle[:, :, num:] = circle[:, :, : num // 2]

        # A coarse look from above, in single precision: few of all the pairs are near.
        square = self._ahead_in_circle - circle[:, :, None, :num]
        square *= square
        square[0] += square[1]
        near = np.flatnonzero(square[0] < _NEAR_BALLS)
        if not near.size:
            return NONE

        area, pair = np.divmod(near, len(self._ball_pairs))
        first = area * self._shape[1] + self._num_agents
        one, other = first + self._ball_pairs[pair].T

        offset = self._position[:, one] - self._position[:, other]
        distance = np.sqrt((offset * offset).sum(axis=0))
        touch = (distance < 2 * BALL_RADIUS + CONTACT_GAP) & self._pair_counts[pair]
        distance = distance[touch]

        return Contacts(
            one[touch],
            other[touch],
            offset[:, touch] / np.maximum(distance, 1e-9),
            distance - 2 * BALL_RADIUS,
            np.full(distance.size, POINT_FRICTION),
        )

    def _agent_contacts(self) -> Contacts:
        """Find agents at agents: upright boxes, along the axis of the largest gap."""
        first, second = self._agent_pairs
        offset = self.agent_position[:, :, first] - self.agent_position[:, :, second]
        sizes = self.agent_half[:, first] + self.agent_half[:, second]
        reach = np.sqrt(2) * sizes + CONTACT_GAP
        # A coarse look from above: boxes lie within the circles through their corners.
        area, pair = np.nonzero(offset[0] ** 2 + offset[2] ** 2 < reach**2)
        if not area.size:
            return NONE

        first, second = first[pair], second[pair]
        half, yaw = self.agent_half, self.agent_yaw
        gap, normal = box_gap(
            offset[:, area, pair].T,
            yaw[area, first],
            np.repeat(half[area, first, None], 3, axis=1),
            np.repeat(half[area, second, None], 3, axis=1),
            yaw[area, second],
        )

        touch = gap < CONTACT_GAP
        start = area[touch] * self._shape[1]
        return Contacts(
            start + first[touch],
            start + second[touch],
            normal[touch].T,
            gap[touch],
            np.full(start.size, BOX_FRICTION),
        )

    def _wall_contacts(self) -> Contacts:
        """Find bodies at the walls, along x and along z."""
        reach = self._reach.copy()
        # Along x and z a turned square reaches further.
        sin, cos = np.sin(self.agent_yaw), np.cos(self.agent_yaw)
        reach[:, : self._num_agents] *= np.abs(sin) + np.abs(cos)

        place = self._position[::2, :-1]
        gap = WALL - np.abs(place) - reach.reshape(-1)
        axis, one = np.nonzero(gap < CONTACT_GAP)

        normal = np.zeros((3, one.size))
        normal[2 * axis, np.arange(one.size)] = -np.sign(place[axis, one])

        boxes = one % self._shape[1] < self._num_agents
        friction = np.where(boxes, BOX_FRICTION, POINT_FRICTION)
        return Contacts(one, np.full(one.size, self._num_bodies), normal, gap[axis, one], friction)

    # ---- the floor --------------------------------------------------------------------------------------

    def _rub_floor(self, lift: np.ndarray) -> None:
        """Brake bodies on the floor; `lift` [N, A + F]: vertical impulse by mass, m/s.

        Boxes lose up to 1.2 * lift of their speed. At balls the slip v + w x (-R e_y) is removed with two
        sevenths of it (solid sphere), by at most 0.6 * lift.
        """
        agents, balls = lift[:, : self._num_agents], lift[:, self._num_agents :]
        speed = np.hypot(self.agent_velocity[0], self.agent_velocity[2])
        kept = np.maximum(speed - BOX_FRICTION * agents, 0.0) / np.maximum(speed, 1e-9)
        self.agent_velocity[0] *= kept
        self.agent_velocity[2] *= kept

        velocity, spin = self.ball_velocity, self.ball_spin
        slip_x = velocity[0] + spin[2] * BALL_RADIUS
        slip_z = velocity[2] - spin[0] * BALL_RADIUS
        slip = np.sqrt(slip_x * slip_x + slip_z * slip_z)
        part = -np.minimum(2 / 7, POINT_FRICTION * balls / np.maximum(slip, 1e-9))
        slip_x *= part
        slip_z *= part
        velocity[0] += slip_x
        velocity[2] += slip_z
        # 2.5 / R is m R / I of a solid sphere: the spin that the friction's impulse leaves.
        spin[2] += slip_x * (2.5 / BALL_RADIUS)
        spin[0] -= slip_z * (2.5 / BALL_RADIUS)

    def _compare_in_circle(self) -> None:
        """Lay out the comparison of each ball with the next half of its area's balls, in a circle."""
        num, half = self._num_balls, self._num_balls // 2
        self._circle = np.zeros((2, self._shape[0], num + half), np.float32)  # x, z; the first half again
        windows = np.lib.stride_tricks.sliding_window_view(self._circle[:, :, 1:], num, axis=2)
        self._ahead_in_circle = windows  # [2, N, steps ahead - 1, ball]: a view of `_circle`

        steps, ball = np.divmod(np.arange(half * num), num)
        self._ball_pairs = np.stack([ball, (ball + steps + 1) % num], axis=1)
        self._pair_counts = (steps + 1 < num - half) | (ball < half)  # of an even number half meets twice

    def _views(self, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the agents' and the balls' part of an array [3, B + 1], as views."""
        by_area = bodies[:, :-1].reshape(3, *self._shape)
        assert np.shares_memory(by_area, bodies)
        return by_area[:, :, : self._num_agents], by_area[:, :, self._num_agents :]


_STATE = ("_position", "_velocity", "_spin", "_reach", "agent_yaw")
_NEAR_BALLS = np.float32(1.001 * (2 * BALL_RADIUS + CONTACT_GAP) ** 2)  # m^2, in single precision
