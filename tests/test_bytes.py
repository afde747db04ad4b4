"""Images of bytes are held as bytes, and networks read the numbers that they stand for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import Record, ScriptedEnv
from mlagents_envs.base_env import (
    ActionSpec,
    BehaviorSpec,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
)

from mappo_unity.config.compose import compose_config
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout, in_floats
from mappo_unity.learning.networks.images import by_pixel
from mappo_unity.learning.rewards.rnd import RandomNetwork
from mappo_unity.learning.transitions import Transitions
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.images import ByteImage, from_bytes, to_bytes
from mappo_unity.scenes.contract.rules import EnvironmentDataError
from mappo_unity.training.setup import set_up
from mappo_unity.training.trainer import train

LEVELS = np.arange(256, dtype=np.uint8)[None]
GRIDS = [
    "env=GridFoodCollector",
    "env.num_areas=1",
    "collect.batch_size=20",
    "log.loggers=[]",
    "log.progress=false",
]


def picture(kind: type = ByteImage) -> BehaviorSpec:
    """Return a behavior with one picture."""
    flags = (DimensionProperty.NONE,) * 3
    return BehaviorSpec([kind((1, 4, 4), flags, ObservationType.DEFAULT, "camera")], ActionSpec(1, ()))


def test_every_level_is_held_and_read_exactly() -> None:
    numbers = LEVELS.astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(to_bytes(numbers), LEVELS)
    np.testing.assert_array_equal(from_bytes(LEVELS), numbers)
    assert torch.equal(in_floats(torch.from_numpy(LEVELS)), torch.from_numpy(numbers))


@pytest.mark.parametrize(
    "number", [0.5, -1 / 255, 256 / 255, 1.5, np.nextafter(np.float32(0.2), np.float32(1))]
)
def test_numbers_that_bytes_do_not_hold_end_the_run_with_a_line(number: float) -> None:
    script = [[Record(0)], [Record(0, obs=number)]]
    env = UnityEnv(lambda seed: ScriptedEnv(script, {"Fake?team=0": picture()}))
    with pytest.raises(
        EnvironmentDataError, match=r"'Fake\?team=0': sensor obs_0 \(camera\) is a ByteImage, but"
    ):
        env.step(env.rand_action(env.reset()))


def test_a_network_reads_bytes_as_it_reads_floats() -> None:
    torch.manual_seed(0)
    encoder = Encoder(ObsLayout.from_specs(picture().observation_specs), normalize=False)
    image = torch.randint(0, 256, (5, 2, 1, 4, 4), dtype=torch.uint8)
    assert torch.equal(encoder(image), encoder(torch.from_numpy(from_bytes(image.numpy()))))


def test_a_batch_of_grids_is_small_and_holds_what_the_scene_shows(tmp_path: Path) -> None:
    with set_up(compose_config(GRIDS).config, tmp_path) as setup, setup.collecting() as batches:
        (rounds, following) = next(batches).of("GridFoodCollector")
        grids = rounds.get("obs_0")
        assert grids.dtype == following.get(("final", "obs_0")).dtype == torch.uint8
        assert rounds.bytes() < 1.1 * grids.numel()
        scene = make_scene("GridFoodCollector", seed=setup.cfg.seed, num_areas=1)
        scene.reset()
        decision, _ = scene.get_steps("GridFoodCollector?team=0")
        np.testing.assert_array_equal(
            in_floats(grids[0]).numpy().reshape(decision.obs[0].shape), decision.obs[0]
        )


def test_what_older_versions_hold_as_floats_goes_on_as_bytes(tmp_path: Path) -> None:
    cfg = compose_config([*GRIDS, "ppo.epochs=1"]).config
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        state = setup.env.get_state()
        (behavior,) = setup.env.behaviors.values()
        before = behavior.obs[0].copy()
        state["behaviors"][behavior.name]["obs"] = [from_bytes(before)]
        setup.env.set_state(state)
        assert behavior.obs[0].dtype == np.uint8
        np.testing.assert_array_equal(behavior.obs[0], before)

        (learner,) = setup.learners.values()
        rounds, _ = next(batches).of("GridFoodCollector")
        older: dict[str, Any] = {str(k): v.clone() for k, v in learner.carried.join(rounds)[:1].items()}
        older["obs_0"] = in_floats(older["obs_0"])
        learner.carried.load_state_dict(older, torch.device("cpu"))
        joined = learner.carried.join(rounds).get("obs_0")
        assert joined.dtype == torch.uint8 and torch.equal(joined[0], rounds.get("obs_0")[0])


def test_a_scene_s_grids_train_as_floats_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = compose_config([*GRIDS, "max_steps=60", "ppo.epochs=1", "export_onnx=false"]).config
    weights = []
    for kind in (ByteImage, ObservationSpec):
        monkeypatch.setattr("mappo_unity.scenes.core.specs.ByteImage", kind)
        outcome = train(cfg, tmp_path / kind.__name__)
        weights.append(
            torch.load(outcome.last_checkpoint, weights_only=True)["learners"]["GridFoodCollector"]["actor"]
        )
    for key, value in weights[0].items():
        # bytes lie in memory pixel by pixel, floats channel by channel: sums have another order
        torch.testing.assert_close(value, weights[1][key], rtol=1e-4, atol=1e-5, msg=key)


def test_minibatches_of_grids_lie_pixel_by_pixel_in_memory(tmp_path: Path) -> None:
    with set_up(compose_config(GRIDS).config, tmp_path) as setup, setup.collecting() as batches:
        rounds, following = next(batches).of("GridFoodCollector")
        (learner,) = setup.learners.values()
        buffer, _ = learner.prepare(rounds, following)
        assert buffer is not None

        for _ in range(2):  # of the first batch, and of one with carried rounds
            (minibatch,) = buffer
            grids = minibatch.get("obs_0")
            assert grids.shape[-3:] == (5, 40, 40) and grids.stride()[-3:] == (1, 200, 5)
            buffer, _ = learner.prepare(rounds, following)

        assert rounds.get("obs_0").stride()[-3:] == (1600, 40, 1)  # the batch itself stays as it was


def test_novelty_of_grids_is_learnt_pixel_by_pixel_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strides = set()
    loss = RandomNetwork.loss

    def spy(network: RandomNetwork, decisions: Transitions) -> torch.Tensor:
        strides.update(grids.stride() for grids in decisions.next_obs if grids.ndim == 4)
        return loss(network, decisions)

    monkeypatch.setattr(RandomNetwork, "loss", spy)
    cfg = compose_config([*GRIDS, "rewards.rnd.strength=0.1"]).config
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        learner.learn(*next(batches).of("GridFoodCollector"), 0.0)
    assert strides == {(8000, 1, 200, 5)}


def test_images_by_pixel_hold_the_same() -> None:
    images = torch.randint(0, 256, (7, 2, 3, 4, 5), dtype=torch.uint8)
    assert torch.equal(by_pixel(images), images)
    assert by_pixel(images).stride() == (120, 60, 1, 15, 3)
    assert by_pixel(images.float()).stride() == images.stride()  # floats stay where they are
