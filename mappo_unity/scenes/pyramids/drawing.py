"""How Pyramids looks: the arena with its walls, stone pyramids, the switch and the brick pyramid."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.shapes import (
    BLUE,
    FLOOR,
    GREEN,
    GREY,
    LINE,
    ORANGE,
    RED,
    WALL,
    YELLOW,
    Camera,
    Drawing,
    Follow,
    Shape,
    agent_cube,
    box,
    floor_lines,
    quaternion_rotation,
    yaw_rotation,
)
from mappo_unity.scenes.pyramids.bodies import AGENT_HALF, SWITCH_HALF
from mappo_unity.scenes.pyramids.bricks import ABSENT, HALVES
from mappo_unity.scenes.pyramids.layout import INNER_WALLS, LAYERS, OUTER_WALLS, STONES
from mappo_unity.scenes.pyramids.scene import Pyramids

WALL_SHOWN = 2.0  # m: the real ones are 4.5 m high and would hide the agent


def shapes(scene: Pyramids, area: int) -> list[Shape]:
    """Return arena, stones, the switch (red: off, green: on), bricks with the goal on top, and the agent."""
    bodies, bricks = scene.bodies, scene.bricks
    drawn = [box((0, -0.1, 0), (50.0, 0.1, 50.0), FLOOR, shadow=False)]
    drawn += floor_lines(50.0, 10.0, 0.12, LINE)
    drawn += [_standing(wall, WALL_SHOWN) for wall in OUTER_WALLS]

    for number, wall in enumerate(INNER_WALLS):
        drawn.append(
            _standing(wall, WALL_SHOWN + 0.02 * (number % 2))
        )  # no surface in common where they cross

    heights = bodies.stone_heights(np.array([area]))[0]
    for x, z in bodies.stone_root[area]:
        for layer, height in zip(LAYERS, heights, strict=True):
            drawn += [
                box((x + cube[0], height, z + cube[2]), (0.5, 0.5, 0.5), GREY) for cube in STONES[layer]
            ]

    color = GREEN if scene.switch_on[area] else RED
    turn = yaw_rotation(float(bodies.switch_yaw[area]))
    drawn.append(box(bodies.switch_position[area], SWITCH_HALF, color, turn))

    if bricks.mode[area] != ABSENT:
        for number, pose in enumerate(bricks.bodies[area]):
            color = YELLOW if number == len(HALVES) - 1 else ORANGE
            drawn.append(box(pose[:3], HALVES[number], color, quaternion_rotation(pose[3:])))

    return drawn + agent_cube(bodies.position[area], AGENT_HALF[0], float(bodies.yaw[area]), BLUE)


def _standing(wall: np.ndarray, top: float) -> Shape:
    """Return the part of a wall [6] (centre, half sizes) from the floor up to `top`."""
    return box((wall[0], top / 2, wall[2]), (wall[3], top / 2, wall[5]), WALL)


def followed(scene: Pyramids, area: int) -> np.ndarray:
    """Return a place on the floor up to 8 m from the agent, towards what it has to reach next."""
    bodies, bricks = scene.bodies, scene.bricks
    goal = bodies.switch_position[area] if bricks.mode[area] == ABSENT else bricks.bodies[area, -1, :3]

    way = (goal - bodies.position[area]) * [1, 0, 1]
    lead = min(8.0, 0.4 * float(np.linalg.norm(way)))
    return bodies.position[area] * [1, 0, 1] + way * lead / max(float(np.linalg.norm(way)), 1e-6)


VIEW = Camera((0.0, 0.0, 0.0), 42.0, yaw=0.0, pitch=54.0)
DRAWING = Drawing(shapes, Follow(VIEW, followed, reach=(35.0, 40.0)))
