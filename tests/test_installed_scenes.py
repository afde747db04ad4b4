"""Scenes of installed packages: found by entry points, checked, trained, played; their mistakes are told."""

from __future__ import annotations

import csv
import importlib
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mappo_unity.cli import train_main
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.protocol.serve import env_function
from mappo_unity.scenes import make_scene, scene_names
from mappo_unity.scenes.contract.check import main as check_main
from mappo_unity.scenes.registry import BUILT_IN, drawing_of

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "target_scene" / "target_scene.py"
MODULES = ("target_scene", "other_scene")
TRAIN = [
    *("env=custom", "env.backend=embedded", "env.name=Target", "env.num_areas=4", "env.params.radius=0.5"),
    *("collect.rounds=8", "model.hidden=[8]", "ppo.epochs=1", "ppo.num_minibatches=2"),
    *("log.loggers=[]", "log.progress=false", "export_onnx=false", "max_steps=64"),
]

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Give what puts a package on Python's path: its name and its scenes, NAME="module:attribute"."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)

    def put(package: str, **scenes: str) -> None:
        folder = tmp_path / package
        record = folder / f"{package}-0.1.dist-info"
        record.mkdir(parents=True)
        (record / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 0.1\n")
        lines = [f"{name} = {path}" for name, path in scenes.items()]
        (record / "entry_points.txt").write_text("\n".join(["[mappo_unity.scenes]", *lines, ""]))
        shutil.copy(EXAMPLE, folder)
        sys.path.append(str(folder))
        importlib.invalidate_caches()

    yield put
    for module in MODULES:
        sys.modules.pop(module, None)


def write_other(tmp_path: Path, text: str) -> None:
    (tmp_path / "plus" / "other_scene.py").write_text(text)
    importlib.invalidate_caches()


# ---- what works ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("attribute", ["Target", "RECORD"])
def test_a_class_or_a_record_is_made_by_name(install: Install, attribute: str) -> None:
    assert "Target" not in scene_names()
    install("plus", Target=f"target_scene:{attribute}")
    assert scene_names() == [*BUILT_IN, "Target"]
    scene: Any = make_scene("Target", seed=1, num_areas=3, radius=0.5)
    assert (scene.NAME, scene.num_areas, scene.parameters) == ("Target", 3, {"radius": 0.5})


def test_it_keeps_the_contract(install: Install, capsys: Any) -> None:
    install("plus", Target="target_scene:RECORD")
    assert check_main(["Target", "env.params.radius=0.5", "--num-areas", "3"]) == 0
    out = capsys.readouterr().out
    assert "behavior Target?team=0: observations WayToTarget (2,)" in out
    assert "Target keeps the contract: 550 steps" in out and "get_state/set_state, seed" in out


def test_it_trains(install: Install, tmp_path: Path) -> None:
    install("plus", Target="target_scene:RECORD")
    assert train_main(TRAIN) == 0
    (table,) = tmp_path.glob("outputs/Target/*/metrics.csv")
    with table.open(newline="") as file:
        assert [row["agent_steps"] for row in csv.DictReader(file)] == ["32", "64"]


def test_it_is_served_as_a_player(install: Install) -> None:
    install("plus", Target="target_scene:RECORD")
    served: Any = env_function("Target", params={"radius": 0.5})(0, 2)
    assert (served.NAME, served.num_areas) == ("Target", 2)


def test_its_drawing_is_the_records(install: Install) -> None:
    install("plus", Target="target_scene:RECORD")
    scene = make_scene("Target", num_areas=1)
    scene.reset()
    assert len(drawing_of("Target").shapes(scene, 0)) == 3


def test_a_class_alone_has_no_drawing(install: Install) -> None:
    install("plus", Target="target_scene:Target")
    with pytest.raises(ConfigError, match="no drawing of the scene Target of the package plus: its record"):
        drawing_of("Target")


# ---- mistakes -----------------------------------------------------------------------------------------


def test_unknown_names_list_installed_scenes(install: Install, capsys: Any) -> None:
    install("plus", Target="target_scene:RECORD")
    assert check_main(["Traget"]) == 2
    error = capsys.readouterr().err
    assert "there is no embedded scene 'Traget'; choices: 3DBall" in error and error.endswith(", Target\n")
    with pytest.raises(ConfigError, match="there is no scene 'Traget' .did you mean Target.*, Target"):
        env_function("Traget")


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("no_such_module:Target", "it raised ModuleNotFoundError: No module named 'no_such_module'"),
        ("target_scene:Tarket", "it raised AttributeError: module 'target_scene' has no attribute 'Tarket'"),
        ("other_scene:Target", "it raised ZeroDivisionError: division by zero"),
    ],
)
def test_an_entry_point_that_fails_names_its_package(
    install: Install, tmp_path: Path, capsys: Any, path: str, reason: str
) -> None:
    install("plus", Target=path)
    write_other(tmp_path, "1 / 0\n")
    assert train_main(TRAIN) == 2
    error = capsys.readouterr().err
    assert f"scene Target of the package plus: {path} cannot be loaded: {reason}" in error
    assert "mappo_unity/" not in error, "only the user's frames are shown"
    assert make_scene("Basic").behavior_specs, "the others are untouched"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "Target = 5",
            "is 5, but must be a SceneRecord or a subclass of mappo_unity.scenes.core.scene.Scene",
        ),
        ("class Target: pass", "but must be a SceneRecord or a subclass"),
        (
            "import target_scene\nclass Target(target_scene.Target): NAME = 'Goal'",
            "has NAME = 'Goal'; it must be 'Target', the entry point's name",
        ),
    ],
)
def test_what_is_no_scene_is_refused(install: Install, tmp_path: Path, text: str, reason: str) -> None:
    install("plus", Target="other_scene:Target")
    write_other(tmp_path, text)
    with pytest.raises(ConfigError, match=f"scene Target of the package plus: other_scene:Target .*{reason}"):
        make_scene("Target")


def test_a_record_whose_drawing_is_none_of_ours_is_refused(install: Install, tmp_path: Path) -> None:
    install("plus", Target="other_scene:RECORD")
    write_other(
        tmp_path,
        "from mappo_unity.scenes.registry import SceneRecord\n"
        "RECORD = SceneRecord('Target', 'target_scene:Target', drawing='target_scene:STEP')\n",
    )
    with pytest.raises(ConfigError, match="target_scene:STEP is 0.1, but must be a Drawing"):
        drawing_of("Target")


@pytest.mark.parametrize("name", ["Basic", "Target"])
def test_a_name_that_two_give_is_refused(install: Install, name: str) -> None:
    install("first", **{name: "target_scene:RECORD"})
    if name == "Target":
        install("second", **{name: "target_scene:RECORD"})
    first = (
        "mappo-unity and the package first" if name == "Basic" else "the package first and the package second"
    )
    with pytest.raises(ConfigError, match=f"there are 2 scenes '{name}', of {first}: uninstall one"):
        make_scene(name)
    assert scene_names().count(name) == 1


def test_what_its_code_raises_is_told_as_its_own(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mappo_unity.config.schema import Backend, EnvConfig
    from mappo_unity.envs.backends import make_env_function

    install("plus", Target="target_scene:RECORD")
    env = make_env_function(EnvConfig("Target", Backend.embedded, num_areas=1))(0)
    module = importlib.import_module("target_scene")
    env.reset()

    def fail(self: Any, slots: np.ndarray) -> None:
        raise OverflowError("too far")

    monkeypatch.setattr(module.Target, "act", fail)
    with pytest.raises(EnvironmentFailure, match="scene Target: its step raised OverflowError: too far"):
        env.step()


def test_an_installed_scene_is_no_preset_and_the_message_says_how_it_is_chosen(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("plus", Target="target_scene:RECORD")
    assert train_main(["env=Target"]) == 2
    assert "installed scene: env=custom env.backend=embedded env.name=Target" in capsys.readouterr().err
