"""Contacts of soccer's discs: bounces, friction and push-out, for all fields at once.

In: contacts of pairs of bodies. Out: the bodies' new velocities. Knows no pitch and no rules.
The method is Unity's engine's (PhysX): projected Gauss-Seidel over the contacts of a field, six iterations;
contacts that share no body need only one, together.
Legend: n contacts, M bodies, of which the first F are the balls and the last one (the pitch) never moves.
"""

from __future__ import annotations

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

    `velocity` float64 [2, M] x, z; `spin` float64 [M] about y, rad/s, clockwise seen from above.
    """

    def __init__(self, num_balls: int, num_agents: int, ball: tuple[float, float], agent_mass: float) -> None:
        num = num_balls + num_agents + 1
        mass, radius = ball
        self.num_balls = num_balls
        self.velocity = np.zeros((2, num))
        self.spin = np.zeros(num)
        self.inverse_mass = np.full(num, 1 / agent_mass)
        self.inverse_mass[:num_balls] = 1 / mass
        self.inverse_mass[-1] = 0
        # rubbing also turns the ball, a solid sphere: 1/m + r^2 / (2/5 m r^2)
        self._rub_weight = self.inverse_mass.copy()
        self._rub_weight[:num_balls] *= 3.5
        self._lever = np.zeros(num)  # from centre to contact; agents do not turn
        self._lever[:num_balls] = radius
        self._spin_gain = np.zeros(num)
        self._spin_gain[:num_balls] = 2.5 / (mass * radius)

    def solve(self, contacts: Contacts, tick_s: float) -> np.ndarray:
        """Stop or bounce approaching pairs and rub them; return which contacts bounce, bool [n]."""
        i, j, normal_x, normal_z, gap = contacts
        approach = (self.velocity[0, j] - self.velocity[0, i]) * normal_x
        approach += (self.velocity[1, j] - self.velocity[1, i]) * normal_z
        bounces = (approach > BOUNCE_SPEED) & (i < self.num_balls)
        leave_speed = np.where(bounces, RESTITUTION * approach, np.maximum(gap, 0) * (-1 / tick_s))
        shared = self._shared(i, j)
        if not shared.any():
            self._iterate(_Rows(self, contacts, leave_speed, slice(None)))
            return bounces
        alone = np.flatnonzero(~shared)
        if alone.size:
            self._iterate(_Rows(self, contacts, leave_speed, alone))
        ranks = [_Rows(self, contacts, leave_speed, rows) for rows in self._ranks(contacts, shared)]
        for _ in range(ITERATIONS):
            if max([self._iterate(rows) for rows in ranks]) < _SETTLED:
                break
        return bounces

    def _iterate(self, rows: _Rows) -> float:
        """Apply one iteration to contacts without common bodies; return the largest change of an impulse."""
        velocity, spin = self.velocity, self.spin
        i, j, normal_x, normal_z = rows.i, rows.j, rows.normal_x, rows.normal_z
        x = velocity[0, i] - velocity[0, j]
        z = velocity[1, i] - velocity[1, j]
        pressed = np.maximum(rows.press + (rows.leave_speed - x * normal_x - z * normal_z) * rows.mass, 0)
        slip = z * normal_x - x * normal_z + spin[i] * rows.lever  # along (-normal_z, normal_x)
        limit = FRICTION * pressed
        rubbed = np.minimum(np.maximum(rows.rub - slip * rows.rub_mass, -limit), limit)
        press, rub = pressed - rows.press, rubbed - rows.rub
        rows.press, rows.rub = pressed, rubbed
        x = press * normal_x - rub * normal_z
        z = press * normal_z + rub * normal_x
        velocity[0, i] += x * rows.weight_i
        velocity[1, i] += z * rows.weight_i
        velocity[0, j] -= x * rows.weight_j
        velocity[1, j] -= z * rows.weight_j
        spin[i] += rub * rows.spin_gain
        return float(np.abs(press).max())

    def _shared(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Return which contacts have a body in common with another one, the pitch excepted."""
        count = np.bincount(i, minlength=len(self.spin)) + np.bincount(j, minlength=len(self.spin))
        count[-1] = 0
        return (count[i] > 1) | (count[j] > 1)

    def _ranks(self, contacts: Contacts, shared: np.ndarray) -> list[np.ndarray]:
        """Return rows of the shared contacts: the first of every field, the second of every field, ..."""
        rows = np.flatnonzero(shared)
        field = contacts.i[rows] % self.num_balls
        order = np.argsort(field, kind="stable")
        rows, field = rows[order], field[order]
        rank = np.arange(len(rows)) - np.searchsorted(field, field)
        return [rows[rank == k] for k in range(int(rank.max()) + 1)]


class _Rows:
    """Some contacts without common bodies: what an iteration needs, and the impulses so far."""

    def __init__(
        self, bodies: Bodies, contacts: Contacts, leave_speed: np.ndarray, rows: slice | np.ndarray
    ) -> None:
        self.i, self.j = contacts.i[rows], contacts.j[rows]
        self.normal_x, self.normal_z = contacts.normal_x[rows], contacts.normal_z[rows]
        self.leave_speed = leave_speed[rows]
        self.weight_i, self.weight_j = bodies.inverse_mass[self.i], bodies.inverse_mass[self.j]
        self.mass = 1 / (self.weight_i + self.weight_j)
        self.rub_mass = 1 / (bodies._rub_weight[self.i] + self.weight_j)
        self.lever, self.spin_gain = bodies._lever[self.i], bodies._spin_gain[self.i]
        self.press: np.ndarray | float = 0.0
        self.rub: np.ndarray | float = 0.0
