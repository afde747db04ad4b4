"""How SoccerTwos and StrikersVsGoalie look: the pitch, its goals, the players and the ball."""

from __future__ import annotations

import math

import numpy as np

from mappo_unity.scenes.core.shapes import (
    BLUE,
    PURPLE,
    WALL,
    WHITE,
    Camera,
    Color,
    Drawing,
    Shape,
    agent_cube,
    ball,
    box,
    faded,
    yaw_rotation,
)
from mappo_unity.scenes.soccer.physics import BALL_RADIUS
from mappo_unity.scenes.soccer.pitch import (
    BLOCK_X,
    BLOCK_Z,
    NET_LENGTH,
    NET_Z,
    POST_X,
    SIDE_Z,
)
from mappo_unity.scenes.soccer.scene import BLUE as BLUE_TEAM
from mappo_unity.scenes.soccer.scene import SoccerScene

WALL_SHOWN = 1.0  # m: the real ones are 4 m high and would hide the game
NET_SHOWN = 2.0
CORNER_X, CORNER_Z = (13.56, 15.46), (7.51, 4.216)  # ends of a corner wall's inner face
CIRCLE_RADIUS = 2.5
HALF_LENGTH = 15.5  # m
GRASS: Color = (0.42, 0.66, 0.42, 1.0)


def shapes(scene: SoccerScene, area: int) -> list[Shape]:
    """Return the pitch, players in their teams' colours, and the ball."""
    drawn = _pitch(scene.physics.pitch.blue_closed)
    x, z = scene.physics.position[:, :, area]

    for number, role in enumerate(scene.ROLES):
        color = BLUE if role.team == BLUE_TEAM else PURPLE
        place = (x[number + 1], 0.5, z[number + 1])
        drawn += agent_cube(place, 0.5, float(scene.yaw[number, area]), color, headband=True)

    return [*drawn, ball((x[0], BALL_RADIUS, z[0]), BALL_RADIUS, WHITE)]


def _pitch(blue_closed: bool) -> list[Shape]:
    # tops differ by a millimetre: what has two surfaces at one place is lit twice
    drawn = [
        box((0, -0.1, 0), (CORNER_X[0], 0.1, SIDE_Z), GRASS, shadow=False),
        box((0, -0.101, 0), (HALF_LENGTH, 0.1, CORNER_Z[1]), GRASS, shadow=False),
        box((0, 0.0, 0), (0.06, 0.01, SIDE_Z), WHITE, shadow=False),
    ]

    for angle in np.linspace(0, 2 * np.pi, 36, endpoint=False):
        place = (CIRCLE_RADIUS * np.sin(angle), 0.0, CIRCLE_RADIUS * np.cos(angle))
        drawn.append(box(place, (0.22, 0.01, 0.05), WHITE, yaw_rotation(float(angle)), shadow=False))

    half = WALL_SHOWN / 2
    length = math.hypot(CORNER_X[1] - CORNER_X[0], CORNER_Z[1] - CORNER_Z[0])

    normal = np.array([0.5 * math.sqrt(3), 0.5])  # of the corner at x, z > 0, off the pitch
    face = np.array([sum(CORNER_X), sum(CORNER_Z)]) / 2
    wall, grass = face + 0.23 * normal, face - 0.8 * normal

    for side in (1, -1):
        drawn.append(box((0, half, side * (SIDE_Z + 0.23)), (CORNER_X[0], half, 0.23), WALL))
        for end in (1, -1):
            turn = yaw_rotation(math.radians(60.0) * side * end)
            place = (end * wall[0], half, side * wall[1])
            drawn.append(box(place, (length / 2, half, 0.23), WALL, turn))
            place = (end * grass[0], -0.102, side * grass[1])
            drawn.append(box(place, (length / 2, 0.1, 0.8), GRASS, turn, shadow=False))

    if blue_closed:
        drawn.append(box((-BLOCK_X - 0.25, half, 0), (0.25, half, BLOCK_Z), WALL))

    for end, color in ((-1, BLUE), (1, PURPLE)):
        drawn += _net(end, float(POST_X[0 if end < 0 else 1]), color)

    return drawn


def _net(end: int, front: float, color: Color) -> list[Shape]:
    middle, height = end * (front + NET_LENGTH / 2), NET_SHOWN / 2
    glass = faded(color, 0.45)
    drawn = [box((middle, -0.1, 0), (NET_LENGTH / 2, 0.1, NET_Z + 0.1), color, shadow=False)]

    for side in (1, -1):
        drawn.append(box((middle, height, side * (NET_Z + 0.05)), (NET_LENGTH / 2, height, 0.05), glass))

    back = end * (front + NET_LENGTH - 0.05)
    return [*drawn, box((back, height, 0), (0.05, height, NET_Z), glass)]


VIEW = Camera(
    (0.02, 0.0, -1.0), 36.0, yaw=0.0, pitch=54.0
)  # half a pixel aside: the halfway line tapers evenly
DRAWING = Drawing(shapes, VIEW, goals=True)
