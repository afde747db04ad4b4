"""Unity's example scenes, embedded: `make_scene(name)` returns a `mlagents_envs.base_env.BaseEnv`.

In: a scene's name and its parameters. Out: the scene. A scene's module is imported when it is made.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.mujoco_check import check_mujoco
from mappo_unity.signals import interrupts_wait

if TYPE_CHECKING:
    from mlagents_envs.base_env import BaseEnv

SCENES = {
    "3DBall": "ball3d.scene:Ball3D",
    "Basic": "basic.scene:Basic",
    "Walker": "walker.scene:Walker",
    "GridFoodCollector": "grid_food_collector.scene:GridFoodCollector",
    "SoccerTwos": "soccer.scene:SoccerTwos",
    "StrikersVsGoalie": "soccer.scene:StrikersVsGoalie",
    "DungeonEscape": "dungeon_escape.scene:DungeonEscape",
    "Hallway": "hallway.scene:Hallway",
    "WallJump": "wall_jump.scene:WallJump",
    "Pyramids": "pyramids.scene:Pyramids",
}
"""Module and class of every scene, below this package."""


def scene_names() -> list[str]:
    """Return the names of all scenes."""
    return list(SCENES)


def make_scene(name: str, seed: int = 0, **params: Any) -> BaseEnv:
    """Return a new scene.

    `params`: `num_areas` (default: as in Unity), `num_threads` (default 1), and the scene's environment
    parameters, e.g. ``make_scene("3DBall", num_areas=64, mass=2.0)``.
    Raises ConfigError: unknown scene or parameter, or a value out of range; lists the choices.
    """
    if name not in SCENES:
        raise ConfigError(f"there is no embedded scene {name!r}; choices: {', '.join(SCENES)}")
    module_name, _, scene = SCENES[name].partition(":")
    with interrupts_wait():
        try:
            module = importlib.import_module(f"{__name__}.{module_name}")
        except Exception:
            check_mujoco()  # says it if that is why
            raise
    return getattr(module, scene)(seed=seed, **params)
