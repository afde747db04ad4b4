"""How the embedded scenes look: `drawing_of(name)` returns a scene's shapes and its camera.

In: a scene. Out: plain shapes (shapes.py). One module a scene; none of them draws or imports a renderer.
"""

from __future__ import annotations

import importlib

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.shapes import Drawing

DRAWINGS = {
    "3DBall": "ball3d",
    "Basic": "basic",
    "GridFoodCollector": "grid_food_collector",
    "Walker": "walker",
    "Hallway": "hallway",
    "WallJump": "wall_jump",
    "Pyramids": "pyramids",
    "DungeonEscape": "dungeon_escape",
    "SoccerTwos": "soccer",
    "StrikersVsGoalie": "soccer",
}
"""Folder of every scene; its module `drawing` holds `DRAWING`."""


def drawing_of(scene: str) -> Drawing:
    """Return the drawing of a scene; raises ConfigError where there is none."""
    if scene not in DRAWINGS:
        raise ConfigError(f"there is no drawing of a scene {scene!r}; choices: {', '.join(DRAWINGS)}")
    module = importlib.import_module(f"mappo_unity.scenes.{DRAWINGS[scene]}.drawing")
    drawing = module.DRAWING
    assert isinstance(drawing, Drawing)
    return drawing
