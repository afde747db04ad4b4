"""The bodies of soccer fields as discs on a plane: one tick of all fields at once.

Facts and reasons: docs/scenes/SoccerTwos.md. A tick, as in Unity's engine: forces and drag; contacts that
exist at the start (gap < 0.02 m) are solved; bodies move, stopped by the pitch (continuous detection; pairs
of bodies are not swept); then the callbacks: kicks, goals.
Legend: F fields, A agents of a field, B = 1 + A bodies (the ball first), n contacts. Body b of field f has
the number b * F + f; the number B * F stands for the pitch.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from mappo_unity.scenes.soccer.contacts import Bodies, Contacts, Solved
from mappo_unity.scenes.soccer.pitch import (
    BALL_HEIGHT,
    GOAL_FLOOR_X,
    MARGIN,
    NUM_FEATURES,
    POST_X,
    Faced,
    Gaps,
    Pitch,
)

TICK_S = 0.02
AGENT_RADIUS, AGENT_MASS = 0.5, 50.0  # m, kg
BALL_RADIUS, BALL_MASS = 41.61146 * 0.015, 3.0
AGENT_KEPT = 1 - 3.0 * TICK_S  # drag 3/s
BALL_KEPT = 1 - 1.0 * TICK_S  # drag and angular drag 1/s
MAX_SPIN = 7.0  # rad/s: the engine's limit for bodies that set none
KICK_SPEED = 2000 * TICK_S / BALL_MASS  # m/s: a force of 2000 N for one tick
PUSH_OUT, MAX_PUSH_OUT = 0.8, 10.0 * TICK_S  # share of a penetration removed in a tick; at most 10 m/s
GOAL_LINE_X = GOAL_FLOOR_X - (BALL_RADIUS**2 - BALL_HEIGHT**2) ** 0.5  # of a ball that meets the goal's floor
GOAL_NEAR_X = min(POST_X) - BALL_RADIUS - MARGIN  # a ball nearer to the middle touches no part of a goal
SLIP_SHARE = 2 / 7  # of the ball's way at most lost to its rub on the floor: solid sphere, slip to roll
SLIP_WAY = 0.35 * PUSH_OUT * (BALL_RADIUS - BALL_HEIGHT)  # m in a tick: friction times push-out
# as arrays: NumPy takes those twice as fast as Python's numbers
_ZERO, _ONE, _TINY, _TICK = np.array(0.0), np.array(1.0), np.array(1e-12), np.array(TICK_S)
_BALL_KEPT, _MAX_SPIN, _MIN_SPIN = np.array(BALL_KEPT), np.array(MAX_SPIN), np.array(-MAX_SPIN)
_SLIP_SHARE, _SLIP_WAY = np.array(SLIP_SHARE), np.array(SLIP_WAY)


class SoccerPhysics:
    """Move the bodies of F fields.

    `position`, `velocity` float64 [2, B, F]: x and z; `spin` float64 [F]: the balls', about y, rad/s,
    clockwise seen from above; `kick` float64 [2, F]: the balls' velocity change that waits for the next
    tick; `touching` bool [A, F]: agents in contact with their ball.
    """

    def __init__(self, num_fields: int, num_agents: int, blue_closed: bool = False) -> None:
        bodies = (1 + num_agents, num_fields)
        self.pitch = Pitch(blue_closed)
        self.num_fields, self.num_agents = num_fields, num_agents

        self._bodies = Bodies(num_fields, num_agents * num_fields, (BALL_MASS, BALL_RADIUS), AGENT_MASS)
        self._last = bodies[0] * num_fields  # the pitch's number

        self.position = np.zeros((2, *bodies))
        self.velocity = self._bodies.velocity[:, : self._last].reshape(2, *bodies)
        self.spin = self._bodies.spin[:num_fields]

        # velocity changes of a tick by the bodies' numbers; kicks and drives are their parts
        self._change = np.zeros((2, self._last + 1))
        self.kick = self._change[:, :num_fields]
        self._drive = self._change[:, num_fields : self._last].reshape(2, num_agents, num_fields)

        self._kept = np.full((2, self._last + 1), AGENT_KEPT)
        self._kept[:, :num_fields] = BALL_KEPT
        self.touching = np.zeros((num_agents, num_fields), bool)

        radius = np.where(np.arange(bodies[0]) == 0, BALL_RADIUS, AGENT_RADIUS)
        self._radius = np.repeat(radius, num_fields)
        self._radii = np.tile(self._radius, (NUM_FEATURES, 1))
        self._no_goals = np.zeros(num_fields, np.int64)

        self._gaps: Gaps | None = None  # of `position`; None: bodies were placed or stopped since

        self._first, self._second = np.array(list(combinations(range(bodies[0]), 2))).T
        reach = radius[self._first] + radius[self._second] + MARGIN
        self._reach_squared = np.repeat((reach**2)[:, None], num_fields, axis=1)

    def place(self, body: int, fields: np.ndarray, x: np.ndarray | float, z: np.ndarray | float) -> None:
        """Put a body of `fields` [n] at rest at x, z [n]; a kick that waits for its tick still comes."""
        self.position[0, body, fields] = x
        self.position[1, body, fields] = z
        self.velocity[:, body, fields] = 0

        self._gaps = None
        if body == 0:
            self.spin[fields] = 0

    def step(self, drive: np.ndarray, kick_power: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance one tick.

        `drive` float64 [2, A, F]: velocity changes of the agents, m/s; `kick_power` float64 [A, F], 0 to 1.
        Returns who began contact with the ball, bool [A, F], and how many parts of the blue and of the
        purple goal each ball began contact with, int64 [F] each.
        """
        self._accelerate(drive)
        contacts, begun = self._contacts()
        points = self._kick_points(begun) if np.count_nonzero(begun) else None
        solved = None if contacts is None else self._bodies.solve(contacts, TICK_S)

        start = self.position
        self.position = start + self._moves(solved)
        self._stop_at_pitch(start)

        # kicks come last: from where the agents are after the tick towards the contact before it
        if points is not None:
            self._kick(begun, points, kick_power)

        return begun, *self._goals(start)

    def get_state(self) -> dict[str, Any]:
        """Return copies of everything that the next tick depends on."""
        return {name: getattr(self, name).copy() for name in _STATE}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        for name in _STATE:
            getattr(self, name)[...] = state[name]
        self._gaps = None

    def _accelerate(self, drive: np.ndarray) -> None:
        bodies = self._bodies
        self._drive[...] = drive

        bodies.velocity += self._change
        bodies.velocity *= self._kept

        # a kick acts in one tick only
        self.kick[...] = _ZERO

        spin = self.spin
        spin *= _BALL_KEPT
        np.minimum(spin, _MAX_SPIN, out=spin)
        np.maximum(spin, _MIN_SPIN, out=spin)

    def _contacts(self) -> tuple[Contacts | None, np.ndarray]:
        """Return all contacts of this tick, and who begins one with the ball, bool [A, F]."""
        position = self.position
        away = position.take(self._first, 1) - position.take(self._second, 1)  # [2, pairs, F]
        squares = away * away
        squared = squares[0] + squares[1]
        close = squared < self._reach_squared

        # the first pairs are those of the ball with each agent
        touching = close[: self.num_agents]
        begun = touching > self.touching
        self.touching = touching

        parts = []
        if np.count_nonzero(close):
            parts.append(self._pairs(close, away, squared))

        at = self._flat(position)
        # mostly known from the end of the last tick
        if self._gaps is None:
            self._gaps = self.pitch.gaps(at, self._radii)

        faced = self.pitch.contacts(at, self._gaps)
        if faced.disc.size:
            parts.append(self._with_pitch(faced))

        if len(parts) == 2:
            return Contacts(*(np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))), begun
        return (parts[0] if parts else None), begun

    def _pairs(self, close: np.ndarray, away: np.ndarray, squared: np.ndarray) -> Contacts:
        """Return contacts of bodies with each other: the pairs and fields that are `close`."""
        pair, field = close.nonzero()

        distance = np.sqrt(squared[pair, field]) + 1e-12
        bodies = np.stack([self._first[pair], self._second[pair]]) * self.num_fields + field

        first, second = self._radius[bodies]
        return Contacts(bodies, away[:, pair, field] / distance, distance - first - second)

    def _with_pitch(self, faced: Faced) -> Contacts:
        bodies = np.empty((2, len(faced.disc)), np.int64)
        bodies[0], bodies[1] = faced.disc, self._last
        return Contacts(bodies, faced.normal, faced.gap)

    def _moves(self, solved: Solved | None) -> np.ndarray:
        """Return the ways of a tick [2, B, F]: velocity, less the balls' slip, plus push-out.

        The floor takes way but no speed from the ball, and a push-out gives way but no speed: both act in
        the engine's position iterations only.
        """
        moves = self._bodies.velocity * _TICK

        ball = moves[:, : self.num_fields]
        squares = ball * ball
        way = np.sqrt(squares[0] + squares[1]) + _TINY
        ball *= _ONE - np.minimum(_SLIP_SHARE, _SLIP_WAY / way)

        if solved is not None:
            solved.push_out(moves, PUSH_OUT, MAX_PUSH_OUT)

        return moves[:, : self._last].reshape(self.position.shape)

    def _stop_at_pitch(self, start: np.ndarray) -> None:
        """Stop bodies where the pitch is in their way, and bounce them there.

        A body that was in contact at the start slides on instead of losing the rest of its way.
        """
        begin, end = self._flat(start), self._flat(self.position)
        before, self._gaps = self._gaps, self.pitch.gaps(end, self._radii)
        assert before is not None

        hits, share = self.pitch.way(begin, end, before, self._gaps, self._radius)
        if not hits.disc.size:
            return

        body, normal, gap = hits
        step = end[:, body] - begin[:, body]
        into = normal * step
        slides = gap - into[0] - into[1] < MARGIN

        end[:, body] += np.where(slides, -gap * normal, (share - 1) * step)

        # bodies stand at the surface now: a contact without a gap, at which they bounce
        self._gaps = None
        self._bodies.solve(self._with_pitch(Faced(body, normal, np.zeros(len(body)))), TICK_S)

    def _kick_points(self, begun: np.ndarray) -> np.ndarray:
        """Return the points of contact [2, k] of agents that began one: midway between the surfaces."""
        agent, field = np.nonzero(begun)

        at = self.position[:, 1 + agent, field]
        away = self.position[:, 0, field] - at
        distance = np.sqrt((away * away).sum(axis=0)) + 1e-12

        return at + away / distance * (0.5 * (distance + AGENT_RADIUS - BALL_RADIUS))

    def _kick(self, begun: np.ndarray, points: np.ndarray, power: np.ndarray) -> None:
        """Kick the balls from where the agents are now towards where contact was at the tick's start."""
        agent, field = np.nonzero(begun)
        away = points - self.position[:, 1 + agent, field]
        away *= KICK_SPEED * power[agent, field] / (np.sqrt((away * away).sum(axis=0)) + 1e-12)

        # two agents may kick a ball in one tick: `add.at` counts both, an indexed sum only one
        for axis in range(2):
            np.add.at(self.kick[axis], field, away[axis])

    def _goals(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Count goal parts that balls touch; a ball is stopped at the line, where the engine stops it."""
        ball = self.position[:, 0]
        if np.abs(ball[0]).max() < GOAL_NEAR_X:
            return self._no_goals, self._no_goals

        over = np.flatnonzero(np.abs(ball[0]) > GOAL_LINE_X)
        if over.size:
            begin = start[:, 0, over]
            to_line = np.copysign(GOAL_LINE_X, ball[0, over]) - begin[0]
            step = ball[:, over] - begin
            ball[:, over] = begin + step * np.clip(to_line / step[0], 0, 1)
            self._gaps = None

        return self.pitch.goals(ball[0], ball[1], BALL_RADIUS)

    def _flat(self, position: np.ndarray) -> np.ndarray:
        return position.reshape(2, -1)


_STATE = ("position", "velocity", "spin", "kick", "touching")
