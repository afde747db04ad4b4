"""How GridFoodCollector looks: agents, food and lasers in the arena of one area."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.shapes import (
    BLUE,
    FLOOR,
    GREEN,
    LINE,
    RED,
    WALL,
    Camera,
    Color,
    Drawing,
    Follow,
    Shape,
    agent_cube,
    ball,
    box,
    cylinder,
    floor_lines,
    square_walls,
    yaw_rotation,
)
from mappo_unity.scenes.grid_food_collector import laser as food_laser
from mappo_unity.scenes.grid_food_collector.physics import BALL_RADIUS
from mappo_unity.scenes.grid_food_collector.physics import WALL as WALL_FACE
from mappo_unity.scenes.grid_food_collector.scene import AGENTS, GOOD, WALL_HEIGHT, GridFoodCollector

FROZEN_COLOR: Color = (0.55, 0.88, 0.98, 1.0)
LASER: Color = (1.0, 0.35, 0.25, 0.45)


def shapes(scene: GridFoodCollector, area: int) -> list[Shape]:
    """Return the arena, food (good: green), agents (frozen: pale; the one followed: headband), lasers."""
    physics = scene.physics
    drawn = [box((0, -0.1, 0), (WALL_FACE, 0.1, WALL_FACE), FLOOR, shadow=False)]
    drawn += floor_lines(WALL_FACE, 10.0, 0.12, LINE)
    drawn += square_walls(WALL_FACE, WALL_FACE, WALL_HEIGHT, 1.0, WALL)

    for number, place in enumerate(physics.ball_position[:, area].T):
        drawn.append(ball(place, BALL_RADIUS, GREEN if number < GOOD else RED))

    for agent in range(AGENTS):
        yaw = float(physics.agent_yaw[area, agent])
        color = FROZEN_COLOR if scene.frozen[area, agent] else BLUE
        place, half = physics.agent_position[:, area, agent], float(physics.agent_half[area, agent])
        drawn += agent_cube(place, half, yaw, color, headband=agent == 0)
        if scene.laser_on[area, agent]:
            drawn.append(_laser(place, yaw))

    return drawn


def _laser(place: np.ndarray, yaw: float) -> Shape:
    turn = yaw_rotation(yaw)
    lying = turn @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # its own y points ahead
    half = food_laser.LENGTH / 2
    return cylinder(place + turn @ np.array([0, 0, half]), 0.35, half, LASER, lying)


def followed(scene: GridFoodCollector, area: int) -> np.ndarray:
    """Return where the first agent is, on the floor."""
    return scene.physics.agent_position[:, area, 0] * [1, 0, 1]


VIEW = Camera((0.0, 0.0, 0.0), 40.0, yaw=0.0, pitch=52.0)
DRAWING = Drawing(shapes, Follow(VIEW, followed, reach=(34.0, 39.0)))
