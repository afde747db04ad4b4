"""Impulses at the contacts of boxes that slide on a floor: all areas at once, in rounds.

A tick's impulses are found as a sequential-impulse solver finds them, but side by side: in every round first
the normal impulses of all contacts, then their friction, then the floor's friction, each with what the others
have left. The floor's friction is part of the rounds, so that a heavy box stays where it is while the pushes
against it are less than the floor can hold. Contacts of a body share its mass, so that their impulses cannot
add up to too much.

The bodies of a few areas make one system, which takes the fewest calls; of many areas each is a system of its
own, so that the work grows only with their number. All take the rounds of the one that needs most. Arrays of
one system have no axis G.
Legend: M bodies of all areas in a row; G systems of B bodies each; K contacts, C the most of a system.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mappo_unity.scenes.core.ground import BOX_FRICTION, TICK_S

ROUNDS = 16
HASTE = 1.2  # over-relaxation of the normal impulses; stable below 2, as bodies' masses are shared
NEGLIGIBLE = 1e-2  # kg m/s: an impulse that ends the rounds
FEW = 64  # bodies that make one system, at most
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
    """[G, B], m/s: the most speed that friction stops entirely (static); `rub` itself where it is equal."""
    rub: np.ndarray
    """[G, B], m/s: what it takes from a faster body (dynamic); above 0."""
    turn: np.ndarray
    """[2, G, B], rad/s: the least and the most that it adds to the spin."""

    def limited(self, change: np.ndarray) -> np.ndarray:
        """Return what friction makes of a change of motion [G, 3, B] (x, z, spin) that would stop it."""
        hold, rub, (least, most) = self
        speed = np.hypot(change[..., 0, :], change[..., 1, :])
        share = rub / np.maximum(speed, rub)
        if hold is not rub:
            share[speed <= hold] = 1.0

        limited = np.empty(change.shape)
        np.multiply(change[..., :2, :], share[..., None, :], out=limited[..., :2, :])
        np.minimum(np.maximum(change[..., 2, :], least), most, out=limited[..., 2, :])
        return limited


def systems_of(num_areas: int, bodies: int) -> tuple[int, ...]:
    """Return the shape [G, B] of the systems that areas with so many bodies each make."""
    return (num_areas * bodies,) if num_areas * bodies <= FEW else (num_areas, bodies)


def solve(contacts: Contacts, motion: np.ndarray, weight: np.ndarray, floor: Floor) -> None:
    """Stop bodies from approaching and rub, in place.

    `motion` [G, 3, B]: velocity along x and z (m/s) and spin (rad/s, clockwise from above); `weight`
    [G, 3, B]: inverse masses (1/kg) and inertia (1/(kg m^2)), of which the latter is 0 where contacts turn
    nothing.
    """
    if not contacts.gap.size:
        motion += floor.limited(-motion)
        return

    # A body's mass is shared by its contacts; walls are counted in front of the bodies.
    share = np.bincount((contacts.bodies + 1).ravel(), minlength=floor.rub.size + 1)[1:]
    shared = weight * share.reshape(*floor.rub.shape[:-1], 1, -1)
    if motion.ndim > 2:
        contacts = _by_system(contacts, floor.rub.shape)

    # `dot` takes half the time of `matmul` on arrays so small, but knows one system only.
    times = np.dot if motion.ndim == 2 else np.matmul
    rows = _rows(contacts, motion.shape[-1])
    answers = rows * _in_a_row(weight)

    # Scaled by the masses at the contacts, rows turn motions into the impulses that would stop them. Places
    # of a system without a contact have nothing to weigh.
    masses = 1.0 / np.maximum(times(rows * rows, _in_a_row(shared).swapaxes(-1, -2)), 1e-12)
    masses[0] *= HASTE
    masses[1] /= BOX_FRICTION  # so that friction is at most the normal impulse
    rows *= masses
    answers[1] *= BOX_FRICTION

    # An approach that only closes a gap is not stopped.
    allowed = masses[0, ..., 0] * np.maximum(contacts.gap, 0.0) / TICK_S
    _rounds(motion, rows, answers, allowed[..., None, :], floor, times)


def _rounds(
    motion: np.ndarray,
    rows: np.ndarray,
    answers: np.ndarray,
    allowed: np.ndarray,
    floor: Floor,
    times: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> None:
    """Add what all impulses do to the motion [G, 3, B].

    `rows` [2, G, C, 3 B]: normal impulses by motion, and those of friction by its coefficient; `answers`
    [2, G, C, 3 B]: motion by either; `allowed` [G, 1, C]: what normal impulses may lack, kg m/s.
    """
    (along, across), (push, rub) = rows.swapaxes(-1, -2), answers
    flat = _in_a_row(motion)  # the motion itself
    impulse = friction = np.zeros(allowed.shape)
    held = np.zeros(motion.shape)  # what the floor has taken so far

    for _ in range(ROUNDS):
        # An impulse may shrink again in a later round, but it never pulls.
        grown = np.maximum(impulse - times(flat, along) - allowed, 0.0)
        change = grown - impulse
        impulse = grown
        flat += times(change, push)

        rubbed = np.minimum(np.maximum(friction - times(flat, across), -impulse), impulse)
        flat += times(rubbed - friction, rub)
        friction = rubbed

        stopping = held - motion
        held = floor.limited(stopping)
        np.subtract(held, stopping, out=motion)
        if not np.count_nonzero(np.abs(change) >= NEGLIGIBLE):
            break


def _rows(contacts: Contacts, size: int) -> np.ndarray:
    """Return what turns motions of B bodies into speeds at contacts, along and across, [2, G, C, 3 B]."""
    normal, arms = contacts.vectors[0], contacts.vectors[1:]
    mine, theirs = (contacts.bodies[..., None] == np.arange(size)).astype(float)  # walls match nobody

    # Speed of a point at an arm (r_x, r_z): v_x + spin * r_z, v_z - spin * r_x.
    way = np.array((normal, -1j * normal))
    lever, other_lever = (way.conj() * arms[:, None]).imag[..., None]
    way = way[..., None]
    rows, both = np.empty((*way.shape[:-1], 3, size)), mine - theirs
    np.multiply(way.real, both, out=rows[..., 0, :])
    np.multiply(way.imag, both, out=rows[..., 1, :])
    np.subtract(lever * mine, other_lever * theirs, out=rows[..., 2, :])
    return rows.reshape(*way.shape[:-1], 3 * size)


def _in_a_row(motion: np.ndarray) -> np.ndarray:
    """Return a view [G, 1, 3 B] of something [G, 3, B]."""
    return motion.reshape(*motion.shape[:-2], 1, -1)


def _by_system(contacts: Contacts, shape: tuple[int, ...]) -> Contacts:
    """Return the contacts of G systems of B bodies each, K being [G, C]: bodies numbered in their systems.

    Places that a system does not need have two walls.
    """
    systems, size = shape
    system = contacts.bodies[0] // size

    # The place of each contact among those of its system.
    order = np.argsort(system, kind="stable")
    ordered = system[order]
    place = np.empty_like(system)
    place[order] = np.arange(len(system)) - np.searchsorted(ordered, ordered)
    width = int(place.max()) + 1

    bodies = np.full((2, systems, width), WALL)
    vectors, gap = np.zeros((3, systems, width), complex), np.zeros((systems, width))
    bodies[:, system, place] = np.where(contacts.bodies == WALL, WALL, contacts.bodies - system * size)
    vectors[:, system, place], gap[system, place] = contacts.vectors, contacts.gap
    return Contacts(bodies, vectors, gap)
