"""How PushBlock looks: a room with a goal along one wall, an agent and its block."""

from __future__ import annotations

from mappo_unity.scenes.core.shapes import (
    BLUE,
    FLOOR,
    GREEN,
    ORANGE,
    WALL,
    Camera,
    Color,
    Drawing,
    Shape,
    agent_cube,
    box,
    square_walls,
    yaw_rotation,
)
from mappo_unity.scenes.push_block.agents import AGENT_HALF, BLOCK_HALF_Y
from mappo_unity.scenes.push_block.bodies import SlidingBoxes
from mappo_unity.scenes.push_block.scene import AGENT, BLOCK, PushBlock
from mappo_unity.scenes.push_block.scene import WALL as WALL_FACE
from mappo_unity.scenes.push_block.sight import GOAL_HALF, GOAL_Z

WALL_SHOWN = 0.8  # m: cut off, to look inside


def shapes(scene: PushBlock, area: int) -> list[Shape]:
    """Return room, goal, block and agent."""
    boxes = scene.boxes
    return [*room(), *agent(boxes, area, AGENT), block(boxes, area, BLOCK, ORANGE)]


def room() -> list[Shape]:
    """Return floor, walls and the goal's strip."""
    drawn = [box((0, -0.1, 0), (WALL_FACE, 0.1, WALL_FACE), FLOOR, shadow=False)]
    drawn += square_walls(WALL_FACE, WALL_FACE, WALL_SHOWN, 0.5, WALL)
    return [*drawn, box((0, 0.02, GOAL_Z), (GOAL_HALF[0], 0.02, GOAL_HALF[1]), GREEN, shadow=False)]


def agent(boxes: SlidingBoxes, area: int, body: int) -> list[Shape]:
    """Return an agent's cube."""
    x, z = boxes.place[area, body]
    return agent_cube((x, boxes.height[area, body], z), AGENT_HALF[0], float(boxes.yaw[area, body]), BLUE)


def block(boxes: SlidingBoxes, area: int, body: int, color: Color) -> Shape:
    """Return a block."""
    (x, z), (half_x, half_z) = boxes.place[area, body], boxes.half[area, body]
    turn = yaw_rotation(float(boxes.yaw[area, body]))
    return box((x, boxes.height[area, body], z), (half_x, BLOCK_HALF_Y, half_z), color, turn)


CAMERA = Camera((0.0, 0.0, -0.8), 41.5, yaw=0.0, pitch=56.0)
DRAWING = Drawing(shapes, CAMERA)
