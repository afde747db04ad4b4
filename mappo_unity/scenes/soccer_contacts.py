"""Contacts of soccer's discs: bounces, friction and push-out, for all fields at once.

In: contacts of pairs of bodies. Out: the bodies' new velocities. Knows no pitch and no rules.
The method is Unity's engine's (PhysX): projected Gauss-Seidel over the contacts of a field, six iterations;
contacts that share no body need only one, together.
Legend: n contacts, M bodies, of which the first F are the balls and the last one (the pitch) never moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

FRICTION = 0.6  # of every pair: nothing has another friction than the default
RESTITUTION = 0.8  # of the ball with anything; agents have none
BOUNCE_SPEED = 2.0  # m/s: slower approaches do not bounce
ITERATIONS = 6
_SETTLED = 1e-9  # kg m/s: an iteration that changes less ends the solve


class Contacts(NamedTuple):
    """Contacts of body `i` with body `j`; a ball is always `i`, the pitch always `j`. All arrays [n]."""

    i: np.ndarray
    j: np.ndarray
    normal_x: np.ndarray
    """Unit normal from `j` to `i`."""
    normal_z: np.ndarray
    gap: np.ndarray
    """Distance of the surfaces, m; negative: penetration."""


class Bodies:
    """Hold the bodies' velocities, and solve contacts between them.

    `velocity` float64 [2, M] x, z; `spin` float64 [M] about y, rad/s, clockwise seen from above;
    `inverse_mass` float64 [M], 1/kg.
    """

    def __init__(self, num_balls: int, num_agents: int, ball: tuple[float, float], agent_mass: float) -> None:
        """`ball`: mass in kg and radius in m."""
        num = num_balls + num_agents + 1
        mass, radius = ball
        self.num_balls = num_balls
        self.velocity = np.zeros((2, num))
        self.spin = np.zeros(num)
        # inverse mass; that of rubbing, which also turns a ball, a solid sphere: 1/m + r^2 / (2/5 m r^2);
        # lever from centre to contact; spin gained by rubbing: r / (2/5 m r^2). Agents do not turn.
        self.constants = np.zeros((4, num))
        self.constants[:2] = 1 / agent_mass
        self.constants[:, :num_balls] = np.array([1 / mass, 3.5 / mass, radius, 2.5 / (mass * radius)])[
            :, None
        ]
        self.constants[:, -1] = 0
        self.inverse_mass = self.constants[0]

    def solve(self, contacts: Contacts, tick_s: float) -> Solved:
        """Stop or bounce approaching pairs and rub them."""
        solved = Solved(self, contacts, tick_s)
        solved.repeat(_Rows.stop)
        return solved


class Solved:
    """The contacts of one solve, parted into rows that can be solved at once."""

    def __init__(self, bodies: Bodies, contacts: Contacts, tick_s: float) -> None:
        self._all = _Rows(bodies, contacts, tick_s)
        shared = _shared(contacts, len(bodies.spin))
        self._alone, self._ranks = self._all, []
        if shared is not None:
            self._alone = self._all.part(np.flatnonzero(~shared))
            self._ranks = [self._all.part(rank) for rank in _ranks(contacts, shared, bodies.num_balls)]

    def repeat(self, iterate: Callable[[_Rows], np.ndarray]) -> None:
        """Iterate once over contacts that share no body, up to six times over the others."""
        if len(self._alone.i):
            iterate(self._alone)
        for _ in range(ITERATIONS if self._ranks else 0):
            if max([np.abs(iterate(rank)).max() for rank in self._ranks]) < _SETTLED:
                break

    def push_out(self, moves: np.ndarray, share: float, most: float) -> None:
        """Add to `moves`, the bodies' ways in this tick [2, M] m, so that penetrations shrink.

        A tick removes `share` of a penetration, at most `most` m; pairs apart do not get into each other.
        Contacts that bounce are left alone. Ways, not speeds: nothing of it is kept.
        """
        rows = self._all
        short = rows.missing(moves, share, most)
        if (short > 0).any():
            self.repeat(lambda part: part.push(moves, share, most))


def _shared(contacts: Contacts, num_bodies: int) -> np.ndarray | None:
    """Return which contacts have a body in common with another one, the pitch excepted; None: none has."""
    count = np.bincount(np.concatenate([contacts.i, contacts.j]), minlength=num_bodies)
    count[-1] = 0
    many = count > 1
    return many[contacts.i] | many[contacts.j] if many.any() else None


def _ranks(contacts: Contacts, shared: np.ndarray, num_fields: int) -> list[np.ndarray]:
    """Return rows of the shared contacts: the first of every field, the second of every field, ..."""
    rows = np.flatnonzero(shared)
    field = contacts.i[rows] % num_fields
    order = np.argsort(field, kind="stable")
    rows, field = rows[order], field[order]
    rank = np.arange(len(rows)) - np.searchsorted(field, field)
    return [rows[rank == k] for k in range(int(rank.max()) + 1)]


class _Rows:
    """Some contacts: what an iteration needs, and the impulses so far, `press` and `rub`, kg m/s [n]."""

    def __init__(self, bodies: Bodies, contacts: Contacts, tick_s: float) -> None:
        self.velocity, self.spin = bodies.velocity, bodies.spin
        self.i, self.j, self.normal_x, self.normal_z, self.gap = contacts
        x, z = self.velocity[:, self.i] - self.velocity[:, self.j]
        approach = -x * self.normal_x - z * self.normal_z
        self.bounces = (approach > BOUNCE_SPEED) & (self.i < bodies.num_balls)
        allowed = np.maximum(self.gap, 0) * (-1 / tick_s)
        self.leave_speed = np.where(self.bounces, RESTITUTION * approach, allowed)
        self.weight_i, rub_weight, self.lever, self.spin_gain = bodies.constants[:, self.i]
        self.weight_j = bodies.inverse_mass[self.j]
        self.mass = 1 / (self.weight_i + self.weight_j)
        self.rub_mass = 1 / (rub_weight + self.weight_j)
        self.press = self.rub = self.pushed = np.zeros(len(self.gap))

    def part(self, rows: np.ndarray) -> _Rows:
        """Return these rows alone."""
        part = object.__new__(_Rows)
        for name, value in vars(self).items():
            setattr(part, name, value if name in ("velocity", "spin") else value[rows])
        return part

    def stop(self) -> np.ndarray:
        """Apply one iteration to speeds, if no two contacts share a body; return changes of `press`."""
        velocity, spin, i, j = self.velocity, self.spin, self.i, self.j
        normal_x, normal_z = self.normal_x, self.normal_z
        x, z = velocity[:, i] - velocity[:, j]
        pressed = np.maximum(self.press + (self.leave_speed - x * normal_x - z * normal_z) * self.mass, 0)
        slip = z * normal_x - x * normal_z + spin[i] * self.lever  # along (-normal_z, normal_x)
        limit = FRICTION * pressed
        rubbed = np.minimum(np.maximum(self.rub - slip * self.rub_mass, -limit), limit)
        press, rub = pressed - self.press, rubbed - self.rub
        self.press, self.rub = pressed, rubbed
        self._apply(velocity, press * normal_x - rub * normal_z, press * normal_z + rub * normal_x)
        spin[i] += rub * self.spin_gain
        return press

    def missing(self, moves: np.ndarray, share: float, most: float) -> np.ndarray:
        """Return how much further apart the pairs must move, m [n]."""
        x, z = moves[:, self.i] - moves[:, self.j]
        deep = np.minimum(self.gap, 0)
        wanted = np.minimum(-share * deep, most) + deep - self.gap - x * self.normal_x - z * self.normal_z
        return np.where(self.bounces, -1.0, wanted)

    def push(self, moves: np.ndarray, share: float, most: float) -> np.ndarray:
        """Apply one iteration to ways, as `stop` does to speeds; return changes of `pushed`."""
        pushed = np.maximum(self.pushed + self.missing(moves, share, most) * self.mass, 0)
        push = np.where(self.bounces, 0, pushed - self.pushed)
        self.pushed = self.pushed + push
        self._apply(moves, push * self.normal_x, push * self.normal_z)
        return push

    def _apply(self, to: np.ndarray, x: np.ndarray, z: np.ndarray) -> None:
        to[0, self.i] += x * self.weight_i
        to[1, self.i] += z * self.weight_i
        to[0, self.j] -= x * self.weight_j
        to[1, self.j] -= z * self.weight_j
