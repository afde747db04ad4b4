"""Impulses at the contacts of boxes that slide on a floor: all areas at once, in rounds.

A tick's impulses are found as a sequential-impulse solver finds them, but side by side: in every round first
the normal impulses of all contacts, then their friction, then the floor's friction, each with what the others
have left. The floor's friction is part of the rounds, so that a heavy box stays where it is while the pushes
against it are less than the floor can hold. Contacts of a body share its mass, so that their impulses cannot
add up to too much.
Legend: N areas, B bodies of an area, K contacts, C the most contacts of an area.
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
    """Points where bodies may touch within the tick; vectors are x + iz."""

    area: np.ndarray
    """int [K]."""
    one: np.ndarray
    """int [K]: body of the area."""
    other: np.ndarray
    """int [K]: body of the area, or WALL."""
    normal: np.ndarray
    """complex [K]: unit vector from the other to the one."""
    arm: np.ndarray
    """complex [K], m: from the one's centre to the point."""
    other_arm: np.ndarray
    """complex [K], m: from the other's centre to the point; anything for walls."""
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

    def limited(self, change: np.ndarray) -> np.ndarray:
        """Return a change of motion [..., B, 3] (x, z, spin) as far as friction can make it."""
        speed = np.hypot(change[..., 0], change[..., 1])
        share = np.where(speed <= self.hold, 1.0, self.rub / np.maximum(speed, 1e-12))
        limited = np.empty(change.shape)
        np.multiply(change[..., :2], share[..., None], out=limited[..., :2])
        np.minimum(np.maximum(change[..., 2], -self.turn), self.turn, out=limited[..., 2])
        return limited


def solve(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Stop bodies from approaching and rub, in place.

    `motion` [N, B, 3]: velocity along x and z (m/s) and spin (rad/s, clockwise from above); `weight`
    [N, B, 3]: inverse masses (1/kg) and inertia (1/(kg m^2)), 0 where a body does not move.
    """
    if not contacts.area.size:
        motion += floor.limited(-motion)
        return

    count, bodies, _ = motion.shape
    place = _places(contacts.area)
    rows = _rows(contacts, place, (count, int(place.max()) + 1, bodies))
    answers = rows * weight.reshape(count, 1, -1)

    # Scaled by the masses at the contacts, rows turn motions into the impulses that would stop them.
    shared = rows * _shares(contacts, (count, bodies))
    masses = (answers * shared).sum(axis=3)
    masses = np.where(masses > 0, 1.0 / np.maximum(masses, 1e-12), 0.0)
    masses[0] *= HASTE
    rows *= masses[..., None]

    allowed = np.zeros(masses[0].shape)  # approach that only closes a gap, m/s
    allowed[contacts.area, place] = np.maximum(contacts.gap, 0.0) / TICK_S
    _rounds(motion, rows, answers, masses[0] * allowed, floor)


def _rounds(
    motion: np.ndarray, rows: np.ndarray, answers: np.ndarray, allowed: np.ndarray, floor: Floor
) -> None:
    """Add what all impulses do to the motion [N, B, 3].

    `rows` [2, N, C, 3 B]: normal impulses by motion, and those of friction; `answers` [2, N, C, 3 B]: motion
    by impulse; `allowed` [N, C]: what normal impulses may lack, kg m/s.
    """
    (along, across), (push, rub) = rows.swapaxes(2, 3), answers
    flat, allowed = motion.reshape(len(motion), 1, -1), allowed[:, None]  # the motion itself, in a row
    impulse = friction = np.zeros(allowed.shape)
    held = np.zeros(motion.shape)  # what the floor has taken so far

    for _ in range(ROUNDS):
        # An impulse may shrink again in a later round, but it never pulls.
        grown = np.maximum(impulse - flat @ along - allowed, 0.0)
        change = grown - impulse
        impulse = grown
        flat += change @ push

        limit = BOX_FRICTION * impulse
        rubbed = np.minimum(np.maximum(friction - flat @ across, -limit), limit)
        flat += (rubbed - friction) @ rub
        friction = rubbed

        taken = floor.limited(held - motion)
        motion += taken - held
        held = taken
        if np.abs(change).max() < NEGLIGIBLE:
            break


def _rows(contacts: Contacts, place: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Return what turns motions into speeds at contacts, [2, N, C, 3 B]: along the normals, across them."""
    (count, width, bodies), normal = shape, contacts.normal
    lever = normal.conj() * np.array((contacts.arm, contacts.other_arm))

    # Speed of a point at an arm (r_x, r_z): v_x + spin * r_z, v_z - spin * r_x.
    each = np.empty((2, *lever.shape, 3))
    each[0, ..., 0], each[0, ..., 1], each[0, ..., 2] = normal.real, normal.imag, lever.imag
    each[1, ..., 0], each[1, ..., 1], each[1, ..., 2] = normal.imag, -normal.real, lever.real

    # Walls have the last column, which is cut off.
    rows = np.zeros((2, count, width, bodies + 1, 3))
    rows[:, contacts.area, place, contacts.one] = each[:, 0]
    rows[:, contacts.area, place, contacts.other] = -each[:, 1]
    return rows[:, :, :, :bodies].reshape(2, count, width, -1)


def _shares(contacts: Contacts, shape: tuple[int, int]) -> np.ndarray:
    """Return [N, 1, 3 B]: how many contacts a body has, at least 1, for each part of its motion."""
    count, bodies = shape
    first = contacts.area * (bodies + 1) + 1  # the first column is that of the walls
    touched = np.concatenate((first + contacts.one, first + contacts.other))
    share = np.maximum(np.bincount(touched, minlength=count * (bodies + 1)), 1.0)
    return np.repeat(share.reshape(count, 1, -1)[..., 1:], 3, axis=2)


def _places(area: np.ndarray) -> np.ndarray:
    """Return int [K]: the place of each contact among those of its area."""
    order = np.argsort(area, kind="stable")
    ordered = area[order]
    place = np.empty_like(area)
    place[order] = np.arange(len(area)) - np.searchsorted(ordered, ordered)
    return place
