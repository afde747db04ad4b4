"""Where things stand in an area of Pyramids: walls, spawn zones, the cubes of the two kinds of pyramid.

Constants only, in area coordinates: x right, y up, z forward, metres, the floor's top at y = 0. Source:
Unity's scene (docs/scenes/Pyramids.md).
"""

from __future__ import annotations

import numpy as np

ZONES = np.array([[x, z] for z in (-30.0, 0.0, 30.0) for x in (-30.0, 0.0, 30.0)])
"""Centres (x, z) of the nine spawn zones, [9, 2]: A to I."""
ZONE_RANGE = 11.905
"""Things stand up to this far from a zone's centre, in x and in z."""
SPAWN_Y = 2.0
"""Height of a thing's origin at its spawn; it falls from there."""

INSIDE_X = (-49.5, 49.5)
"""Inner faces of the outer walls with normals along x."""
INSIDE_Z = (-49.6, 49.1)
"""Inner faces of the outer walls with normals along z."""
OUTER_WALLS = np.array(
    [
        [-50.0, -2.5, 0.0, 0.5, 7.5, 50.0],
        [50.0, -2.5, 0.0, 0.5, 7.5, 50.0],
        [0.0, -2.5, -50.1, 50.0, 7.5, 0.5],
        [0.0, -2.5, 49.6, 50.0, 7.5, 0.5],
    ]
)
"""Boxes [4, 6]: centre x, y, z and half sizes; y from -10 to 5."""


def _inner_walls() -> np.ndarray:
    y, half_y = 0.91, 3.61  # from -2.7 to 4.52
    boxes = []

    for x in (-16.55, 16.55):
        for z in (-16.56, 16.56):
            boxes.append([x, y, z, 7.575, half_y, 0.5])  # a cross
            boxes.append([x, y, z, 0.5, half_y, 7.5])

    for side in (-42.25, 42.25):
        for along in (-16.5, 16.5):
            boxes.append([side, y, along, 7.25, half_y, 0.5])
            boxes.append([along, y, side, 0.5, half_y, 7.25])

    return np.array(boxes)


INNER_WALLS = _inner_walls()
"""Boxes [16, 6] of the four crosses and the eight side walls: centre and half sizes."""

_RING_X, _RING_Z = (-1.34, -0.213, 1.087, 2.2), (-1.06, 0.101, 1.451, 2.62)


def _cubes(
    ring_8: tuple[float, tuple[float, ...]], four: tuple[float, tuple[float, ...]], top: tuple
) -> np.ndarray:
    ring = [(x, 0.151, z) for x in _RING_X for z in _RING_Z if x in (-1.34, 2.2) or z in (-1.06, 2.62)]

    y, xs = ring_8
    zs = (-0.473, 0.771, 2.121)
    ring += [(x, y, z) for x in xs for z in zs if not (x == xs[1] and z == zs[1])]

    y, xs = four
    ring += [(x, y, z) for x in xs for z in (0.131, 1.375)]

    return np.array([*ring, top])


BRICKS = _cubes((1.601, (-0.803, 0.387, 1.687)), (3.111, (-0.143, 1.047)), (0.52, 4.29, 0.8))
"""Centres [25, 3] of the brick pyramid's unit cubes, from its root."""
GOAL = np.array([0.45, 6.0, 0.8])
"""Centre of the goal cube (side 2) above the brick pyramid, from its root."""
STONES = _cubes((1.25, (-0.82, 0.37, 1.67)), (2.38, (-0.27, 0.92)), (0.34, 3.52, 0.8))
"""Centres [25, 3] of a stone pyramid's unit cubes, from its root."""
LAYERS = (slice(0, 12), slice(12, 20), slice(20, 24), slice(24, 25))
"""Cubes of the four layers of a pyramid."""


def _stone_layers() -> np.ndarray:
    rows = []
    for number, cubes in enumerate(LAYERS):
        low, high = STONES[cubes].min(axis=0) - 0.5, STONES[cubes].max(axis=0) + 0.5
        rest_y = 0.5 + number
        rows.append([*(0.5 * (low + high)), *(0.5 * (high - low)), rest_y])

    return np.array(rows)


STONE_LAYERS = _stone_layers()
"""One box a layer of a stone pyramid, [4, 7]: centre from the root as spawned, half sizes, height at rest.

The gaps between a layer's cubes (0.35 m at most) are closed: nothing that has a body fits into them.
"""
