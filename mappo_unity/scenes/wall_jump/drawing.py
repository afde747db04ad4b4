"""How WallJump looks: the platform with its wall, the block to climb it and the goal behind it."""

from __future__ import annotations

from mappo_unity.scenes.core.shapes import (
    BLUE,
    FLOOR,
    GREEN,
    ORANGE,
    WALL,
    Camera,
    Drawing,
    Shape,
    agent_cube,
    box,
    faded,
)
from mappo_unity.scenes.wall_jump.bodies import (
    AGENT_HALF,
    BLOCK_HALF,
    FLOOR_HALF,
    FLOOR_Y,
    FLOOR_Z,
    GOAL_CENTRE,
    GOAL_HALF,
    WALL_HALF_X,
    WALL_HALF_Z,
    WALL_Z,
)
from mappo_unity.scenes.wall_jump.scene import WallJump


def shapes(scene: WallJump, area: int) -> list[Shape]:
    """Return platform, wall, block, the goal's volume and the agent."""
    bodies = scene.bodies
    drawn = [box((0, FLOOR_Y - 0.25, FLOOR_Z), (FLOOR_HALF, 0.25, FLOOR_HALF), FLOOR, shadow=False)]

    above = float(bodies.wall_height[area]) / 2 - FLOOR_Y
    if above > 0:
        drawn.append(box((0, FLOOR_Y + above / 2, WALL_Z), (WALL_HALF_X, above / 2, WALL_HALF_Z), WALL))

    drawn.append(box(bodies.block[area], BLOCK_HALF, ORANGE))
    drawn += agent_cube(bodies.position[area], AGENT_HALF[0], float(bodies.yaw[area]), BLUE)

    plate = (GOAL_CENTRE[0], FLOOR_Y + 0.02, GOAL_CENTRE[2])
    drawn.append(box(plate, (GOAL_HALF[0], 0.03, GOAL_HALF[2]), GREEN, shadow=False))
    return [*drawn, box(GOAL_CENTRE, GOAL_HALF, faded(GREEN, 0.3))]


DRAWING = Drawing(shapes, Camera((0.0, -0.4, -4.4), 35.0, yaw=60.0, pitch=36.0))
