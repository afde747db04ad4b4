"""Impulses at contacts of boxes that do not spin and balls that do: all contacts of all areas at once.

Impulses are inelastic, with friction; penetrations are pushed out. Contacts are solved side by side in
`ROUNDS` rounds; a body's contacts share its mass, so that their impulses cannot add up to too much.
Legend: B bodies, C contacts; vectors are component first. Column B stands for walls: it never moves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import TICK_S, push_out

ROUNDS = 6
NEGLIGIBLE = 1e-6  # kg m/s: an impulse that ends the rounds


class Contacts(NamedTuple):
    """Contacts between bodies, or between a body and a wall."""

    one: np.ndarray
    """int [C]: body."""
    other: np.ndarray
    """int [C]: body, or B for a wall."""
    normal: np.ndarray
    """[3, C]: unit vector from the other to the one."""
    gap: np.ndarray
    """[C], m: negative where they overlap."""
    friction: np.ndarray
    """[C]."""


NONE = Contacts(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((3, 0)), np.zeros(0), np.zeros(0))


class Solver:
    """Apply impulses to bodies of given masses.

    Arguments: `inverse_mass` (1/kg) and `inverse_inertia` (1/(kg m^2), 0: does not spin) [B + 1]; `radius`,
    m, of everything that spins.
    """

    def __init__(self, inverse_mass: np.ndarray, inverse_inertia: np.ndarray, radius: float) -> None:
        self.inverse_mass, self.inverse_inertia, self.radius = inverse_mass, inverse_inertia, radius

    def solve(
        self, contacts: Contacts, velocity: np.ndarray, spin: np.ndarray, slowest: np.ndarray
    ) -> np.ndarray:
        """Remove the approach at contacts, then rub; `velocity` and `spin` [3, B + 1] in place.

        `slowest` [B]: the least vertical velocity that the floor admits, m/s; -inf in the air.
        Returns the floor's vertical impulse by mass [B], m/s.
        """
        vertical = velocity[1, :-1]
        lift = np.maximum(slowest - vertical, 0.0)
        vertical += lift

        one, other, normal, gap, friction = contacts
        if not one.size:
            return lift

        # In k contacts a body counts as k times as light, so that their impulses cannot add up to too much.
        share = np.bincount(one, minlength=velocity.shape[1])
        share += np.bincount(other, minlength=velocity.shape[1])
        mobility = self.inverse_mass * share
        mass = 1.0 / (mobility[one] + mobility[other])

        closing = np.maximum(gap, 0.0) / TICK_S  # the gap may be closed within the tick
        cells = _cells(one, other, velocity.shape[1])
        push = np.concatenate([normal * self.inverse_mass[one], normal * -self.inverse_mass[other]], axis=1)
        impulse = np.zeros(one.size)

        for _ in range(ROUNDS):
            speed = ((velocity[:, one] - velocity[:, other]) * normal).sum(axis=0)
            # An impulse may shrink again in a later round, but it never pulls.
            grown = np.maximum(impulse - (speed + closing) * mass, 0.0)
            change = grown - impulse
            if np.abs(change).max() < NEGLIGIBLE:
                break
            impulse = grown
            _add(velocity, cells, push * np.concatenate([change, change]))

            # What contacts push into the floor, the floor lifts at once.
            more = np.maximum(slowest - vertical, 0.0)
            vertical += more
            lift += more

        self._rub(contacts, cells, velocity, spin, friction * impulse, share)
        return lift

    def separate(self, contacts: Contacts, position: np.ndarray) -> None:
        """Shrink penetrations, shared by inverse mass; `position` [3, B + 1] in place."""
        deep = np.flatnonzero(contacts.gap < 0)
        if deep.size:
            one, other = contacts.one[deep], contacts.other[deep]
            mobility_one, mobility_other = self.inverse_mass[one], self.inverse_mass[other]
            push = contacts.normal[:, deep] * (push_out(contacts.gap[deep]) / (mobility_one + mobility_other))
            apart = np.concatenate([push * mobility_one, push * -mobility_other], axis=1)
            _add(position, _cells(one, other, position.shape[1]), apart)

    def _rub(
        self,
        contacts: Contacts,
        cells: np.ndarray,
        velocity: np.ndarray,
        spin: np.ndarray,
        limit: np.ndarray,
        share: np.ndarray,
    ) -> None:
        """Brake the slip at contacts by at most `limit` [C], kg m/s; balls are spun by it.

        The slip is v - radius * w x n, each body's; a ball at slip has the inverse mass 1 / m + radius^2 / I.
        """
        one, other, normal, _, _ = contacts
        mass, inertia = self.inverse_mass, self.inverse_inertia

        # A contact lies on opposite sides of two balls, so their spins add up in the slip.
        slip = velocity[:, one] - velocity[:, other]
        slip -= self.radius * _cross(spin[:, one] + spin[:, other], normal)
        slip -= normal * (slip * normal).sum(axis=0)

        speed = np.sqrt((slip * slip).sum(axis=0))
        slip /= np.maximum(speed, 1e-9)

        mobility = share * (mass + self.radius**2 * inertia)
        impulse = np.minimum(speed / (mobility[one] + mobility[other]), limit)

        # Opposite impulses on opposite sides: the torque is the same on both.
        torque = _cross(normal, slip) * (self.radius * impulse)
        slip *= impulse
        _add(velocity, cells, np.concatenate([slip * -mass[one], slip * mass[other]], axis=1))
        _add(spin, cells, np.concatenate([torque * inertia[one], torque * inertia[other]], axis=1))


def joined(parts: list[Contacts]) -> Contacts:
    """Return the contacts of all parts."""
    return Contacts(*(np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True)))


def _cells(one: np.ndarray, other: np.ndarray, num_columns: int) -> np.ndarray:
    """Return the places of both bodies' x, y, z in flattened [3, num_columns], int [3 * 2 C]."""
    both = np.concatenate([one, other])
    return (np.arange(3)[:, None] * num_columns + both).reshape(-1)


def _add(bodies: np.ndarray, cells: np.ndarray, values: np.ndarray) -> None:
    """Add `values` [3, 2 C] to `cells` of `bodies` [3, B + 1]; a cell may occur several times."""
    np.add.at(bodies.reshape(-1), cells, values.reshape(-1))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[[1, 2, 0]] * b[[2, 0, 1]] - a[[2, 0, 1]] * b[[1, 2, 0]]
