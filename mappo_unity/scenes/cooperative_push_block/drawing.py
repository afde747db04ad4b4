"""How CooperativePushBlock looks: PushBlock's room with three agents and six blocks of three sizes."""

from __future__ import annotations

from mappo_unity.scenes.cooperative_push_block.scene import NUM_AGENTS, CooperativePushBlock
from mappo_unity.scenes.core.shapes import BROWN, ORANGE, YELLOW, Drawing, Shape
from mappo_unity.scenes.push_block.drawing import CAMERA, agent, block, room

COLORS = (YELLOW, YELLOW, ORANGE, ORANGE, BROWN, BROWN)  # small, large, very large


def shapes(scene: CooperativePushBlock, area: int) -> list[Shape]:
    """Return room, goal, agents and the blocks that are still there."""
    boxes = scene.boxes
    drawn = room()
    for number in range(NUM_AGENTS):
        drawn += agent(boxes, area, number)
    for number, color in enumerate(COLORS, NUM_AGENTS):
        if boxes.present[area, number]:
            drawn.append(block(boxes, area, number, color))
    return drawn


DRAWING = Drawing(shapes, CAMERA)
