"""How Walker looks: the figure, seen by a camera that goes with it, and the target."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.shapes import (
    BLUE,
    DARK,
    FLOOR,
    GREY,
    ORANGE,
    WALL,
    WHITE,
    YELLOW,
    Camera,
    Drawing,
    Follow,
    Shape,
    along,
    ball,
    box,
    capsule,
    cylinder,
    faded,
    floor_lines,
    quaternion_rotation,
    square_walls,
)
from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.physics import colliders
from mappo_unity.scenes.walker.scene import PLATFORM_HALF, Walker

_HALF, _RADIUS, _CENTRE, _ = colliders()
_LYING = along(np.array([1.0, 0.0, 0.0]))  # a capsule along x


def shapes(scene: Walker, area: int) -> list[Shape]:
    """Return the platform with lines 2.5 m apart, the parts of the figure and the target."""
    drawn = _platform()
    position, rotation = scene.physics.position[area], scene.physics.rotation[area]

    for number, part in enumerate(body.PARTS):
        turn = quaternion_rotation(rotation[number])
        place = position[number] + turn @ _CENTRE[number]
        drawn.append(_part(number, part, place, turn))
        if part.name == "head":
            for side in (-1, 1):
                drawn.append(
                    ball(place + turn @ np.array([0.08 * side, 0.05, 0.19]), 0.055, WHITE, shadow=False)
                )
                drawn.append(
                    ball(place + turn @ np.array([0.08 * side, 0.05, 0.23]), 0.03, DARK, shadow=False)
                )

    target = scene.physics.target_position[area]
    drawn.append(box(target, (body.TARGET_HALF,) * 3, YELLOW))
    return [*drawn, cylinder(target + [0, 1.0, 0], 0.03, 1.0, faded(YELLOW, 0.6))]


def followed(scene: Walker, area: int) -> np.ndarray:
    """Return where the hips are, on the ground."""
    return scene.physics.position[area, 0] * [1, 0, 1]


def _part(number: int, part: body.Part, place: np.ndarray, turn: np.ndarray) -> Shape:
    kind, radius = part.collider[0], float(_RADIUS[number])
    color = ORANGE if part.name[-1] in "LR" and part.name[:4] in ("hand", "foot") else BLUE

    if kind == "foot":
        return box(place, _HALF[number], color, turn)
    if kind == "sphere":
        return ball(place, radius, color, turn)
    if kind == "x":
        return capsule(place, radius, float(_HALF[number, 0]), color, turn @ _LYING)
    return capsule(place, radius, float(_HALF[number, 1]), color, turn)


def _platform() -> list[Shape]:
    top = body.GROUND_Y
    drawn = [box((0, top - 0.1, 0), (PLATFORM_HALF, 0.1, PLATFORM_HALF), FLOOR, shadow=False)]
    drawn += floor_lines(PLATFORM_HALF, 2.5, 0.04, GREY, top)
    return drawn + square_walls(PLATFORM_HALF, PLATFORM_HALF, 0.5, 0.25, WALL, (0, top, 0))


VIEW = Camera((0.0, 0.8, 0.0), 7.0, yaw=145.0, pitch=14.0)
DRAWING = Drawing(shapes, Follow(VIEW, followed), tick_s=body.TICK_S)
