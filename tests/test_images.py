"""Where the channels of images stand: what sensors say of it, and what networks and files make of that."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from mlagents_envs.base_env import (
    ActionSpec,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
)
from onnx_fakes import data_of

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import ModelConfig
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks import encoders
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.policies.export import export_checkpoint
from mappo_unity.policies.layouts import check_layout, describe_spec, without_channels
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.onnx_policy import OnnxPolicy, open_session
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.protocol.decode import BehaviorDecoder
from mappo_unity.protocol.encode import _description
from mappo_unity.protocol.protobuf import install
from mappo_unity.runs import checkpoint
from mappo_unity.scenes.contract.images import (
    channel_dim,
    guessed_channel_dim,
    mark_channels_last,
    sends_channels_last,
)
from mappo_unity.training import resume_check
from mappo_unity.training.learners import note_unmarked
from mappo_unity.training.trainer import FINISHED, train

EXAMPLES = Path(__file__).parents[1] / "examples"
QUIET = ["ppo.epochs=1", "ppo.num_minibatches=2", "log.loggers=[]", "log.progress=false", "export_onnx=false"]
SHAPES = [(24, 10, 10), (20, 16, 16), (12, 8, 8)]
NONE, FLAT, SILENT = (
    DimensionProperty.NONE,
    DimensionProperty.TRANSLATIONAL_EQUIVARIANCE,
    DimensionProperty.UNSPECIFIED,
)
FIRST, LAST = (NONE, FLAT, FLAT), (FLAT, FLAT, NONE)


def image(shape: tuple[int, ...], flags: tuple[DimensionProperty, ...]) -> ObservationSpec:
    return ObservationSpec(shape, flags, ObservationType.DEFAULT, "camera")


@pytest.mark.parametrize(
    ("flags", "dim"),
    [(FIRST, 0), (LAST, 2), ((SILENT,) * 3, 0), ((NONE,) * 3, 0), ((FLAT,) * 3, 0), ((), 0)],
)
def test_what_a_sensor_marks_is_what_counts(flags: tuple[DimensionProperty, ...], dim: int) -> None:
    for shape in [*SHAPES, (10, 10, 24), (3, 84, 84), (84, 84, 3)]:
        assert channel_dim(image(shape, flags)) == dim
    assert channel_dim(ObservationSpec((4,), (NONE,), ObservationType.DEFAULT, "vector")) is None


def test_an_image_that_marks_nothing_and_looks_channels_last_is_noted() -> None:
    notes: list[str] = []
    sensors = [image((84, 84, 3), LAST), image((3, 84, 84), (SILENT,) * 3), image((84, 84, 3), (NONE,) * 3)]
    note_unmarked("Fake", sensors, notes.append)
    (note,) = notes
    assert "sensor 'camera' of Fake has shape (84, 84, 3) and marks no dimensions" in note
    assert "84 channels of 84 x 3" in note and "dimension_property" in note


@pytest.mark.parametrize("flags", [FIRST, LAST], ids=["channels first", "channels last"])
@pytest.mark.parametrize("shape", [*SHAPES, (10, 10, 10)])
def test_the_networks_and_their_exports_read_images_as_the_sensor_says(
    shape: tuple[int, int, int], flags: tuple[DimensionProperty, ...], tmp_path: Path
) -> None:
    torch.manual_seed(0)
    sensor = image(shape, flags)
    model = ModelConfig(hidden=[16])
    actor = make_actor(ObsLayout.from_specs([sensor]), ActionLayout(2, ()), 1, model)
    with torch.no_grad():
        actor[0].module.net[-1].weight.mul_(200)

    # what Unity gives the model: channels, height, width
    unity = shape if flags == FIRST else (shape[2], *shape[:2])
    session = open_session(data := data_of(actor, [list(shape)]), "test")
    assert session.get_inputs()[0].shape == ["batch", *unity]
    assert actor[0].module.encoder.images[0].conv[0].in_channels == unity[0]

    seen = torch.rand(5, *shape)
    compare(data, actor, [list(shape)], {"obs_0": seen})
    mean = actor[0].module(seen)[:, :2].detach().clamp(-3, 3) / 3
    given = seen if flags == FIRST else seen.permute(0, 3, 1, 2)
    feed = {"obs_0": np.ascontiguousarray(given.numpy())}
    found = session.run(["deterministic_continuous_actions"], feed)[0]
    np.testing.assert_allclose(found, mean.numpy(), atol=1e-5)

    # and what mappo-eval plays of it
    path = tmp_path / "Fake.onnx"
    path.write_bytes(data)
    spec = BehaviorSpec([sensor], ActionSpec(2, ()))
    steps = DecisionSteps([seen.numpy()], np.zeros(5), np.arange(5), None, np.zeros(5, int), np.zeros(5))
    played = OnnxPolicy(path, True).act("Fake", steps, spec).continuous
    np.testing.assert_allclose(played, mean.numpy(), atol=1e-5)


# --- players


@pytest.mark.parametrize(
    ("protocol", "package", "last"),
    [
        ("1.0.0", "1.0.8", True),
        ("1.4.0", "", True),
        ("1.5.0", "2.0.2", True),
        ("1.5.0", "2.3.0-exp.3", True),
        ("1.5.0", "3.0.0-exp.1", False),
        ("1.5.0", "4.0.0", False),
        ("1.5.0", "", False),
        ("1.5.0", "0.2.0", False),  # a scene of ours, served
    ],
)
def test_unmarked_images_of_old_packages_have_their_channels_last(
    protocol: str, package: str, last: bool
) -> None:
    hello = SimpleNamespace(communication_version=protocol, package_version=package)
    assert sends_channels_last(hello) is last


def test_only_unmarked_images_are_marked() -> None:
    vector = ObservationSpec((4,), (SILENT,), ObservationType.DEFAULT, "vector")
    silent, first = image(SHAPES[0], (SILENT,) * 3), image(SHAPES[0], FIRST)
    marked = mark_channels_last(BehaviorSpec([vector, silent, first], ActionSpec(1, ())))
    assert marked.observation_specs == [vector, image(SHAPES[0], LAST), first]


@pytest.mark.parametrize("flags", [(SILENT,) * 3, FIRST, LAST, (NONE,) * 3, None])
def test_a_served_scene_says_what_it_means_by_an_unmarked_image(flags: Any) -> None:
    install()  # before the messages of mlagents_envs
    from mlagents_envs.communicator_objects.observation_pb2 import ObservationProto

    sent = ObservationProto.FromString(_description(image(SHAPES[0], flags)))
    assert tuple(sent.dimension_properties) == (FIRST if flags in ((SILENT,) * 3, None) else flags)


@pytest.mark.parametrize(("flags", "last"), [(FIRST, False), (LAST, True)])
def test_a_picture_as_large_as_it_is_deep_is_laid_out_as_its_sensor_says(
    monkeypatch: pytest.MonkeyPatch, flags: tuple[DimensionProperty, ...], last: bool
) -> None:
    picture = np.random.default_rng(0).random((3, 3, 3), np.float32)  # height, width, channels
    monkeypatch.setattr("mappo_unity.protocol.decode._pixels", lambda data, mapping: picture)
    decoder = BehaviorDecoder("B", BehaviorSpec([image((3, 3, 3), flags)], ActionSpec(1, ())))
    found = decoder._picture(0, SimpleNamespace(compressed_data=b"", compressed_channel_mapping=[]))
    np.testing.assert_array_equal(found, picture if last else picture.transpose(2, 0, 1))


# --- checkpoints


def camera_env(seed: int) -> Any:
    """Return the example, its agents with a camera besides, of more channels than pixels a side."""
    env = importlib.import_module("custom_env").make(seed, num_agents=4)
    env.spec = BehaviorSpec([*env.spec.observation_specs, image((6, 5, 4), FIRST)], env.spec.action_spec)
    get_steps = env.get_steps

    def with_images(name: str) -> Any:
        results = get_steps(name)
        for steps in results:
            pixels = np.arange(120, dtype=np.float32).reshape(6, 5, 4) / 120
            steps.obs = [steps.obs[0], steps.obs[0][:, :1, None, None] * pixels]
        return results

    env.get_steps = with_images
    return env


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    factory = f"env.factory={__name__}:camera_env"
    return ["env=custom", "env.name=Mine", "collect.rounds=8", "model.hidden=[8]", *QUIET, factory]


def first_layer(state: dict[str, Any]) -> Any:
    weights = state["learners"]["Point"]["actor"]
    return next(value for key, value in weights.items() if key.endswith("images.0.conv.0.weight"))


def test_a_checkpoint_tells_where_the_channels_stand(tiny: list[str], tmp_path: Path) -> None:
    outcome = train(compose_config([*tiny, "max_steps=32"]).config, tmp_path / "run")
    assert outcome.status == FINISHED and outcome.last_checkpoint is not None
    state = checkpoint.load(outcome.last_checkpoint)
    assert state["layout"]["Point"]["channel_dims"] == [None, 0]
    assert first_layer(state).shape[1] == 6
    assert export_checkpoint(outcome.last_checkpoint)[0].error <= 1e-5

    env = camera_env(0)
    env.reset()
    (name, spec), *_ = env.behavior_specs.items()
    check_layout("it", state["layout"], name, spec)
    other = BehaviorSpec([spec.observation_specs[0], image((6, 5, 4), LAST)], spec.action_spec)
    with pytest.raises(ConfigError, match=r"\[6, 5, 4\] \(channels first\) .* \[6, 5, 4\] \(channels last\)"):
        check_layout("it", state["layout"], name, other)


def test_an_older_checkpoint_keeps_the_channels_that_it_was_trained_with(
    tiny: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as older:
        older.setattr(encoders, "channel_dim", lambda sensor: guessed_channel_dim(sensor.shape))
        older.setattr(
            resume_check, "describe_spec", lambda *args: without_channels({"": describe_spec(*args)})[""]
        )
        outcome = train(compose_config([*tiny, "max_steps=32"]).config, tmp_path / "run")

    # resumed twice, the second time from what this version wrote
    for steps in (64, 96):
        last = outcome.last_checkpoint
        assert last is not None
        state = checkpoint.load(last)
        assert "channel_dims" not in state["layout"]["Point"] and first_layer(state).shape[1] == 4
        assert CheckpointPolicy(last, True).agent_steps == steps - 32
        outcome = train(
            compose_config([*tiny, f"max_steps={steps}"]).config, tmp_path / "run", resume_from=last
        )
        assert outcome.status == FINISHED
