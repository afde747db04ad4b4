"""How 3DBall looks: a cube with a face that balances a ball."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.ball3d.scene import BALL_RADIUS, CUBE_HALF, Ball3D
from mappo_unity.scenes.core.shapes import (
    BLUE,
    DARK,
    ORANGE,
    WHITE,
    Camera,
    Drawing,
    Shape,
    ball,
    box,
    quaternion_rotation,
)


def shapes(scene: Ball3D, area: int) -> list[Shape]:
    """Return the cube, its eyes, which look at the camera, and the ball."""
    turn = quaternion_rotation(scene.cube_rotation[area])
    drawn = [box((0, 0, 0), (CUBE_HALF,) * 3, BLUE, turn)]

    for side in (-1, 1):
        drawn.append(ball(turn @ np.array([side * 1.0, 0.9, -CUBE_HALF]), 0.55, WHITE))
        drawn.append(ball(turn @ np.array([side * 1.0, 1.0, -CUBE_HALF - 0.32]), 0.32, DARK))

    mouth = turn @ np.array([0.0, -0.9, -CUBE_HALF])
    drawn.append(box(mouth, (0.8, 0.12, 0.06), DARK, turn))
    drawn.append(ball(scene.ball_position[area], BALL_RADIUS * float(scene.scale[area]), ORANGE))
    return drawn


DRAWING = Drawing(shapes, Camera((0.0, 0.5, 0.0), 16.5, yaw=22.0, pitch=20.0))
