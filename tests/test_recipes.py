"""Recipes: the values of their originals, in our options."""

import re
from dataclasses import asdict
from pathlib import Path

import pytest
import yaml

from mappo_unity.config.compose import compose_config
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.presets import conf_dir
from mappo_unity.config.schema import (
    CriticKind,
    DistributionKind,
    MemoryKind,
    ObjectiveKind,
    ObsNormUpdate,
    Schedule,
    ValueNormUpdate,
    WeightInit,
)
from mappo_unity.training.trainer import train

OFFICIAL = {  # our preset: file of the official trainer's configuration, behavior
    "3DBall": ("ppo/3DBall.yaml", "3DBall"),
    "Basic": ("ppo/Basic.yaml", "Basic"),
    "CooperativePushBlock": ("poca/PushBlockCollab.yaml", "PushBlockCollab"),
    "DungeonEscape": ("poca/DungeonEscape.yaml", "DungeonEscape"),
    "GridFoodCollector": ("ppo/FoodCollector.yaml", "GridFoodCollector"),
    "Hallway": ("ppo/Hallway.yaml", "Hallway"),
    "PushBlock": ("ppo/PushBlock.yaml", "PushBlock"),
    "Pyramids": ("ppo/Pyramids.yaml", "Pyramids"),
    "SoccerTwos": ("poca/SoccerTwos.yaml", "SoccerTwos"),
    "StrikersVsGoalie": ("poca/StrikersVsGoalie.yaml", "Striker"),
    "Walker": ("ppo/Walker.yaml", "Walker"),
    "WallJump": ("ppo/WallJump.yaml", "BigWallJump"),
}


GRAVITY = 1.5 * 9.81  # m/s^2, of CooperativePushBlock, whose preset has lessons


def composed(*lines):
    return compose_config(list(lines)).config


def test_every_embedded_scene_has_the_official_settings():
    files = {path.stem for path in (conf_dir() / "official" / "mlagents").glob("*.yaml")}
    scenes = {path.stem for path in (conf_dir() / "env").glob("*.yaml")} - {"custom", "pettingzoo", "unity"}
    assert files == set(OFFICIAL) == scenes


@pytest.mark.parametrize("scene", OFFICIAL)
def test_the_official_settings_are_those_of_the_official_file(scene, shared: Path):
    theirs = official(shared, *OFFICIAL[scene])
    check(composed("recipe=mlagents", f"env={scene}"), theirs, 2 if scene == "WallJump" else 1)


def rows_of_the_page():
    text = (Path(__file__).parents[1] / "docs" / "recipes.md").read_text(encoding="utf-8")
    return re.findall(r"^\| (\w+) \| `((?:model|ppo|max_steps)[^`]*)` \|$", text, re.M)


@pytest.mark.parametrize(("scene", "options"), rows_of_the_page())
def test_so_are_those_of_the_page_for_scenes_that_need_a_build(scene, options, shared: Path):
    trainer = "poca" if "poca" in options else "ppo"
    theirs = official(shared, f"{trainer}/{scene}.yaml", scene)
    check(composed("env=unity", "env.file_name=Game", "recipe=mlagents", *options.split()), theirs)


def test_the_page_names_every_other_official_scene():
    assert len(rows_of_the_page()) == 5


def official(shared, file, behavior):
    path = shared / "mlagents" / "config" / file
    if not path.is_file():
        pytest.skip(f"needs {path}")
    return yaml.safe_load(path.read_text())["behaviors"][behavior]


def check(ours, theirs, behaviors=1):
    """Compare our options with an official configuration of one of so many behaviors that share a batch."""
    hyper, net = theirs["hyperparameters"], theirs["network_settings"]
    schedule = Schedule(hyper["learning_rate_schedule"])
    ppo, model = ours.ppo, ours.model
    assert (ppo.lr, ppo.lr_schedule) == (hyper["learning_rate"], schedule)
    assert (ppo.clip_epsilon, ppo.clip_schedule) == (hyper["epsilon"], schedule)
    assert (ppo.entropy_coef, ppo.entropy_schedule) == (hyper["beta"], schedule)
    assert (ppo.gae_lambda, ppo.epochs) == (hyper["lambd"], hyper["num_epoch"])
    assert ppo.obs_norm_update is ObsNormUpdate.round and ppo.schedules_count_batch
    assert ppo.time_horizon == theirs["time_horizon"]
    assert ppo.minibatch_size == hyper["batch_size"] and ppo.num_minibatches is None
    assert ours.collect.batch_size == behaviors * hyper["buffer_size"] and ours.collect.rounds is None
    signals = theirs["reward_signals"]
    assert ppo.gamma == signals["extrinsic"]["gamma"]
    for name in ("curiosity", "rnd", "gail"):
        stream = getattr(ours.rewards, name)
        assert (stream.strength, stream.steps) == (signals.get(name, {}).get("strength", 0.0), 0)

    assert model.hidden == [net["hidden_units"]] * net["num_layers"] and model.critic_hidden is None
    assert model.normalize_obs == net["normalize"]
    assert model.critic is (CriticKind.poca if theirs["trainer_type"] == "poca" else CriticKind.local)
    assert model.image_encoder.value == net["vis_encode_type"]
    memory = net.get("memory")
    assert model.memory is (MemoryKind.lstm if memory else MemoryKind.none)
    if memory:
        assert (model.memory_size, ppo.sequence_length) == (memory["memory_size"], memory["sequence_length"])
    assert ours.max_steps == theirs["max_steps"]


@pytest.mark.parametrize("scene", OFFICIAL)
def test_the_official_learner_is_whole_whatever_the_preset_says(scene):
    """What a preset chose for itself must not leak into a recipe: activation, deviation, epochs."""
    config = composed("recipe=mlagents", f"env={scene}")
    bare = composed("recipe=mlagents", "env=unity", "env.file_name=Game")
    own = {"lr", "gamma", "gae_lambda", "time_horizon", "minibatch_size", "entropy_coef", "sequence_length"}
    own |= {f"{name}_schedule" for name in ("lr", "clip", "entropy")}
    ppo, expected = asdict(config.ppo), asdict(bare.ppo)
    assert {k: v for k, v in ppo.items() if k not in own} == {
        k: v for k, v in expected.items() if k not in own
    }
    assert not any(model.mirror.is_used for model in models_of(config))
    own = {"hidden", "critic", "normalize_obs", "memory", "memory_size", "mirror"}
    model, expected = asdict(config.model), asdict(bare.model)
    assert {k: v for k, v in model.items() if k not in own} == {
        k: v for k, v in expected.items() if k not in own
    }
    assert config.env.params.get("ball_touch", 0) == 0
    assert config.env.params.get("gravity", GRAVITY) == GRAVITY


@pytest.mark.parametrize("recipe", ["mappo_paper", "benchmarl"])
@pytest.mark.parametrize("scene", ["3DBall", "SoccerTwos", "Basic"])
def test_a_recipe_s_networks_are_the_same_for_every_preset(recipe, scene):
    config = composed(f"recipe={recipe}", f"env={scene}")
    bare = composed(f"recipe={recipe}", "env=unity", "env.file_name=Game")
    assert config.model == bare.model


@pytest.mark.parametrize("recipe", ["mappo_paper", "benchmarl"])
@pytest.mark.parametrize("scene", ["Walker", "StrikersVsGoalie"])
def test_a_recipe_has_no_mirror_whatever_the_preset_says(recipe, scene):
    config = composed(f"recipe={recipe}", f"env={scene}")
    assert not any(model.mirror.is_used for model in models_of(config))


@pytest.mark.parametrize("recipe", ["mlagents", "mappo_paper", "benchmarl"])
def test_a_recipe_collects_and_learns_in_turns_whatever_the_preset_does(recipe):
    preset, config = composed("env=WallJump"), composed(f"recipe={recipe}", "env=WallJump")
    assert preset.collect.overlap and preset.ppo.objective is ObjectiveKind.decoupled
    assert config.collect.workers == 0 and not config.collect.overlap
    assert config.ppo.objective is ObjectiveKind.clip


def models_of(config):
    """Return the options of the networks, of all behaviors and of each that has its own."""
    return [config.model, *(behavior_config(config, name).model for name in config.behaviors)]


def test_what_makes_the_recipes_differ():
    official, paper, benchmarl = (
        composed(f"recipe={name}") for name in ("mlagents", "mappo_paper", "benchmarl")
    )
    assert [c.ppo.optimizer_eps for c in (official, paper, benchmarl)] == [1e-8, 1e-5, 1e-6]
    assert official.ppo.max_grad_norm is None and not official.ppo.separate_optimizers
    assert official.model.weight_init is WeightInit.kaiming_normal and official.model.obs_norm_prior
    assert paper.model.layer_norm and not paper.model.normalize_obs
    assert paper.ppo.separate_optimizers and paper.ppo.critic_lr == 5e-4
    assert paper.ppo.value_norm_update is ValueNormUpdate.minibatch
    assert benchmarl.model.action_distribution is DistributionKind.tanh_normal
    assert benchmarl.ppo.separate_optimizers and benchmarl.ppo.max_grad_norm == 5.0


@pytest.mark.parametrize(
    "lines",
    [
        ["recipe=mlagents", "env=SoccerTwos", "env.num_areas=2", "model.hidden=[8]", "ppo.epochs=1"],
        ["recipe=mlagents", "env=Hallway", "env.num_areas=4", "model.memory_size=16"],
        ["recipe=mlagents", "env=3DBall", "env.num_areas=4"],
        ["recipe=mappo_paper", "env=SoccerTwos", "env.num_areas=2", "ppo.epochs=2"],
        ["recipe=benchmarl", "env=3DBall", "env.num_areas=4", "ppo.epochs=1"],
        ["recipe=benchmarl", "env=GridFoodCollector", "env.num_areas=1", "ppo.epochs=1"],
    ],
    ids=lambda lines: "-".join(line.split("=")[1] for line in lines[:2]),
)
def test_recipes_train(lines, tmp_path):
    size = ["collect.batch_size=128", "max_steps=256", "matches.interval=null"]
    config = composed(*lines, *size, "log.loggers=[]", "log.progress=false", "update_threads=1")
    outcome = train(config, tmp_path / "run")
    assert outcome.last_checkpoint is not None
    assert outcome.status == "finished", outcome
