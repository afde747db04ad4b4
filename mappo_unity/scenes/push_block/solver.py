"""Impulses at the contacts of boxes that slide on a floor: all areas at once, in rounds.

A tick's impulses are found as a sequential-impulse solver finds them, but side by side: in every round first
the normal impulses of all contacts, then their friction, then the floor's friction, each with what the others
have left. The floor's friction is part of the rounds, so that a heavy box stays where it is while the pushes
against it are less than the floor can hold. Contacts of a body share its mass, so that their impulses cannot
add up to too much.
Legend: N areas, B bodies of an area, K contacts, n areas with contacts, C the most contacts of one of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import BOX_FRICTION, TICK_S

ROUNDS = 16
HASTE = 1.2  # over-relaxation of the normal impulses; stable below 2, as bodies' masses are shared
NEGLIGIBLE = 1e-2  # kg m/s: an impulse that ends the rounds
WALL = -1  # instead of a body's number


class Contacts(NamedTuple):
    """Points where bodies may touch within the tick; x and z only."""

    area: np.ndarray
    """int [K]."""
    one: np.ndarray
    """int [K]: body of the area."""
    other: np.ndarray
    """int [K]: body of the area, or WALL."""
    normal: np.ndarray
    """[2, K]: unit vector (x, z) from the other to the one."""
    arm: np.ndarray
    """[2, K], m: from the one's centre to the point."""
    other_arm: np.ndarray
    """[2, K], m: from the other's centre to the point; anything for walls."""
    gap: np.ndarray
    """[K], m: may be closed within the tick; negative where they overlap."""


class Floor(NamedTuple):
    """What the floor takes from bodies in a tick; arrays [N, B], of speed (m/s) and of spin (rad/s)."""

    hold: np.ndarray
    """The most speed that friction stops entirely (static)."""
    rub: np.ndarray
    """What it takes from a body that is faster (dynamic)."""
    turn: np.ndarray
    """The most spin that it takes."""

    def at(self, areas: np.ndarray) -> Floor:
        """Return the limits of some areas."""
        return Floor(self.hold[areas], self.rub[areas], self.turn[areas])

    def limited(self, change: np.ndarray) -> np.ndarray:
        """Return a change of motion [..., B, 3] (x, z, spin) as far as friction can make it."""
        x, z, spin = change[..., 0], change[..., 1], change[..., 2]
        speed = np.sqrt(x * x + z * z)
        share = np.where(speed <= self.hold, 1.0, self.rub / np.maximum(speed, 1e-12))
        limited = np.empty(change.shape)
        np.multiply(x, share, out=limited[..., 0])
        np.multiply(z, share, out=limited[..., 1])
        np.minimum(np.maximum(spin, -self.turn), self.turn, out=limited[..., 2])
        return limited


def solve(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Stop bodies from approaching and rub, in place.

    `motion` [N, B, 3]: velocity along x and z (m/s) and spin (rad/s, clockwise from above); `weight`
    [N, B, 3]: inverse masses (1/kg) and inertia (1/(kg m^2)), 0 where a body does not move.
    """
    if not contacts.area.size:
        motion += floor.limited(-motion)
        return

    met = np.zeros(len(motion), bool)
    met[contacts.area] = True
    areas = met.nonzero()[0]
    local = (met.cumsum() - 1)[contacts.area]
    count, bodies = len(areas), motion.shape[1]
    place = _places(local)
    width = int(place.max()) + 1

    along, across = _rows(contacts, local, place, (count, width, bodies))
    share = _shares(contacts, local, (count, bodies))
    light = weight[areas].reshape(count, 1, -1)
    push, rub = along * light, across * light
    spread = np.repeat(share, 3, axis=1)[:, None]
    mass = _inverse((along * push * spread).sum(axis=2))
    rub_mass = _inverse((across * rub * spread).sum(axis=2))

    allowed = np.zeros((count, width))  # m/s of approach that only closes a gap
    allowed[local, place] = np.maximum(contacts.gap, 0.0) / TICK_S

    # All other areas have only the floor.
    touched = motion[areas]
    if count < len(motion):
        motion += floor.limited(-motion)
    motion[areas] = _rounds(touched, (along, across), (push, rub), (mass, rub_mass), allowed, floor.at(areas))


def _rounds(
    motion: np.ndarray,
    rows: tuple[np.ndarray, np.ndarray],
    answers: tuple[np.ndarray, np.ndarray],
    masses: tuple[np.ndarray, np.ndarray],
    allowed: np.ndarray,
    floor: Floor,
) -> np.ndarray:
    """Return the motion [n, B, 3] after all impulses; rows, answers [n, C, 3 B], masses, allowed [n, C]."""
    (along, across), (push, rub), (mass, rub_mass) = rows, answers, masses
    shape = motion.shape
    flat = motion.reshape(len(motion), 1, -1).copy()
    column = flat.transpose(0, 2, 1)  # a view
    impulse, friction = np.zeros_like(allowed), np.zeros_like(allowed)
    held = np.zeros(shape)  # what the floor has taken so far

    for _ in range(ROUNDS):
        # An impulse may shrink again in a later round, but it never pulls.
        approach = (along @ column)[:, :, 0] + allowed
        grown = np.maximum(impulse - HASTE * approach * mass, 0.0)
        change = grown - impulse
        impulse = grown
        flat += change[:, None] @ push

        slip = (across @ column)[:, :, 0]
        limit = BOX_FRICTION * impulse
        rubbed = np.minimum(np.maximum(friction - slip * rub_mass, -limit), limit)
        flat += (rubbed - friction)[:, None] @ rub
        friction = rubbed

        taken = floor.limited(held - flat.reshape(shape))
        flat += (taken - held).reshape(flat.shape)
        held = taken
        if np.abs(change).max() < NEGLIGIBLE:
            break

    return flat.reshape(shape)


def _rows(
    contacts: Contacts, local: np.ndarray, place: np.ndarray, shape: tuple[int, int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return what turns motions into speeds at the contacts, [n, C, 3 B]: along the normals, across them."""
    count, width, bodies = shape
    paired = (contacts.other != WALL).nonzero()[0]
    (x, z), (right, ahead) = contacts.normal, contacts.arm
    other_right, other_ahead = contacts.other_arm[:, paired]
    other_x, other_z = x[paired], z[paired]

    # Speed of a point at an arm (r_x, r_z): v_x + spin * r_z, v_z - spin * r_x.
    rows = np.zeros((2, count, width, bodies, 3))
    mine = np.empty((2, len(x), 3))
    mine[0, :, 0], mine[0, :, 1], mine[0, :, 2] = x, z, x * ahead - z * right
    mine[1, :, 0], mine[1, :, 1], mine[1, :, 2] = z, -x, z * ahead + x * right
    rows[:, local, place, contacts.one] = mine

    theirs = np.empty((2, len(paired), 3))
    theirs[0, :, 0], theirs[0, :, 1] = -other_x, -other_z
    theirs[0, :, 2] = other_z * other_right - other_x * other_ahead
    theirs[1, :, 0], theirs[1, :, 1] = -other_z, other_x
    theirs[1, :, 2] = -other_z * other_ahead - other_x * other_right
    rows[:, local[paired], place[paired], contacts.other[paired]] = theirs

    along, across = rows.reshape(2, count, width, -1)
    return along, across


def _shares(contacts: Contacts, local: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return [n, B]: how many contacts a body has, at least 1."""
    count, bodies = shape
    first = local * bodies
    paired = contacts.other != WALL
    share = np.bincount(first + contacts.one, minlength=count * bodies)
    share += np.bincount((first + contacts.other)[paired], minlength=count * bodies)
    return np.maximum(share, 1).reshape(shape)


def _places(local: np.ndarray) -> np.ndarray:
    """Return int [K]: the place of each contact among those of its area."""
    order = np.argsort(local, kind="stable")
    ordered = local[order]
    starts = np.searchsorted(ordered, ordered)
    place = np.empty_like(local)
    place[order] = np.arange(len(local)) - starts
    return place


def _inverse(values: np.ndarray) -> np.ndarray:
    """Return 1 / values, 0 where there is no contact."""
    return np.where(values > 0, 1.0 / np.maximum(values, 1e-12), 0.0)
