"""All scenes by name: one record says where a scene's class, drawing and stated ranges are.

The scenes are those of this package and those that installed packages name as entry points of the group
`mappo_unity.scenes` (README.md). A module is imported when something in it is needed, so that listing the
names imports no scene.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.mujoco_check import check_mujoco
from mappo_unity.signals import interrupts_wait

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

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
    """The `mappo_unity.scenes.core.shapes.Drawing`; None: the scene trains, but cannot be shown."""
    ranges: str | None = None
    """The class that `scripts/soak_scenes.py` watches the scene with; None: it cannot be soaked."""
    picture: tuple[int, int] = (0, 8)
    """Seed, and decisions played at random, of the moment that `scripts/draw_scenes.py` draws."""
    package: str | None = None
    """The installed package that names the scene, filled in when it is found; None: this one."""


def _ours(name: str, folder: str, scene: str, picture: tuple[int, int]) -> SceneRecord:
    """Return the record of a scene of this package, whose parts lie alike for every scene."""
    package = f"{__package__}.{folder}"
    return SceneRecord(
        name,
        f"{package}.scene:{scene}",
        f"{package}.drawing:DRAWING",
        f"scene_ranges.{folder}:{scene}",
        picture,
    )


_RECORDS = (
    _ours("3DBall", "ball3d", "Ball3D", (0, 4)),
    _ours("Basic", "basic", "Basic", (0, 3)),
    _ours("Walker", "walker", "Walker", (3, 3)),
    _ours("GridFoodCollector", "grid_food_collector", "GridFoodCollector", (20, 28)),
    _ours("SoccerTwos", "soccer", "SoccerTwos", (1, 12)),
    _ours("StrikersVsGoalie", "soccer", "StrikersVsGoalie", (2, 12)),
    _ours("DungeonEscape", "dungeon_escape", "DungeonEscape", (4, 8)),
    _ours("Hallway", "hallway", "Hallway", (36, 10)),
    _ours("WallJump", "wall_jump", "WallJump", (0, 6)),
    _ours("CooperativePushBlock", "cooperative_push_block", "CooperativePushBlock", (6, 10)),
    _ours("PushBlock", "push_block", "PushBlock", (0, 12)),
    _ours("Pyramids", "pyramids", "Pyramids", (32, 10)),
)
BUILT_IN = {record.name: record for record in _RECORDS}
"""The scenes of this package, by name."""


GROUP = "mappo_unity.scenes"
"""Entry points of installed packages: scene name = package.module:class, or a SceneRecord there."""


def scene_names() -> list[str]:
    """Return the names of all scenes: ours, then those of installed packages."""
    return [*BUILT_IN, *sorted(_installed().keys() - BUILT_IN)]


def make_scene(name: str, seed: int = 0, **params: Any) -> Scene:
    """Return a new scene.

    `params`: `num_areas` (default: as in Unity), `num_threads` (default 1), and the scene's environment
    parameters, e.g. ``make_scene("3DBall", num_areas=64, mass=2.0)``.
    Raises ConfigError: unknown scene or parameter, or a value out of range; lists the choices. Also if the
    package that the scene comes from cannot be imported, or its code raises.
    """
    record = find_record(name)
    if record is None:
        raise ConfigError(f"there is no embedded scene {name!r}; choices: {', '.join(scene_names())}")

    scene_class: type[Scene] = _load(record.scene, record)
    if record.package is None:
        return scene_class(seed=seed, **params)

    # A package's scene is called like a user's factory: what it raises is reported as the package's.
    from mappo_unity.scenes.factory import call_factory

    _check_class(scene_class, record)
    scene: Any = call_factory(scene_class, _who(record), seed, params)
    return scene


def drawing_of(name: str) -> Drawing:
    """Return the drawing of a scene; raises ConfigError where there is none."""
    from mappo_unity.scenes.core.shapes import Drawing

    record = find_record(name)
    if record is None:
        raise ConfigError(f"there is no drawing of a scene {name!r}; choices: {', '.join(scene_names())}")
    if record.drawing is None:
        raise ConfigError(f"there is no drawing of the {_who(record)}: its record names none")

    drawing = _load(record.drawing, record)
    if not isinstance(drawing, Drawing):
        raise ConfigError(f"{_who(record)}: {record.drawing} is {drawing!r}, but must be a Drawing")

    return drawing


def ranges_of(name: str) -> Any:
    """Return the class that watches a scene's stated ranges; its module must be on Python's path.

    Raises ConfigError: nobody has stated the scene's ranges.
    """
    record = find_record(name)
    if record is None or record.ranges is None:
        raise ConfigError(f"there are no stated ranges of a scene {name!r}")
    return _load(record.ranges, record)


def find_record(name: str) -> SceneRecord | None:
    """Return the record of a scene; None: there is no such scene.

    Raises ConfigError: two packages name it, or what a package names for it is not there.
    """
    entries = _installed().get(name, ())
    packages = [entry.dist.name if entry.dist else entry.module for entry in entries]
    owners = [*(["mappo-unity"] if name in BUILT_IN else []), *(f"the package {p}" for p in packages)]
    if len(owners) > 1:
        raise ConfigError(
            f"there are {len(owners)} scenes {name!r}, of {' and '.join(owners)}: uninstall one, or give it "
            f"another name among the entry points of the group {GROUP}"
        )

    if not entries:
        return BUILT_IN.get(name)

    entry = entries[0]
    path = f"{entry.module}:{entry.attr}"
    record = SceneRecord(name, path, package=packages[0])
    # A package names a class, or a record that says more than where the class is.
    named = _load(path, record)
    return replace(named, name=name, package=packages[0]) if isinstance(named, SceneRecord) else record


def _installed() -> dict[str, list[EntryPoint]]:
    """Return what installed packages name, by scene."""
    return _entry_points(tuple(sys.path))


@lru_cache(maxsize=1)
def _entry_points(path: tuple[str, ...]) -> dict[str, list[EntryPoint]]:
    """Look through the packages on Python's `path`, which takes too long to be done for every scene made."""
    from importlib.metadata import entry_points

    found: dict[str, list[EntryPoint]] = {}
    for entry in entry_points(group=GROUP):
        found.setdefault(entry.name, []).append(entry)

    return found


def _check_class(scene_class: Any, record: SceneRecord) -> None:
    """Raise ConfigError unless a package's class is a scene of the name that its entry point has."""
    from mappo_unity.scenes.core.scene import Scene

    who = f"{_who(record)}: {record.scene}"
    if not (inspect.isclass(scene_class) and issubclass(scene_class, Scene)):
        raise ConfigError(
            f"{who} is {scene_class!r}, but must be a SceneRecord or a subclass of "
            "mappo_unity.scenes.core.scene.Scene"
        )

    own = getattr(scene_class, "NAME", None)
    if own != record.name:
        raise ConfigError(f"{who} has NAME = {own!r}; it must be {record.name!r}, the entry point's name")


def _who(record: SceneRecord) -> str:
    return f"scene {record.name}" + (f" of the package {record.package}" if record.package else "")


def _load(path: str, record: SceneRecord) -> Any:
    """Return what package.module:name names; raises ConfigError if it is a package's and not there."""
    module_name, _, attributes = path.partition(":")
    with interrupts_wait():
        try:
            value: Any = importlib.import_module(module_name)
            for attribute in attributes.split("."):
                value = getattr(value, attribute)
        except (Exception, SystemExit) as error:
            check_mujoco()  # says it if that is why
            if record.package is None:
                raise
            from mappo_unity.scenes.factory import explain_error

            raise explain_error(error, f"{_who(record)}: {path} cannot be loaded: it") from error

    return value
