"""Impulses at the contacts of boxes that slide on a floor: all areas at once, in rounds.

A tick's impulses are found as a sequential-impulse solver finds them, but side by side: in every round first
the normal impulses of all contacts, then their friction, then the floor's friction, each with what the others
have left. The floor's friction is part of the rounds, so that a heavy box stays where it is while the pushes
against it are less than the floor can hold. Contacts of a body share its mass, so that their impulses cannot
add up to too much.
Legend: M bodies of all areas in a row, K contacts, T bodies that take part: all, or of many those that touch
something.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import BOX_FRICTION, TICK_S

ROUNDS = 16
HASTE = 1.2  # over-relaxation of the normal impulses; stable below 2, as bodies' masses are shared
NEGLIGIBLE = 1e-2  # kg m/s: an impulse that ends the rounds
FEW = 64  # so many bodies take part at once, whether they touch something or not
WALL = -1  # instead of a body's number


class Contacts(NamedTuple):
    """Points where bodies may touch within the tick; vectors are x + iz."""

    bodies: np.ndarray
    """int [2, K]: the one, and the other or WALL."""
    vectors: np.ndarray
    """complex [3, K]: unit normal from the other to the one; arms from the centres of the one and of the
    other to the point, m (the latter is anything for walls)."""
    gap: np.ndarray
    """[K], m: may be closed within the tick; negative where they overlap."""


class Floor(NamedTuple):
    """What the floor can take from bodies in a tick."""

    hold: np.ndarray
    """[M], m/s: the most speed that friction stops entirely (static); `rub` itself where they are equal."""
    rub: np.ndarray
    """[M], m/s: what it takes from a faster body (dynamic); above 0."""
    turn: np.ndarray
    """[2, M], rad/s: the least and the most that it adds to the spin."""

    def limited(self, change: np.ndarray) -> np.ndarray:
        """Return what friction makes of a change of motion [3, M] (x, z, spin) that would stop it."""
        (hold, rub, (least, most)), (x, z, spin) = self, change
        speed = np.hypot(x, z)
        share = rub / np.maximum(speed, rub)
        if hold is not rub:
            share[speed <= hold] = 1.0

        limited = np.empty(change.shape)
        np.multiply(change[:2], share, out=limited[:2])
        np.minimum(np.maximum(spin, least), most, out=limited[2])
        return limited


def solve(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Stop bodies from approaching and rub, in place.

    `motion` [3, M]: velocity along x and z (m/s) and spin (rad/s, clockwise from above); `weight` [3, M]:
    inverse masses (1/kg) and inertia (1/(kg m^2)), of which the latter is 0 where contacts turn nothing.
    """
    if not contacts.gap.size:
        motion += floor.limited(-motion)
    elif motion.shape[1] <= FEW:
        _solve(contacts, motion, weight, floor)
    else:
        _solve_few(contacts, motion, weight, floor)


def _solve_few(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Let only bodies take part that touch something; on the others the floor acts alone."""
    touches = np.zeros(motion.shape[1] + 1, bool)
    touches[contacts.bodies] = True
    touches[WALL] = False
    bodies = touches.nonzero()[0]
    number = np.full(len(touches), WALL)
    number[bodies] = np.arange(len(bodies))

    few = motion.take(bodies, axis=1)
    hold, rub, turn = (most.take(bodies, axis=-1) for most in floor)
    held = Floor(rub if floor.hold is floor.rub else hold, rub, turn)
    _solve(contacts._replace(bodies=number[contacts.bodies]), few, weight.take(bodies, axis=1), held)
    motion += floor.limited(-motion)
    motion[:, bodies] = few


def _solve(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Do what `solve` does for contacts and bodies that all take part."""
    count = motion.shape[1]
    rows = _rows(contacts, count)
    answers = rows * weight.ravel()

    # Scaled by the masses at the contacts, rows turn motions into the impulses that would stop them. A body's
    # mass is shared by its contacts; walls are counted in front of the bodies.
    share = np.bincount((contacts.bodies + 1).ravel(), minlength=count + 1)[1:]
    masses = 1.0 / (rows * rows).dot((weight * share).ravel())
    masses[0] *= HASTE
    masses[1] /= BOX_FRICTION  # so that friction is at most the normal impulse
    rows *= masses[:, :, None]
    answers[1] *= BOX_FRICTION

    allowed = masses[0] * np.maximum(contacts.gap, 0.0) / TICK_S  # for approach that only closes a gap
    _rounds(motion, rows, answers, allowed, floor)


def _rounds(
    motion: np.ndarray, rows: np.ndarray, answers: np.ndarray, allowed: np.ndarray, floor: Floor
) -> None:
    """Add what all impulses do to the motion [3, T].

    `rows` [2, K, 3 T]: normal impulses by motion, and those of friction by its coefficient; `answers` [2, K,
    3 T]: motion by either; `allowed` [K]: what normal impulses may lack, kg m/s.
    """
    (along, across), (push, rub) = rows, answers  # `dot` takes half the time of `@` on arrays so small
    flat = motion.reshape(-1)  # the motion itself, in a row
    impulse = friction = np.zeros(len(along))
    held = np.zeros(motion.shape)  # what the floor has taken so far

    for _ in range(ROUNDS):
        # An impulse may shrink again in a later round, but it never pulls.
        grown = np.maximum(impulse - along.dot(flat) - allowed, 0.0)
        change = grown - impulse
        impulse = grown
        flat += change.dot(push)

        rubbed = np.minimum(np.maximum(friction - across.dot(flat), -impulse), impulse)
        flat += (rubbed - friction).dot(rub)
        friction = rubbed

        stopping = held - motion
        held = floor.limited(stopping)
        np.subtract(held, stopping, out=motion)
        if not np.count_nonzero(np.abs(change) >= NEGLIGIBLE):
            break


def _rows(contacts: Contacts, count: int) -> np.ndarray:
    """Return what turns motions of `count` bodies into speeds at contacts, along and across, [2, K, 3 T]."""
    normal, arms = contacts.vectors[0], contacts.vectors[1:, None]

    # Who takes part: 1 for the one, -1 for the other; walls, in the last column, are cut off.
    part, each = np.zeros((2, len(normal), count + 1)), np.arange(len(normal))
    part[0, each, contacts.bodies[0]], part[1, each, contacts.bodies[1]] = 1.0, -1.0
    mine, theirs = part[:, :, :count]

    # Speed of a point at an arm (r_x, r_z): v_x + spin * r_z, v_z - spin * r_x.
    way = np.array((normal, -1j * normal))
    lever, other_lever = (way.conj() * arms).imag[..., None]
    way = way[:, :, None]
    rows, both = np.empty((2, len(normal), 3, count)), mine + theirs
    np.multiply(way.real, both, out=rows[:, :, 0])
    np.multiply(way.imag, both, out=rows[:, :, 1])
    np.add(lever * mine, other_lever * theirs, out=rows[:, :, 2])
    return rows.reshape(2, len(normal), 3 * count)
