"""How Basic looks: a cube on a line of places, between a small and a large goal."""

from __future__ import annotations

from mappo_unity.scenes.basic.scene import LARGE_GOAL, SIZE, SMALL_GOAL, START, Basic
from mappo_unity.scenes.core.shapes import (
    BLUE,
    FLOOR,
    GREEN,
    GREY,
    Camera,
    Drawing,
    Shape,
    agent_cube,
    ball,
    box,
)

TICK_S = 0.15  # Unity's own pace without Python; a decision is a tick


def shapes(scene: Basic, area: int) -> list[Shape]:
    """Return the line, its places, the goals and the agent; a place is 1 m wide."""
    drawn = [box((0, -0.6, 0), (10.7, 0.1, 1.2), FLOOR, shadow=False)]
    drawn += [
        box((place - START, -0.48, 0), (0.44, 0.03, 0.44), GREY, shadow=False) for place in range(SIZE + 1)
    ]
    drawn.append(ball((SMALL_GOAL - START, -0.1, 0), 0.35, GREEN))
    drawn.append(ball((LARGE_GOAL - START, 0.35, 0), 0.8, GREEN))
    return drawn + agent_cube((float(scene.position[area]) - START, 0.0, 0.0), 0.45, 3.6, BLUE)


DRAWING = Drawing(shapes, Camera((0.0, -0.3, 0.0), 22.5, yaw=5.0, pitch=24.0), tick_s=TICK_S)
