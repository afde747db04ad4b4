"""Contacts of soccer's discs: bounces, friction and push-out, for all fields at once.

The method is Unity's engine's (PhysX): projected Gauss-Seidel over the contacts of a field, six iterations;
contacts that share no body need only one, together.
Legend: n contacts, M bodies, of which the first F are the balls and the last one (the pitch) never moves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

FRICTION = np.array(0.6)  # of every pair: nothing has another friction than the default
RESTITUTION = 0.8  # of the ball with anything; agents have none
BOUNCE_SPEED = np.array(2.0)  # m/s: slower approaches do not bounce
ITERATIONS = 6
_SETTLED = 1e-9  # kg m/s: an iteration that changes less ends the solve
# as arrays: NumPy takes those twice as fast as Python's numbers
_ZERO, _ONE, _SINGLE = np.array(0.0), np.array(1.0), np.array(1)


class Contacts(NamedTuple):
    """Contacts of one body with another, n of them; a ball is always the first, the pitch the second."""

    bodies: np.ndarray
    """Numbers of both, int64 [2, n]."""
    normal: np.ndarray
    """Unit normal from the second to the first, x and z, [2, n]."""
    gap: np.ndarray
    """Distance of the surfaces, m, [n]; negative: penetration."""


class Bodies:
    """Hold the bodies' velocities, and solve contacts between them.

    `velocity` float64 [2, M] x, z; `spin` float64 [M] about y, rad/s, clockwise seen from above.
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

        # the velocities one after another, and at the same places the inverse masses that weigh impulses
        self.flat_velocity = self.velocity.reshape(-1)
        self.flat_weight = np.tile(self.constants[0], 2)
        self.num = np.array(num)

    def solve(self, contacts: Contacts, tick_s: float) -> Solved:
        """Stop or bounce approaching pairs and rub them."""
        solved = Solved(self, contacts, tick_s)
        solved.repeat(_Rows.stop)
        return solved


class Solved:
    """The contacts of one solve, parted into rows that can be solved at once."""

    def __init__(self, bodies: Bodies, contacts: Contacts, tick_s: float) -> None:
        self._all = _Rows(bodies, contacts, tick_s)
        shared = _shared(contacts, len(bodies.spin) - 1)
        self._alone, self._ranks = self._all, []

        if shared is not None:
            self._alone = self._all.part(np.flatnonzero(~shared))
            self._ranks = [self._all.part(rank) for rank in _ranks(contacts, shared, bodies.num_balls)]

    def repeat(self, iterate: Callable[[_Rows], np.ndarray]) -> None:
        """Iterate once over contacts that share no body, up to six times over the others."""
        if self._alone.mass.size:
            iterate(self._alone)

        for _ in range(ITERATIONS if self._ranks else 0):
            if max([np.abs(iterate(rank)).max() for rank in self._ranks]) < _SETTLED:
                break

    def push_out(self, moves: np.ndarray, share: float, most: float) -> None:
        """Add to `moves`, the bodies' ways in this tick [2, M] m, so that penetrations shrink.

        A tick removes `share` of a penetration, at most `most` m; pairs apart do not get into each other.
        Contacts that bounce are left alone. Ways, not speeds: nothing of it is kept.
        """
        flat = moves.reshape(-1)
        self._all.aim(share, most)
        _, short = self._all.missing(flat)

        if not np.count_nonzero(short > _ZERO):
            return

        for part in (self._alone, *self._ranks) if self._ranks else ():  # those are copies
            part.aim(share, most)

        self.repeat(lambda part: part.push(flat))


def _shared(contacts: Contacts, pitch: int) -> np.ndarray | None:
    """Return which contacts have a body in common with another one, the pitch excepted; None: none has."""
    count = np.bincount(contacts.bodies.reshape(-1), minlength=pitch + 1)

    # the pitch does not move: sharing it couples nothing
    count[pitch] = 0
    many = count > _SINGLE
    if not np.count_nonzero(many):
        return None

    first, second = many[contacts.bodies]
    return first | second


def _ranks(contacts: Contacts, shared: np.ndarray, num_fields: int) -> list[np.ndarray]:
    """Return rows of the shared contacts: the first of every field, the second of every field, ..."""
    rows = np.flatnonzero(shared)
    field = contacts.bodies[0, rows] % num_fields

    # stable: within a field the contacts keep their order
    order = np.argsort(field, kind="stable")
    rows, field = rows[order], field[order]

    rank = np.arange(len(rows)) - np.searchsorted(field, field)
    return [rows[rank == k] for k in range(int(rank.max()) + 1)]


class _Rows:
    """Some contacts: what an iteration needs, and the impulses so far, `press` and `rub`, kg m/s [n].

    Pairs come as [2 bodies, 2 axes, n], so that each body's part is contiguous: for a few contacts the
    time goes into NumPy's calls, and contiguous operands cost it least.
    """

    def __init__(self, bodies: Bodies, contacts: Contacts, tick_s: float) -> None:
        self.velocity, self.spin = bodies.flat_velocity, bodies.spin
        pair, self.normal, self.gap = contacts
        self.first = pair[0]

        self.tangent = np.empty_like(self.normal)
        np.negative(self.normal[1], out=self.tangent[0])
        self.tangent[1] = self.normal[0]

        self.places = np.empty((2, *pair.shape), np.int64)  # of the velocities [2, 2, n]
        self.places[:, 0] = pair
        np.add(pair, bodies.num, out=self.places[:, 1])

        self.weight = bodies.flat_weight.take(self.places)
        _, rub_weight, self.lever, self.spin_gain = bodies.constants.take(self.first, 1)
        weight_i, weight_j = self.weight[:, 0]

        self.mass = _ONE / (weight_i + weight_j)
        self.rub_mass = _ONE / (rub_weight + weight_j)

        # bounces go by the speed at which the pair meets, before any impulse
        leaving = _along(self.normal, _difference(self.velocity[self.places]))
        self.bounces = (leaving < -BOUNCE_SPEED) & (self.first < bodies.num_balls)

        self.leave_speed = np.maximum(self.gap, _ZERO) * (-1 / tick_s)
        if np.count_nonzero(self.bounces):
            np.copyto(self.leave_speed, -RESTITUTION * leaving, where=self.bounces)

        self.press = self.rub = self.pushed = np.zeros(len(self.gap))

    def part(self, rows: np.ndarray) -> _Rows:
        """Return these rows alone."""
        part = object.__new__(_Rows)
        for name, value in vars(self).items():
            setattr(part, name, value if name in ("velocity", "spin") else value.take(rows, -1))

        return part

    def stop(self) -> np.ndarray:
        """Apply one iteration to speeds, if no two contacts share a body; return changes of `press`."""
        pair = self.velocity[self.places]
        speed = _difference(pair)
        away, slip = speed * self.normal, _along(self.tangent, speed)

        pressed = np.maximum(self.press + (self.leave_speed - away[0] - away[1]) * self.mass, _ZERO)

        # Coulomb friction: what rubs is limited by what presses
        spin = self.spin[self.first]
        limit = FRICTION * pressed
        rubbed = self.rub - (slip + spin * self.lever) * self.rub_mass
        np.minimum(np.maximum(rubbed, -limit, out=rubbed), limit, out=rubbed)

        press, rub = pressed - self.press, rubbed - self.rub
        self.press, self.rub = pressed, rubbed

        self._apply(self.velocity, pair, press * self.normal + rub * self.tangent)
        self.spin[self.first] = spin + rub * self.spin_gain

        return press

    def aim(self, share: float, most: float) -> None:
        """Set how much further apart the pairs shall be, m [n]; pairs that bounce are let be."""
        deep = np.minimum(self.gap, _ZERO)
        self.wanted = np.minimum(-share * deep, most) + deep - self.gap
        self.wanted[self.bounces] = -np.inf

    def missing(self, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return both bodies' ways [2, 2, n], of all ways [2 M], and what they lack of `aim`, m [n]."""
        pair = moves[self.places]
        way = _difference(pair) * self.normal
        return pair, self.wanted - way[0] - way[1]

    def push(self, moves: np.ndarray) -> np.ndarray:
        """Apply one iteration to ways, as `stop` does to speeds; return changes of `pushed`."""
        pair, short = self.missing(moves)
        push = np.maximum(self.pushed + short * self.mass, _ZERO) - self.pushed
        self.pushed = self.pushed + push
        self._apply(moves, pair, push * self.normal)
        return push

    def _apply(self, to: np.ndarray, pair: np.ndarray, impulse: np.ndarray) -> None:
        """Set what `pair` becomes by an impulse [2, n] on its first bodies and off its second."""
        pair[0] += impulse * self.weight[0]
        pair[1] -= impulse * self.weight[1]
        to[self.places] = pair


def _difference(pair: np.ndarray) -> np.ndarray:
    return pair[0] - pair[1]


def _along(direction: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return scalar products of [2, n] with [2, n]."""
    parts = direction * vector
    return parts[0] + parts[1]
