"""What DungeonEscape's agents touch, and what stops them: things, columns, each other, the walls.

Upright boxes with the contact rules of `ground.py`, found at the start of a tick.
Legend: N areas, A = 3 agents of an area, S = N * A slots, T = 5 things of an area, K = 7 touches.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import (
    BOX_FRICTION,
    CONTACT_GAP,
    TICK_S,
    box_gap,
    push_out,
    stop,
    stop_pair,
)
from mappo_unity.scenes.dungeon_escape.layout import (
    AGENT_HALF,
    COLUMN,
    COLUMN_BASE,
    HALVES,
    KEY,
    LOCK,
    NEXT_AGENT,
    NUM_AGENTS,
    NUM_THINGS,
    NUM_TOUCHES,
    TOMB,
    WALL,
)

NEXT = (1, 2, 0)  # each agent's partner in the three pairs of an area
MASS = 10.0  # kg
TOUCH_GAP = np.where(np.arange(NUM_TOUCHES) == KEY, 0.0, CONTACT_GAP)  # a trigger must overlap
SOLID = np.isin(
    np.arange(NUM_TOUCHES), (LOCK, TOMB, COLUMN_BASE, NEXT_AGENT)
)  # the others make agents vanish
FRICTION = np.where(np.arange(NUM_TOUCHES) == COLUMN_BASE, 0.0, BOX_FRICTION)


def _reach() -> np.ndarray:
    """Return how near along x and z an agent's centre must be to touch, [K, 2]."""
    reach = np.stack([np.hypot(HALVES[:, 0], HALVES[:, 2])] * 2, axis=1)  # things that may be turned
    reach[[LOCK, COLUMN_BASE]] = HALVES[[LOCK, COLUMN_BASE]][:, ::2]
    return reach + np.hypot(AGENT_HALF[0], AGENT_HALF[2]) + CONTACT_GAP


_REACH = _reach()


class Contacts:
    """Find and apply the contacts of agents with things, columns and each other."""

    def __init__(self, num_areas: int) -> None:
        shape = (num_areas, NUM_AGENTS, NUM_TOUCHES)
        self._offset = np.zeros((*shape, 3))  # from what is touched to the agent
        self._yaw = np.zeros(shape)  # of what is touched
        self._touchable = np.ones(shape, bool)

    def refresh(self, enabled: np.ndarray, present: np.ndarray) -> None:
        """Note which agents are enabled, bool [N, A], and which things are there, bool [N, T]."""
        self._touchable[:] = enabled[:, :, None]
        self._touchable[:, :, :NUM_THINGS] &= present[:, None]
        self._touchable[:, :, NEXT_AGENT] &= enabled[:, NEXT]

    def stop(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        yaw: np.ndarray,
        thing: np.ndarray,
        thing_yaw: np.ndarray,
        shift: np.ndarray,
    ) -> np.ndarray:
        """Return bool [N, A, K], who touches what; stop agents at what is solid, in place.

        `position`, `velocity`, `shift` [S, 3], `yaw` [S]: the agents'; `thing` [N, T, 3], `thing_yaw` [N, T].
        `shift` gains the way out of overlaps, m.
        """
        self._measure(position, yaw, thing, thing_yaw)

        # Most agents are near nothing: a coarse look along the axes spares the exact gaps.
        offset = self._offset.reshape(-1, NUM_TOUCHES, 3)
        distance = np.abs(offset)
        near = distance[:, :, 0] < _REACH[:, 0]
        near &= distance[:, :, 2] < _REACH[:, 1]
        near &= self._touchable.reshape(near.shape)

        touching = np.zeros(near.shape, bool)
        slots, what = np.nonzero(near)
        if slots.size:
            turn = self._yaw.reshape(near.shape)[slots, what]
            gap, normal = box_gap(offset[slots, what], yaw[slots], AGENT_HALF, HALVES[what], turn)
            touches = gap < TOUCH_GAP[what]
            touching[slots, what] = touches
            solid = np.flatnonzero(touches & SOLID[what])
            if solid.size:
                _stop(velocity, shift, slots[solid], what[solid], gap[solid], normal[solid])

        return touching.reshape(self._touchable.shape)

    def _measure(
        self, position: np.ndarray, yaw: np.ndarray, thing: np.ndarray, thing_yaw: np.ndarray
    ) -> None:
        """Write the offsets from everything that may be touched to the agents, and its yaws."""
        offset = self._offset
        place = position.reshape(-1, NUM_AGENTS, 3)
        np.subtract(place[:, :, None], thing[:, None], out=offset[:, :, :NUM_THINGS])

        # A column's offset along y stays 0: it is met at any height.
        flat = place[:, :, ::2]
        offset[:, :, COLUMN_BASE, ::2] = flat - np.copysign(COLUMN, flat)  # the nearest of the four

        np.subtract(place, place[:, NEXT], out=offset[:, :, NEXT_AGENT])

        self._yaw[:, :, :NUM_THINGS] = thing_yaw[:, None]
        self._yaw[:, :, NEXT_AGENT] = yaw.reshape(-1, NUM_AGENTS)[:, NEXT]


def stop_at_walls(position: np.ndarray, velocity: np.ndarray, extent: np.ndarray, shift: np.ndarray) -> None:
    """Stop agents at the four walls, in place; as `ground.stop`, along the axes.

    `position`, `velocity`, `shift` [S, 3]; `extent` [S]: half the agents' width along both axes, m.
    """
    side = position[:, ::2]
    gap = (WALL - extent)[:, None] - np.abs(side)
    near = gap < CONTACT_GAP
    if not near.any():
        return

    sign = np.sign(side)
    shift[:, ::2] -= sign * push_out(gap)

    # An approach that closes the gap just within the tick may stay.
    lack = (sign * velocity[:, ::2] - np.maximum(gap, 0.0) / TICK_S) * near
    rows = np.flatnonzero((lack > 0.0).any(axis=1))
    if rows.size:
        lack, stopped = np.maximum(lack[rows], 0.0), velocity[rows]
        flat = stopped[:, ::2]  # a view
        flat -= sign[rows] * lack

        # Each wall rubs across its own axis, falls too: the one across x takes from z and y.
        slip = np.hypot(flat[:, ::-1], stopped[:, 1:2])  # along the wall across x, along the one across z
        kept = np.maximum(1.0 - BOX_FRICTION * lack / np.maximum(slip, 1e-12), 0.0)
        flat *= kept[:, ::-1]
        stopped[:, 1] *= kept[:, 0] * kept[:, 1]
        velocity[rows] = stopped


def _stop(
    velocity: np.ndarray,
    shift: np.ndarray,
    slots: np.ndarray,
    what: np.ndarray,
    gap: np.ndarray,
    normal: np.ndarray,
) -> None:
    """Apply contacts [n] of `slots`, in ascending order, with `what`; no slot meets one thing twice."""
    out = push_out(gap)[:, None] * normal

    paired = what == NEXT_AGENT
    if paired.any():
        _stop_pairs(velocity, shift, slots[paired], gap[paired], normal[paired], out[paired])
        rows = np.flatnonzero(~paired)
        slots, what, gap, normal, out = slots[rows], what[rows], gap[rows], normal[rows], out[rows]

    # What is written back keeps one row a slot, so a turn must hold no slot twice.
    turns = [np.arange(len(slots))]
    if (slots[1:] == slots[:-1]).any():  # between two things: in turns
        turns = [np.flatnonzero(what == one) for one in np.unique(what)]

    for rows in turns:
        chosen = slots[rows]
        stopped = velocity[chosen]
        stop(stopped, normal[rows], gap[rows], FRICTION[what[rows]])
        velocity[chosen] = stopped
        shift[chosen] += out[rows]


def _stop_pairs(
    velocity: np.ndarray,
    shift: np.ndarray,
    slots: np.ndarray,
    gap: np.ndarray,
    normal: np.ndarray,
    out: np.ndarray,
) -> None:
    """Stop agents `slots` [n] and their partners from approaching; an agent may be in two pairs: in turns."""
    mobility = np.full(3, 1.0 / MASS)
    number = slots % NUM_AGENTS

    for one in np.unique(number):
        rows = np.flatnonzero(number == one)
        first = slots[rows]
        second = first - one + NEXT[one]
        stopped, other = velocity[first], velocity[second]
        stop_pair(stopped, other, normal[rows], gap[rows], mobility, mobility)
        velocity[first], velocity[second] = stopped, other
        # Both weigh the same: each gives way by half.
        shift[first] += 0.5 * out[rows]
        shift[second] -= 0.5 * out[rows]
