"""`env.stagger`: areas whose first episodes end at times of their own."""

from __future__ import annotations

import numpy as np
import pytest
from omegaconf import OmegaConf

from mappo_unity.config.compose import compose_config
from mappo_unity.config.effects import check_effect
from mappo_unity.config.presets import conf_dir
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.core.scene import Scene

AREAS = 12
CLOCKS = {
    "CooperativePushBlock": 5000,
    "DungeonEscape": 15_000,
    "SoccerTwos": 5000,
    "StrikersVsGoalie": 5000,
    "Hallway": 3000,
    "GridFoodCollector": 5000,
}
"""Time limits in ticks."""


def clocks(scene: Scene) -> np.ndarray:
    """Return how many ticks of their episodes are over, for each area."""
    timer = getattr(scene, "timer", None)
    return scene.agents.step_count.reshape(AREAS, -1)[:, 0] if timer is None else timer


def begun(name: str, is_staggered: bool, seed: int = 3) -> Scene:
    scene = make_scene(name, num_areas=AREAS, seed=seed)
    scene.is_staggered = is_staggered
    scene.reset()
    return scene


@pytest.mark.parametrize("name", CLOCKS)
def test_areas_begin_at_times_of_their_own(name: str) -> None:
    scene, limit = begun(name, True), CLOCKS[name]
    over = clocks(scene)
    assert len(set(over.tolist())) == AREAS and over.min() >= 0 and over.max() < limit
    assert over.max() - over.min() > limit / 2

    together = clocks(begun(name, False))
    assert len(set(together.tolist())) == 1 and together.max() <= 1


def test_the_first_episodes_are_shorter_and_the_next_ones_whole() -> None:
    """Of GridFoodCollector, whose episodes end by the limit alone."""
    scene = begun("GridFoodCollector", True)
    limit, over = CLOCKS["GridFoodCollector"], clocks(scene)
    name = next(iter(scene.behavior_specs))
    ends: list[list[int]] = [[] for _ in range(AREAS)]  # ticks
    while scene.counter < 2 * limit:
        scene.step()
        for agent in scene.get_steps(name)[1].agent_id:
            if agent % scene.agents_per_area == 0:
                ends[agent // scene.agents_per_area].append(scene.counter)
    for area, (first, second, *_) in enumerate(ends):
        assert abs(first - (limit - over[area])) <= 5 and second - first == limit


def test_a_snapshot_keeps_the_clocks() -> None:
    scene, other = begun("CooperativePushBlock", True), begun("CooperativePushBlock", True, seed=4)
    assert not np.array_equal(clocks(scene), clocks(other))
    other.set_state(scene.get_state())
    np.testing.assert_array_equal(clocks(scene), clocks(other))


def test_training_heeds_it_and_evaluation_does_not() -> None:
    cfg = compose_config(["env=CooperativePushBlock"]).config.env
    assert cfg.stagger
    for is_training in (True, False):
        env = make_env_function(cfg, is_training=is_training)(0)
        assert isinstance(env, Scene) and env.is_staggered == is_training
    assert not make_scene("CooperativePushBlock").is_staggered


def test_recipe_mlagents_begins_as_unity_does() -> None:
    assert not compose_config(["env=CooperativePushBlock", "recipe=mlagents"]).config.env.stagger
    preset = OmegaConf.load(conf_dir() / "env/CooperativePushBlock.yaml")
    assert OmegaConf.select(preset, "env.stagger") is True


def test_it_is_refused_where_nothing_looks_at_it() -> None:
    lines = ["env.backend=player", "env.file_name=Game", "env.stagger=true"]
    with pytest.raises(ConfigError, match=r"env.stagger=true has no effect with env.backend=player"):
        check_effect(["env.stagger"], [compose_config(lines).config])

    # said by a preset alone it is no mistake
    check_effect([], [compose_config(["env=CooperativePushBlock", *lines[:2]]).config])
