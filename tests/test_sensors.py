"""Entities, images by encoder, goal signals: their networks, and policies that learn from them."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from mlagents_envs.base_env import DimensionProperty, ObservationSpec, ObservationType
from sensor_probes import make, sensor
from test_probes import learn
from torch import nn

from mappo_unity.cli.player import run as player_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import (
    Activation,
    CriticKind,
    GoalKind,
    ImageKind,
    ModelConfig,
    WeightInit,
)
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import Actor, make_actor, make_critic
from mappo_unity.learning.networks.attention import EntityEncoder
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout, RunningNorm
from mappo_unity.learning.networks.goals import HyperLinear
from mappo_unity.learning.networks.images import ImageEncoder, ResidualBlock, check_sides
from mappo_unity.policies.layouts import check_layout
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.scenes.core.specs import Behavior, Sensor
from mappo_unity.training.outcome import FINISHED
from mappo_unity.training.trainer import train

TWO = ActionLayout(0, (2,))
RUN = [
    *("env=custom", "env.name=Probe", "env.factory=sensor_probes:make", "collect.rounds=8"),
    *("model.hidden=[8]", "max_steps=256", "ppo.epochs=1", "ppo.num_minibatches=2"),
    *("log.loggers=[]", "log.progress=false"),
]


def entities(*sizes, batch=6):
    """Return sets of random entities."""
    torch.manual_seed(1)
    return [torch.rand(batch, count, features) + 0.1 for count, features in sizes]


# --- entities


def test_the_order_of_entities_does_not_matter_nor_do_rows_of_zeros():
    torch.manual_seed(0)
    net = EntityEncoder([3, 2], own=4)
    own = torch.randn(6, 4)
    first, second = entities((5, 3), (4, 2))
    first[:, 3:] = 0.0
    shuffled = first[:, torch.tensor([4, 2, 0, 3, 1])]
    code = net(own, [first, second])
    assert code.shape == (6, 128)
    torch.testing.assert_close(net(own, [shuffled, second.flip(1)]), code)
    torch.testing.assert_close(net(own, [first[:, :3], second]), code)
    assert not torch.allclose(net(own, [first[:, :2], second]), code)
    assert not torch.allclose(net(own + 1, [first, second]), code)


def test_nobody_there_gives_numbers_and_gradients():
    net = EntityEncoder([3], own=0)
    rows = torch.zeros(2, 4, 3)
    rows[1, 2] = 1e-3  # small, but there
    code = net(None, [rows])
    assert (code[0] == 0).all() and (code[1] != 0).any()
    code.sum().backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters())


def test_attention_over_entities_is_ml_agents_own():
    """Worked out with their formulas: concatenation, masks, layer norms, heads (attention.py)."""
    torch.manual_seed(0)
    net = EntityEncoder([3], own=2)
    own, (rows,) = torch.randn(5, 2), entities((4, 3), batch=5)
    rows[0, 1:] = 0.0
    mask = (rows.square().sum(-1) < 1e-9).float()

    def norm(x):
        mean = x.mean(-1, keepdim=True)
        return (x - mean) / torch.sqrt(((x - mean) ** 2).mean(-1, keepdim=True) + 1e-5)

    around = nn.functional.silu(net.own[0](own)).unsqueeze(1).expand(-1, 4, -1)
    x = norm(nn.functional.silu(net.entities[0].layer(torch.cat([around, rows], 2))))
    parts = [layer(x).view(5, 4, 4, 32).permute(0, 2, 1, 3) for layer in _layers(net.attention)[:3]]
    scores = parts[0] @ parts[1].transpose(2, 3)
    flags = mask[:, None, None]
    weights = torch.softmax((1 - flags) * scores / 128**0.5 - 1e6 * flags, dim=3)
    out = norm(net.attention.out((weights @ parts[2]).permute(0, 2, 1, 3).reshape(5, 4, 128)) + x)
    expected = (out * (1 - mask)[..., None]).sum(1) / (1 - mask).sum(1, keepdim=True)
    torch.testing.assert_close(net(own, [rows]), expected, atol=1e-5, rtol=1e-5)


def _layers(attention):
    return [attention.query, attention.key, attention.content, attention.out]


def test_initial_weights_of_attention_are_t_fixup_s_whatever_the_options_say():
    for init in WeightInit:
        actor = Actor(ObsLayout.from_shapes([(40,), (6, 30)]), TWO, ModelConfig(weight_init=init))
        net = actor.encoder.sets
        for layer in (net.own[0], net.entities[0].layer, *_layers(net.attention)):
            assert layer.weight.std().item() == pytest.approx((0.125 / 128) ** 0.5, rel=0.1)
            assert not layer.bias.any()


def test_entities_stand_behind_vectors_and_images_and_are_not_normalised():
    layout = ObsLayout.from_shapes([(6, 3), (2,), (1, 8, 8), (4, 2), (3,)])
    encoder = Encoder(layout, True)
    assert layout.keys == ["observation", "obs_2", "obs_0", "obs_3"]
    assert layout.team_dims == [-2, -4, -3, -3]
    (norm,) = [part for part in encoder.modules() if isinstance(part, RunningNorm)]
    assert norm.mean.shape == (5,)
    assert encoder.size == 5 + 128 + 128
    features = encoder(*[torch.rand(2, 3, *s) for s in ((5,), (1, 8, 8), (6, 3), (4, 2))])
    assert features.shape == (2, 3, 261)


def test_rows_that_do_not_say_that_they_vary_are_refused():
    spec = ObservationSpec((20, 6), (DimensionProperty.NONE,) * 2, ObservationType.DEFAULT, "table")
    with pytest.raises(
        ConfigError, match=r"obs_1 \(table\) has shape \(20, 6\).*VARIABLE_SIZE.*BufferSensor"
    ):
        ObsLayout.from_specs([sensor("v", 3), spec])
    with pytest.raises(ConfigError, match=r"obs_0 has shape \(2, 3, 4, 5\)"):
        ObsLayout.from_shapes([(2, 3, 4, 5)])


# --- images


def linear_inputs(kind, shape, width=64):
    net = ImageEncoder(shape, 0, kind, width)
    convolutions = [
        (c.out_channels, c.kernel_size[0], c.stride[0], c.padding[0])
        for c in net.conv.modules()
        if isinstance(c, nn.Conv2d)
    ]
    assert net(torch.rand(2, 3, *shape)).shape == (2, 3, net.size)
    return convolutions, net.out[0].in_features, type(net.out[1]), net.size


@pytest.mark.parametrize(
    ("kind", "convolutions", "flat"),
    [
        (ImageKind.simple, [(16, 8, 4, 0), (32, 4, 2, 0)], 32 * 9),
        (ImageKind.nature, [(32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)], 64),
        (ImageKind.match3, [(35, 3, 1, 0), (144, 3, 1, 0)], 144 * 34 * 34),
        (ImageKind.dense, [], 3 * 38 * 38),
    ],
)
def test_encoders_have_ml_agents_sizes(kind, convolutions, flat):
    """Of 38 x 38 pixels: simple 8 and 3, nature 8, 3 and 1, match3 36 and 34."""
    assert linear_inputs(kind, (3, 38, 38)) == (convolutions, flat, nn.LeakyReLU, 64)


def test_the_residual_encoder_has_three_stacks_of_two_blocks():
    """38 pixels: pooled to 18, 8 and 3."""
    convolutions, flat, last, _ = linear_inputs(ImageKind.resnet, (3, 38, 38))
    assert convolutions == [(size, 3, 1, 1) for size in (16, 32, 32) for _ in range(5)]
    assert flat == 32 * 9 and last is nn.ReLU
    block = ResidualBlock(4)
    x = torch.randn(2, 4, 5, 5)
    swish, silu = block.layers, nn.functional.silu
    torch.testing.assert_close(block(x), x + swish[3](silu(swish[1](silu(x)))))


def test_the_encoder_of_grids_keeps_where_things_are():
    """20 cells: 6, then 4; 512 numbers where the default encoder's longer steps leave 32."""
    net = ImageEncoder((6, 20, 20), kind=ImageKind.grid, width=16)
    assert [layer.kernel_size for layer in net.conv if isinstance(layer, nn.Conv2d)] == [(5, 5), (3, 3)]
    assert net.out[0].in_features == 32 * 4 * 4 and net.size == 128
    assert ImageEncoder((6, 20, 20)).out[0].in_features == 32


def test_the_default_encoder_is_the_one_of_older_checkpoints():
    for side, kernel in ((40, (8, 8)), (19, (3, 3))):
        net = ImageEncoder((3, side, side), kind=ModelConfig().image_encoder, width=16)
        assert net.conv[0].kernel_size == kernel and isinstance(net.conv[1], nn.SiLU) and net.size == 128


@pytest.mark.parametrize(
    ("kind", "side"),
    [("simple", 20), ("nature", 36), ("resnet", 15), ("match3", 5), ("dense", 1), ("auto", 1), ("grid", 11)],
)
def test_an_image_below_an_encoder_s_size_is_refused_with_those_that_fit(kind, side):
    kind = ImageKind(kind)
    check_sides("Fake", [sensor("v", 2), sensor("camera", 3, side, side + 4)], kind)
    assert ImageEncoder((3, side, side), kind=kind)(torch.rand(1, 3, side, side)).shape == (1, 128)
    if side == 1:
        return

    message = (
        rf"obs_1 \(camera\) of 'Fake' is {side + 4} x {side - 1}, too small for .*={kind.value}, .*{side} x"
    )
    with pytest.raises(ConfigError, match=message) as error:
        check_sides("Fake", [sensor("v", 2), sensor("camera", 3, side + 4, side - 1)], kind)
    choices = str(error.value).partition("for this size: ")[2].split(", ")
    assert kind.value not in choices and {"auto", "dense"} <= {*choices}


def test_a_training_run_refuses_an_image_that_is_too_small(capsys, monkeypatch, tmp_path):
    from mappo_unity.cli import train_main

    monkeypatch.chdir(tmp_path)
    assert train_main([*RUN, "model.image_encoder=nature"]) == 2
    assert "sensor obs_3 (grid) of 'Probe' is 21 x 24, too small" in capsys.readouterr().err
    assert train_main([*RUN, "model.image_encoder=big"]) == 2
    assert "model.image_encoder" in capsys.readouterr().err


# --- goals


HYPER = {"goal_conditioning": GoalKind.hyper, "hidden": [12, 16], "activation": Activation.silu}


def test_goals_make_the_weights_of_the_last_hidden_layer():
    torch.manual_seed(0)
    layout = ObsLayout.from_shapes([(3,), (2,), (4,)], goals=[False, True, False])
    actor = Actor(layout, TWO, ModelConfig(normalize_obs=False, **HYPER))
    hidden, head = actor.net
    hyper = hidden.hyper
    assert hidden.columns.tolist() == [3, 4] and head.in_features == 16
    bound = (16 * 12) ** -0.5
    assert hyper.weights[-1].weight.abs().max().item() == pytest.approx(bound, rel=0.01)

    x = torch.randn(5, 9)
    silu = nn.functional.silu
    z = silu(hyper.weights[2](silu(hyper.weights[0](x[:, 3:5]))))
    z = (z - z.mean(-1, keepdim=True)) / torch.sqrt(z.var(-1, unbiased=False, keepdim=True) + 1e-5)
    weights = hyper.weights[-1](z).view(5, 12, 16)
    # the goal stays among the inputs of the first layer
    first = silu(hidden.before[0](x))
    expected = head(silu(torch.bmm(first.unsqueeze(1), weights).squeeze(1) + hyper.bias))
    torch.testing.assert_close(actor(x), expected)


def test_goals_of_every_kind_are_found_among_the_features():
    layout = ObsLayout.from_shapes(
        [(2,), (1, 8, 8), (3,), (4, 2), (1, 9, 9)], goals=[True, False, False, True, True]
    )
    encoder = Encoder(layout, True)
    assert encoder.goal_columns == [0, 1, *range(5 + 128, 5 + 256), *range(5 + 256, 5 + 384)]


def test_a_conditioned_network_keeps_ml_agents_weights_whatever_the_options_say():
    layout = ObsLayout.from_shapes([(30,)], goals=[True])
    cfg = ModelConfig(weight_init=WeightInit.kaiming_normal, layer_norm=True, **HYPER)
    hyper = Actor(layout, TWO, cfg).net[0].hyper
    assert hyper.weights[-1].weight.abs().max() <= (16 * 12) ** -0.5
    assert hyper.weights[0].weight.std().item() == pytest.approx(30**-0.5, rel=0.15)
    assert [type(part) for part in hyper.weights][1] is nn.SiLU


@pytest.mark.parametrize("critic", CriticKind)
def test_goals_condition_actors_and_local_critics(critic):
    layout = ObsLayout.from_shapes([(3,), (2,)], goals=[False, True])
    cfg = ModelConfig(critic=critic, **HYPER)
    nets = make_actor(layout, TWO, 2, cfg), make_critic(layout, 2, cfg, TWO)
    found = [any(isinstance(part, HyperLinear) for part in net.modules()) for net in nets]
    assert found == [True, critic is CriticKind.local]
    plain = make_actor(ObsLayout.from_shapes([(3,), (2,)]), TWO, 2, cfg)
    assert not any(isinstance(part, HyperLinear) for part in plain.modules())


# --- what policies learn


def learned(probe, tmp_path, iterations, lr, **model):
    """Train on a probe; return the mean reward of the last batch's decisions."""
    ppo = {"lr": lr, "epochs": 8, "minibatch_size": 128}
    model = {"activation": Activation.silu, **model}
    options = {"factory": "sensor_probes:make", "teams": 128}
    _, batch, _ = learn(probe, tmp_path, iterations, model=model, ppo=ppo, rounds=2, **options)
    reward = batch["next", "reward"] + batch["next", "group_reward"]
    return reward.mean().item()


def test_the_colour_of_the_largest_entity_is_learned(tmp_path):
    """Once in six times nobody is there; whoever does not look earns nothing."""
    assert learned("Largest", tmp_path, 12, lr=3e-3) > 0.6


@pytest.mark.slow
@pytest.mark.parametrize("critic", [CriticKind.central, CriticKind.attention, CriticKind.poca])
def test_teams_learn_it_with_the_critics_of_teams(critic, tmp_path):
    """After it is known (six batches), advantages are noise: many more updates may unlearn it by chance."""
    assert learned("LargestTeam", tmp_path, 12, lr=1e-3, critic=critic) > 0.6


@pytest.mark.parametrize("kind", GoalKind)
def test_what_the_goal_asks_for_is_learned(kind, tmp_path):
    assert learned("Goal", tmp_path, 20, lr=5e-3, hidden=[16], goal_conditioning=kind) > 0.8


# --- whole runs with every kind of sensor


def everything(*lines):
    return compose_config([*RUN, *lines]).config


VARIANTS = {
    "central": [],
    "pooled": ["model.critic=mean"],
    "attention": ["model.critic=attention", "model.layer_norm=true"],
    "poca": ["model.critic=poca", "model.memory=gru", "model.memory_size=6"],
    "local, hyper, memory": ["model.critic=local", "model.goal_conditioning=hyper", "model.memory=lstm"],
    "members, hyper": ["model.share_parameters=false", "model.goal_conditioning=hyper"],
    "simple": ["model.image_encoder=simple", "model.weight_init=kaiming_normal"],
}


@pytest.mark.parametrize("name", VARIANTS)
def test_a_run_trains_exports_and_resumes(name, tmp_path):
    config = everything(*VARIANTS[name], "max_steps=256")
    outcome = train(config, tmp_path / "run")
    assert outcome.status == FINISHED
    policy = CheckpointPolicy(outcome.last_checkpoint, deterministic=True)
    env = make(0)
    env.reset()
    steps = env.get_steps("Probe?team=0")[0]
    played = policy.act("Probe?team=0", steps, env.spec).discrete

    files = list((tmp_path / "run" / "checkpoints").glob("final.onnx"))
    if "members" in name:
        assert not files
        return
    file = OnnxPolicy(files[0], deterministic=True)
    assert [shape for n, shape in sorted(file.inputs.items()) if n in ("obs_0", "obs_5")] == [
        ["batch", 4, 3],
        ["batch", 2, 5],
    ]
    assert np.array_equal(file.act("Probe?team=0", steps, env.spec).discrete, played)

    more = everything(*VARIANTS[name], "max_steps=512", "export_onnx=false")
    resumed = train(more, tmp_path / "run", resume_from=outcome.last_checkpoint)
    assert resumed.status == FINISHED and resumed.agent_steps == 512


def test_a_checkpoint_tells_its_goals_and_an_older_one_does_not(tmp_path):
    outcome = train(everything("export_onnx=false"), tmp_path / "run")
    state = checkpoint.load(outcome.last_checkpoint)
    layout = state["layout"]["Probe"]
    assert layout["goals"] == [False, False, True, False, True, True]

    env = make(0)
    check_layout("it", state["layout"], "Probe", env.spec)
    plain = [s._replace(observation_type=ObservationType.DEFAULT) for s in env.spec.observation_specs]
    other = env.spec._replace(observation_specs=plain)
    with pytest.raises(ConfigError, match=r"\[3\] \(goal\) .* \[3\] and"):
        check_layout("it", state["layout"], "Probe", other)
    older = {"Probe": {key: value for key, value in layout.items() if key != "goals"}}
    for spec in (env.spec, other):
        check_layout("it", older, "Probe", spec)


# --- through the protocol, and from a scene


def test_a_served_environment_is_the_same_and_trains(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{Path(__file__).parent}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert player_main(["build", "sensor_probes:make", str(tmp_path)]) == 0
    lines = ["env=unity", "env.name=Probe", f"env.file_name={tmp_path / 'make'}", *RUN[3:]]
    config = compose_config([*lines, "model.goal_conditioning=hyper", "env.timeout_s=60"]).config

    player = make_env_function(config.env, tmp_path / "players")(5)
    try:
        player.reset()
        served, own = player.behavior_specs["Probe?team=0"], make(5)
        own.reset()
        assert served.observation_specs == own.spec.observation_specs
        for theirs, ours in zip(player.get_steps("Probe?team=0")[0].obs, own.get_steps("")[0].obs):
            assert theirs.shape == ours.shape and theirs.any()
            # rows of nobody arrive as zeros
            assert theirs.ndim != 3 or (not theirs[0].any() and not ours[0].any())
    finally:
        player.close()

    outcome = train(config, tmp_path / "run")
    assert outcome.status == FINISHED
    assert (tmp_path / "run" / "checkpoints" / "final.onnx").is_file()


def test_scenes_declare_entities_and_goals():
    many = (DimensionProperty.VARIABLE_SIZE, DimensionProperty.NONE)
    spec = Behavior(
        "S?team=0",
        (Sensor("many", (5, 3), 1, many), Sensor("goal", (2,), observation_type=ObservationType.GOAL_SIGNAL)),
        continuous=1,
    ).spec()
    assert spec.observation_specs == [sensor("many", 5, 3), sensor("goal", 2, goal=True)]
