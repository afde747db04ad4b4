"""All scenes by name: one record says where a scene's class, drawing and stated ranges are.

In: a scene's name. Out: the scene, its drawing, its ranges. A module is imported when something of it is
asked for, so that listing the names costs nothing.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.mujoco_check import check_mujoco
from mappo_unity.signals import interrupts_wait

if TYPE_CHECKING:
    from mappo_unity.scenes.core.scene import Scene
    from mappo_unity.scenes.core.shapes import Drawing


@dataclass(frozen=True)
class SceneRecord:
    """Say where everything about a scene is, each as package.module:name."""

    name: str
    """What users call the scene; its class has it as NAME."""
    scene: str
    """The class, a subclass of `mappo_unity.scenes.core.scene.Scene`."""
    drawing: str | None = None
    """The `mappo_unity.scenes.core.shapes.Drawing`; None: the scene trains, but cannot be filmed."""
    ranges: str | None = None
    """The class that `scripts/soak_scenes.py` watches the scene with; None: it cannot be soaked."""
    picture: tuple[int, int] = (0, 8)
    """Seed, and decisions played at random, of the moment that `scripts/draw_scenes.py` draws."""


def _ours(name: str, folder: str, scene: str, picture: tuple[int, int]) -> SceneRecord:
    """Return the record of a scene of this package, whose parts lie alike for every scene."""
    package = f"{__package__}.{folder}"
    return SceneRecord(
        name, f"{package}.scene:{scene}", f"{package}.drawing:DRAWING", f"scene_ranges:{scene}", picture
    )


_RECORDS = (
    _ours("3DBall", "ball3d", "Ball3D", (0, 4)),
    _ours("Basic", "basic", "Basic", (0, 3)),
    _ours("Walker", "walker", "Walker", (3, 3)),
    _ours("GridFoodCollector", "grid_food_collector", "GridFoodCollector", (0, 28)),
    _ours("SoccerTwos", "soccer", "SoccerTwos", (1, 12)),
    _ours("StrikersVsGoalie", "soccer", "StrikersVsGoalie", (2, 12)),
    _ours("DungeonEscape", "dungeon_escape", "DungeonEscape", (4, 8)),
    _ours("Hallway", "hallway", "Hallway", (1, 6)),
    _ours("WallJump", "wall_jump", "WallJump", (0, 6)),
    _ours("Pyramids", "pyramids", "Pyramids", (3, 10)),
)
BUILT_IN = {record.name: record for record in _RECORDS}
"""The scenes of this package, by name."""


def scene_names() -> list[str]:
    """Return the names of all scenes."""
    return list(BUILT_IN)


def make_scene(name: str, seed: int = 0, **params: Any) -> Scene:
    """Return a new scene.

    `params`: `num_areas` (default: as in Unity), `num_threads` (default 1), and the scene's environment
    parameters, e.g. ``make_scene("3DBall", num_areas=64, mass=2.0)``.
    Raises ConfigError: unknown scene or parameter, or a value out of range; lists the choices.
    """
    if name not in BUILT_IN:
        raise ConfigError(f"there is no embedded scene {name!r}; choices: {', '.join(scene_names())}")
    scene: Scene = _load(BUILT_IN[name].scene)(seed=seed, **params)
    return scene


def drawing_of(name: str) -> Drawing:
    """Return the drawing of a scene; raises ConfigError where there is none."""
    from mappo_unity.scenes.core.shapes import Drawing

    record = BUILT_IN.get(name)
    if record is None or record.drawing is None:
        drawn = [known.name for known in BUILT_IN.values() if known.drawing]
        raise ConfigError(f"there is no drawing of a scene {name!r}; choices: {', '.join(drawn)}")
    drawing = _load(record.drawing)
    assert isinstance(drawing, Drawing)
    return drawing


def ranges_of(name: str) -> Any:
    """Return the class that watches a scene's stated ranges; its module must be on Python's path.

    Raises ConfigError: nobody has stated the scene's ranges.
    """
    record = BUILT_IN.get(name)
    if record is None or record.ranges is None:
        raise ConfigError(f"there are no stated ranges of a scene {name!r}")
    return _load(record.ranges)


def _load(path: str) -> Any:
    """Return what package.module:name names."""
    module_name, _, attribute = path.partition(":")
    with interrupts_wait():
        try:
            module = importlib.import_module(module_name)
        except Exception:
            check_mujoco()  # says it if that is why
            raise
    return getattr(module, attribute)
