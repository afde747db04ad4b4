"""Where things stand in an area of DungeonEscape, and how large they are.

Constants only, in the axes of the platform: x right, y up, z forward, metres, the floor's top at y = 0.
Source: Unity's scene (docs/scenes/DungeonEscape.md).
"""

from __future__ import annotations

import numpy as np

NUM_AGENTS = 3
WALL = 12.5
"""From the centre to the inner faces of the walls."""
COLUMN = np.array([4.5, 4.0])
"""x, z of one of the four columns; the others mirror it."""
COLUMN_RADIUS = 0.718

# What an agent can touch. The first five are the things of an area.
LOCK, TOMB, PORTAL, DRAGON, KEY, COLUMN_BASE, NEXT_AGENT = range(7)
NUM_THINGS, NUM_TOUCHES = 5, 7

LOCK_CENTRE = (0.015, 1.385, 12.6)
PORTAL_CENTRE = (11.83, 1.83, -11.77)
PORTAL_YAW = np.radians(-45.0)
PORTAL_TARGET = np.array([11.58, -11.59])
"""x, z of the portal's object: where the dragon goes."""
DRAGON_START = np.array([[0.0, 8.0], [-8.0, 0.0], [0.0, -8.0], [8.0, 0.0]])
"""x, z by the platform's quarter turns, [4, 2]: the place is fixed in the world."""
DRAGON_START_Y = 0.79
DRAGON_START_YAW = np.pi - np.pi / 2 * np.arange(4)  # along -z of the world, seen from the turned platform

AGENT_HALF = (0.5, 0.5, 0.5)
KEY_HALF = (0.605, 0.23, 0.09)
"""Half sizes of the key, the free one and the dragon's."""
KEY_OFFSET = -0.186
"""Of the free key's box from its origin, along its own x."""
CARRIED_KEY = (0.94, -0.37)
"""Of the dragon's key from the dragon's centre: ahead, and up."""
COLUMN_BASE_HALF = (0.85, 0.185, 0.85)
TOMB_UPPER_HALF = (0.525, 0.71, 0.165)
TOMB_LOWER_HALF = (0.605, 0.22, 0.26)
TOMB_RISE = 0.23
"""Of the tombstone's upper box above the dead agent's centre."""
TOMB_DROP = 0.85
"""Of the tombstone's lower box below the upper one."""

HALVES = np.array(
    [
        (1.5, 1.3, 0.535),
        (TOMB_LOWER_HALF[0], TOMB_UPPER_HALF[1], TOMB_LOWER_HALF[2]),
        (2.345, 2.365, 0.88),
        (0.75, 0.75, 0.75),
        KEY_HALF,
        (COLUMN_BASE_HALF[0], 2.0, COLUMN_BASE_HALF[2]),
        (AGENT_HALF[0], 2.0, AGENT_HALF[2]),
    ]
)
"""Half sizes [7, 3] of what agents meet.

A column is as wide as its base, a tombstone as its lower box: steps that an agent cannot climb. Agents
are taller to each other than they are, so that those that collide fast are never put one on the other.
"""
