"""How Hallway looks: the hall from the side, its symbol block, and the two goals at its end."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.shapes import (
    BLUE,
    DARK,
    FLOOR,
    GREEN,
    GREY,
    ORANGE,
    RED,
    WALL,
    Camera,
    Color,
    Drawing,
    Follow,
    Shape,
    agent_cube,
    along,
    box,
    capsule,
    square_walls,
)
from mappo_unity.scenes.hallway.scene import (
    AGENT_HALF,
    GOAL_X,
    PANEL_CENTRE,
    PANEL_HALF,
    PLATE_CENTRE,
    PLATE_HALF,
    REST_Y,
    ROOM_HALF,
    SYMBOL_HALF,
    Hallway,
)

FLOOR_Y = REST_Y - AGENT_HALF[1]
WALL_SHOWN = 1.0  # m: cut off, to look inside


def shapes(scene: Hallway, area: int) -> list[Shape]:
    """Return the hall, the symbol block (X: red, O: orange), the goals with their symbols and the agent."""
    drawn = [box((0, FLOOR_Y - 0.1, 0), (ROOM_HALF[0], 0.1, ROOM_HALF[1]), FLOOR, shadow=False)]
    drawn += square_walls(*ROOM_HALF, WALL_SHOWN, 0.5, WALL, (0, FLOOR_Y, 0))
    drawn += _sign(scene.symbol[area], SYMBOL_HALF, GREY, bool(scene.shows_x[area]))

    for side in (1, -1):
        x = side * GOAL_X
        drawn.append(box((x, *PLATE_CENTRE), PLATE_HALF, GREEN, shadow=False))
        drawn += _sign(np.array([x, *PANEL_CENTRE]), PANEL_HALF, GREY, bool(scene.o_side[area] != side))

    yaw = float(scene.yaw[area])
    return drawn + agent_cube(scene.position[area], AGENT_HALF[0], yaw, BLUE)


def _sign(middle: np.ndarray, half: tuple[float, float, float], color: Color, shows_x: bool) -> list[Shape]:
    """Return a block with an X or an O on its face towards the hall's entrance."""
    front = middle - [0, 0, half[2] + 0.05]
    drawn = [box(middle, half, color), box(front, (half[0] * 0.92, half[1] * 0.92, 0.04), DARK)]

    reach = 0.6 * min(half[0], half[1])
    front = front - [0, 0, 0.1]

    if shows_x:
        strokes = [np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 0.0])]
        return drawn + [capsule(front, 0.18, reach * 1.2, RED, along(way)) for way in strokes]

    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        place = front + reach * np.array([np.cos(angle), np.sin(angle), 0])
        way = np.array([-np.sin(angle), np.cos(angle), 0.0])
        drawn.append(capsule(place, 0.18, 0.2 * reach, ORANGE, along(way)))

    return drawn


def followed(scene: Hallway, area: int) -> np.ndarray:
    """Return how far down the hall the agent is."""
    return scene.position[area] * [0, 0, 1]


VIEW = Camera((0.0, 0.0, 6.0), 36.0, yaw=-62.0, pitch=38.0)
DRAWING = Drawing(shapes, Follow(VIEW, followed, reach=(0.0, 17.0)))
