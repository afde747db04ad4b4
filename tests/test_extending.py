"""The checklists of docs/extending.md, followed from outside: as a user's package would."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from mlagents_envs.base_env import BehaviorSpec, DimensionProperty, ObservationSpec, ObservationType
from torch import Tensor, nn

from mappo_unity.cli.train import help_text
from mappo_unity.config.compose import compose_config
from mappo_unity.config.option_table import option_table
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks import encoders
from mappo_unity.runs import checkpoint
from mappo_unity.scenes.check import main as check_main
from mappo_unity.training.outcome import FINISHED
from mappo_unity.training.trainer import train

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TINY = [
    *("env=custom", "env.name=Mine", "collect.rounds=8", "model.hidden=[8]", "max_steps=64"),
    *("ppo.epochs=1", "ppo.num_minibatches=2", "log.loggers=[]", "log.progress=false"),
    *("export_onnx=false",),
]

SCENE = """
import numpy as np
from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Sensor

class Coin(Scene):
    NAME, DEFAULT_NUM_AREAS, DECISION_PERIOD = "Coin", 4, 1
    BEHAVIORS = (Behavior("Coin?team=0", (Sensor("Side", (1,)),), branches=(2,)),)

    def __init__(self, **options):
        super().__init__(**options)
        self.side = np.zeros(self.num_slots, np.int64)

    def begin_episode(self, slots):
        self.side[slots] = self.rng.integers(0, 2, len(slots))

    def observe(self, behavior, slots):
        return [self.side[slots, None].astype(np.float32)]

    def act(self, slots):
        self.set_reward(slots, (self.agents.discrete[slots, 0] == self.side[slots]).astype(np.float32))
        self.end_episode(slots)

    def scene_state(self):
        return {"side": self.side.copy()}

    def load_scene_state(self, state):
        self.side[:] = state["side"]

def make(seed, **params):
    return Coin(seed=seed, **params)
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Go to a folder with a package of the user's own, `coins`, which holds a scene."""
    (tmp_path / "coins").mkdir()
    (tmp_path / "coins" / "__init__.py").write_text("")
    (tmp_path / "coins" / "scene.py").write_text(SCENE)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    importlib.invalidate_caches()
    yield tmp_path
    for name in ("coins.scene", "coins"):
        sys.modules.pop(name, None)


# ---- a scene -----------------------------------------------------------------------------------------


def test_a_scene_of_another_package_keeps_the_contract_and_trains(package: Path, capsys: Any) -> None:
    assert check_main(["coins.scene:make", "env.params.num_areas=3", "--steps", "40"]) == 0
    assert "get_state/set_state, seed, close" in capsys.readouterr().out
    config = compose_config([*TINY, "env.factory=coins.scene:make", "env.params.num_areas=8"]).config
    outcome = train(config, package / "run")
    assert outcome.status == FINISHED and outcome.agent_steps == 64
    assert outcome.last_checkpoint is not None and outcome.last_checkpoint.exists()


# ---- an option ---------------------------------------------------------------------------------------

OPTIONS = {key: option for key, option in option_table(Config).items() if not option.is_section}


def test_every_field_of_the_schema_is_in_the_help_with_its_description() -> None:
    help_words = " ".join(help_text().split())
    for key, option in OPTIONS.items():
        assert f" {key}: " in help_words, key
        assert " ".join(option.description.split()) in help_words, key


NUMBERS = [key for key, option in OPTIONS.items() if "number" in option.accepts]


def test_numbers_compose_with_their_defaults() -> None:
    given = {k: OPTIONS[k].default for k in NUMBERS if isinstance(OPTIONS[k].default, (int, float))}
    assert len(given) > 30
    config = compose_config([f"{key}={value}" for key, value in given.items()]).config
    for key, value in given.items():
        found: Any = config
        for name in key.split("."):
            found = getattr(found, name)
        assert found == value, key


@pytest.mark.parametrize("key", NUMBERS)
def test_a_number_that_is_none_is_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        compose_config([f"{key}=nonsense"])


# ---- an encoder --------------------------------------------------------------------------------------

VOXELS = (3, 1, 1, 2)


class VoxelEncoder(nn.Module):
    """Voxels ``[..., D, H, W, F]`` through one linear layer; of each feature the largest counts."""

    size = 7

    def __init__(self, shape: tuple[int, ...], *args: object) -> None:
        super().__init__()
        self.out = nn.Linear(shape[3], self.size)

    def forward(self, voxels: Tensor) -> Tensor:
        return self.out(voxels).flatten(-4, -2).amax(-2)


def voxel_env(seed: int) -> Any:
    """Return the example, its agents with a second sensor: the way to the target in three voxels."""
    env = importlib.import_module("custom_env").make(seed, num_agents=4)
    sensor = ObservationSpec(VOXELS, (DimensionProperty.NONE,) * 4, ObservationType.DEFAULT, "voxels")
    env.spec = BehaviorSpec([*env.spec.observation_specs, sensor], env.spec.action_spec)
    get_steps = env.get_steps

    def with_voxels(name: str) -> Any:
        results = get_steps(name)
        for steps in results:
            steps.obs = [steps.obs[0], steps.obs[0][:, None, None, None].repeat(VOXELS[0], axis=1)]
        return results

    env.get_steps = with_voxels
    return env


@pytest.fixture
def voxel_module(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    return f"env.factory={__name__}:voxel_env"


def test_a_sensor_without_an_encoder_is_refused(voxel_module: str, tmp_path: Path) -> None:
    config = compose_config([*TINY, voxel_module]).config
    with pytest.raises(ConfigError, match=r"sensor obs_1 has shape \(3, 1, 1, 2\); vectors .* and images"):
        train(config, tmp_path / "run")


def test_an_encoder_for_a_new_shape_trains(
    voxel_module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = encoders.ObsLayout(2, (("obs_1", VOXELS),))
    monkeypatch.setattr(encoders.ObsLayout, "from_shapes", classmethod(lambda cls, *args: layout))
    monkeypatch.setattr(encoders, "ImageEncoder", VoxelEncoder)
    encoder = encoders.Encoder(layout, True)
    assert encoder(torch.zeros(5, 2), torch.zeros(5, *VOXELS)).shape == (5, 9)

    outcome = train(compose_config([*TINY, voxel_module]).config, tmp_path / "run")
    assert outcome.status == FINISHED and outcome.last_checkpoint is not None
    state = checkpoint.load(outcome.last_checkpoint)
    assert any("encoder.images.0.out" in key for key in state["learners"]["Point"]["actor"])
