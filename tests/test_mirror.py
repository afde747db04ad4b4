"""Networks that mirror: the scenes' mirror images, the networks, what is exported, mistakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from mlagents_envs.base_env import ActionTuple
from onnx_fakes import data_of, inputs, make

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.schema import (
    CriticKind,
    DistributionKind,
    ImageKind,
    MemoryKind,
    MirrorConfig,
    ModelConfig,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import make_critic, with_traces
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.mirror import make_mirror
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.warm_start.actors import copy_network
from mappo_unity.policies.warm_start.onnx_network import read_network
from mappo_unity.policies.warm_start.sources import adopt_file_options
from mappo_unity.scenes.registry import make_scene

# 3 rays of 2 numbers in 2 frames, a pair of columns, a column that changes its sign
RAYS = {"rays": [0, 3, 2, 2], "swap": [12, 13, 1], "negate": [14]}
CONTINUOUS = {"swap_actions": [0, 1], "negate_actions": [2]}
LAYOUT = ActionLayout(3, (3, 2))


# --- the scenes


def reflect_walker(scene):
    """Stand both figures up, the second one as the first one looks in a mirror at x = 0."""
    scene.physics.stand(np.arange(2), np.array([0.7, -0.7]))
    scene.goal_speed[:] = 3.0
    scene.physics.target_position[:] = [[2.0, 0.3, 4.0], [-2.0, 0.3, 4.0]]
    scene.cube_position[:] = [[0.5, 1.0, 0.0], [-0.5, 1.0, 0.0]]
    scene._aim(np.arange(2))


def reflect_soccer(scene):
    """Make the second field what the first one looks like in a mirror at z = 0."""
    state = scene.scene_state()
    for part in ("position", "velocity"):
        values = state["physics"][part]
        values[:, :, 1] = values[:, :, 0] * np.array([[1], [-1]])
    state["physics"]["spin"][:] = state["physics"]["kick"][:] = 0
    state["yaw"][:, 1] = np.pi - state["yaw"][:, 0]
    scene.load_scene_state(state)


def reflect_dungeon(scene):
    """Make the second room, portal and all, what the first one looks like in a mirror at x = 0."""
    state = scene.scene_state()
    room, sides = state["room"], np.array([-1, 1, 1])
    room["position"][3:] = room["position"][:3] * sides
    room["yaw"][3:] = -room["yaw"][:3]
    room["thing"][1] = room["thing"][0] * sides
    room["thing_yaw"][1] = -room["thing_yaw"][0]
    room["dragon_speed"][1] = room["dragon_speed"][0]
    room["_dragon_way"][1] = room["_dragon_way"][0] * [-1, 1]
    scene.load_scene_state(state)


SIDES = "mirror.branches=[0,1,2,0,2,1,0,2,1]"
SOCCER = ["env=SoccerTwos", "model.mirror.rays=[0,11,8,3,264,3,8,3]", f"model.{SIDES}"]
WALKER = ["env=Walker"]
DUNGEON = ["env=DungeonEscape"]
GOALIE = [
    "env=StrikersVsGoalie",
    "behaviors.Striker.model.mirror.rays=[0,11,7,3,231,3,7,3]",
    f"behaviors.Striker.model.{SIDES}",
    "behaviors.Goalie.model.mirror.rays=[0,41,6,3]",
    f"behaviors.Goalie.model.{SIDES}",
]


@pytest.mark.parametrize(
    "lines, reflect",
    [
        (WALKER, reflect_walker),
        (SOCCER, reflect_soccer),
        (GOALIE, reflect_soccer),
        (DUNGEON, reflect_dungeon),
    ],
)
def test_the_mirror_image_of_a_scene_plays_as_its_mirror_image(lines, reflect):
    """What agents see in two areas, one the other's image, under actions that are each other's image."""
    config = compose_config(lines).config
    name = config.env.name
    env = make_scene(name, num_areas=2, seed=1)
    env.reset()
    reflect(env)

    rng = np.random.default_rng(0)
    for decision in range(10):
        for behavior, spec in env.behavior_specs.items():
            steps, ended = env.get_steps(behavior)
            agents = len(steps) // 2
            layout = ActionLayout.from_spec(spec.action_spec)
            model = behavior_config(config, behavior.partition("?")[0]).model
            mirror = make_mirror(model.mirror, ObsLayout.from_specs(spec.observation_specs), layout)

            obs = torch.from_numpy(np.concatenate(steps.obs, 1))
            if decision >= 4:  # stacked frames hold what was before
                seen = mirror.both(obs[:agents])[0][1]
                assert torch.allclose(seen, obs[agents:], atol=1e-4), (behavior, decision)
            assert not len(ended)

            action = ActionTuple()
            if layout.continuous:
                drawn = rng.uniform(-0.3, 0.3, (agents, layout.continuous))
                image = mirror.image(torch.from_numpy(drawn)).numpy()
                action.add_continuous(np.concatenate([drawn, image]).astype(np.float32))
            if layout.branches:
                logits = rng.random((agents, layout.num_logits))
                image = mirror.image(torch.from_numpy(logits)).numpy()
                sizes = np.cumsum(layout.branches)[:-1]
                both = np.split(np.concatenate([logits, image]), sizes, 1)
                action.add_discrete(np.stack([part.argmax(1) for part in both], 1).astype(np.int32))
            env.set_actions(behavior, action)
        env.step()
    env.close()


# --- the networks


def model(critic=CriticKind.central, **more):
    return ModelConfig(hidden=[16], critic=critic, **more)


@pytest.mark.parametrize("kind", DistributionKind)
def test_an_actor_does_the_mirror_image_of_what_it_does(kind):
    mirror = MirrorConfig(**RAYS, **CONTINUOUS, branches=[0, 2, 1, 1, 0])
    actor = make([[12], [3]], 3, [3, 2], mirror=mirror, action_distribution=kind)[0].module
    with torch.no_grad():
        if kind is DistributionKind.gaussian:
            actor.log_std.copy_(torch.tensor([0.1, 0.5, -0.3]))
    obs = torch.randn(7, 15)

    image = obs.clone()
    for ray in (2, 8):  # the second ray of a frame and the third
        image[:, ray : ray + 4] = obs[:, [ray + 2, ray + 3, ray, ray + 1]]
    image[:, 12:14], image[:, 14] = obs[:, [13, 12]], -obs[:, 14]
    found, other = actor(obs), actor(image)

    assert torch.allclose(other[:, :3], found[:, [1, 0, 2]] * torch.tensor([1.0, 1, -1]), atol=1e-6)
    assert torch.allclose(other[:, 3:6], found[:, [4, 3, 5]], atol=1e-6)  # deviations
    assert torch.allclose(other[:, 6:], found[:, [6, 8, 7, 10, 9]], atol=1e-5)
    assert found[:, 6:].std(0).min() > 1e-3 and (found - other).abs().max() > 1e-2  # not by being constant


@pytest.mark.parametrize(
    "critic", [CriticKind.local, CriticKind.central, CriticKind.mean, CriticKind.attention]
)
def test_a_critic_values_a_situation_as_its_mirror_image(critic):
    cfg = model(critic, mirror=MirrorConfig(**RAYS))
    net = make_critic(ObsLayout(15), 2, cfg, LAYOUT, streams=2)
    torch.nn.init.normal_(net.module.head.weight)
    obs, present = torch.randn(5, 2, 15), torch.rand(5, 2, 1) < 0.8
    flags = [] if critic is CriticKind.local else [present, torch.zeros_like(present)]

    image = net.module.mirror.both(obs)[0][1]
    found, other = net.module(obs, *flags), net.module(image, *flags)
    assert found.shape == (5, 2, 2) and torch.allclose(found, other, atol=1e-5)
    assert found.std() > 0.1

    half = obs.clone()
    half[:, 1] = image[:, 1]  # of one member alone is another situation
    apart = (net.module(half, *flags) - found).abs().max()
    assert apart < 1e-5 if critic is CriticKind.local else apart > 1e-3


TRACED = {"memory": MemoryKind.traces, "memory_traces": [0.5, 0.9], "memory_traced": [1, 1, 12, 3]}


def walked(traces, obs):
    """Return the traces ``[..., M]`` behind each of the decisions ``[T, ..., O]`` of an episode."""
    rows = [torch.zeros(*obs.shape[1:-1], traces.size)]
    for seen in obs:
        rows.append(traces.after(rows[-1], seen))
    return rows[1:]


@pytest.mark.parametrize("normalize", [False, True])
def test_who_remembers_in_the_mirror_has_the_image_of_its_memory(normalize):
    """An episode and its mirror image: what traces keep of them, and what is done at their ends."""
    mirror = MirrorConfig(**RAYS, **CONTINUOUS, branches=[0, 2, 1, 1, 0])
    net = make([[12], [3]], 3, [3, 2], mirror=mirror, normalize_obs=normalize, **TRACED)[0].module
    sides, traces = net.actor.mirror, net.traces
    episode = torch.randn(6, 7, 15)
    image = sides.both(episode, torch.zeros(6, 7, traces.size))[0][1]

    own, others = walked(traces, episode), walked(traces, image)
    for seen, after, other in zip(episode, own, others):
        assert torch.allclose(sides.both(seen, after)[1][1], other, atol=1e-6)
    assert not torch.allclose(own[-1], others[-1], atol=0.1)

    found, after = net(episode[-1], own[-2])
    other, image_after = net(image[-1], others[-2])
    assert torch.allclose(after, own[-1]) and torch.allclose(image_after, others[-1])
    assert torch.allclose(other[:, 6:], found[:, [6, 8, 7, 10, 9]], atol=1e-5)
    assert torch.allclose(other[:, :3], found[:, [1, 0, 2]] * torch.tensor([1.0, 1, -1]), atol=1e-5)
    forgotten, _ = net(episode[-1], torch.zeros_like(own[-2]))
    assert (forgotten - found).abs().max() > 1e-4


@pytest.mark.parametrize("critic", [CriticKind.local, CriticKind.central, CriticKind.mean])
def test_a_critic_values_what_it_remembers_as_its_mirror_image(critic):
    cfg = model(critic, mirror=MirrorConfig(**RAYS), critic_traces=[0.8], critic_traced=[12, 3])
    net = make_critic(ObsLayout(15), 2, cfg, LAYOUT).module
    torch.nn.init.normal_(net.head.weight)
    obs, traces, present = torch.randn(5, 2, 15), torch.randn(5, 2, 4), torch.rand(5, 2, 1) < 0.8
    flags = [] if critic is CriticKind.local else [present, torch.zeros_like(present)]

    seen, kept = (both[1] for both in net.mirror.both(obs, traces))
    assert torch.equal(kept, traces[..., [1, 0, 2, 3]] * torch.tensor([1.0, 1, -1, 1]))
    found = net(obs, traces, *flags)
    assert torch.allclose(found, net(seen, kept, *flags), atol=1e-5)
    assert (found - net(seen, traces, *flags)).abs().max() > 1e-3


def test_without_a_mirror_nothing_is_different():
    assert make_mirror(MirrorConfig(), ObsLayout(4), LAYOUT) is None
    names = make_critic(ObsLayout(4), 1, ModelConfig(), LAYOUT).state_dict()
    assert not any("mirror" in name or "critic" in name for name in names)


# --- files


@pytest.mark.parametrize("kind", DistributionKind)
@pytest.mark.parametrize("layer_norm", [False, True])
def test_an_onnx_file_plays_as_its_network_and_gives_it_back(tmp_path, kind, layer_norm):
    mirror = MirrorConfig(**RAYS, **CONTINUOUS, branches=[0, 2, 1, 1, 0])
    options = {"mirror": mirror, "action_distribution": kind, "layer_norm": layer_norm}
    sensors = [[12], [3]]
    scale = 20 if kind is DistributionKind.tanh_normal else 200
    actor, sample = make(sensors, 3, [3, 2], head_scale=scale, **options), inputs(sensors, [3, 2])
    data = data_of(actor, sensors)
    assert compare(data, actor, sensors, sample) <= 1e-5

    # a layer that is used twice has its weights once
    plain = data_of(make(sensors, 3, [3, 2], **(options | {"mirror": MirrorConfig()})), sensors)
    assert len(data) < 1.5 * len(plain)

    path = tmp_path / "policy.onnx"
    path.write_bytes(data)
    network = read_network(path)
    assert network.options["mirror"] == {
        "use": True,
        "rays": [0, 3, 2, 2],
        "swap": [12, 13, 1],
        "negate": [14],
        "flip_images": False,
        "swap_actions": [0, 1],
        "negate_actions": [2],
        "branches": [0, 2, 1, 1, 0],
        "handed": False,
    }
    other = make(sensors, 3, [3, 2], **options)
    rows, error = copy_network(network, other, sensors)
    assert not any(row.reason for row in rows) and error <= 1e-5


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("sensors", [[[12], [3]], [[15], [3, 22, 20]]])
def test_a_file_with_a_memory_plays_as_its_network_and_gives_it_back(tmp_path, sensors, normalize):
    flips = len(sensors[1]) == 3
    mirror = MirrorConfig(**RAYS, flip_images=flips, branches=[0, 2, 1])
    options = {"mirror": mirror, "normalize_obs": normalize, **TRACED}
    actor, sample = make(sensors, 0, [3], **options), inputs(sensors, [3])
    sample |= {keys.MEMORY: torch.randn(40, actor.memory_size)}
    data = data_of(actor, sensors)
    assert compare(data, actor, sensors, sample) <= 1e-5

    path = tmp_path / "policy.onnx"
    path.write_bytes(data)
    network = read_network(path)
    assert network.options["memory"] == "traces" and network.options["mirror"]["swap"] == [12, 13, 1]
    rows, error = copy_network(network, make(sensors, 0, [3], **options), sensors)
    assert not any(row.reason for row in rows) and error <= 1e-5


# --- networks that prefer a side


def handed(net):
    """Return a network whose first layer prefers a side as it would after some learning."""
    sides = [value for name, value in net.named_parameters() if name.endswith("side")]
    assert len(sides) == 1 and not sides[0].any()
    torch.nn.init.normal_(sides[0])
    return net


def test_an_actor_prefers_a_side_where_both_look_alike():
    mirror = MirrorConfig(**RAYS, branches=[0, 2, 1, 1, 0], handed=True)
    actor = make([[12], [3]], 0, [3, 2], mirror=mirror)[0].module
    alike = torch.zeros(1, 15)
    before = actor(alike)
    assert torch.allclose(before[0, 1], before[0, 2]) and torch.allclose(before[0, 3], before[0, 4])

    handed(actor)
    still, obs = actor(alike)[0], torch.randn(7, 15)
    assert (still[1] - still[2]).abs() > 1e-3 and (still[3] - still[4]).abs() > 1e-3
    image = actor.mirror.both(obs)[0][1]
    assert (actor(obs) - actor(image)[:, [0, 2, 1, 4, 3]]).abs().max() > 1e-2


@pytest.mark.parametrize("critic", [CriticKind.local, CriticKind.central, CriticKind.mean])
def test_a_critic_may_value_a_situation_and_its_mirror_image_apart(critic):
    obs, present = torch.randn(5, 2, 15), torch.ones(5, 2, 1, dtype=torch.bool)
    flags = [] if critic is CriticKind.local else [present, ~present]
    cfg = model(critic, mirror=MirrorConfig(**RAYS, handed=True), critic_traces=[0.8], critic_traced=[12, 3])
    net = make_critic(ObsLayout(15), 2, cfg, LAYOUT).module
    torch.nn.init.normal_(net.head.weight)
    seen = obs, torch.randn(5, 2, 4)
    image = [both[1] for both in net.mirror.both(*seen)]

    assert torch.allclose(net(*seen, *flags), net(*image, *flags), atol=1e-5)
    handed(net)
    assert (net(*seen, *flags) - net(*image, *flags)).abs().max() > 1e-2


@pytest.mark.parametrize("options", [{}, {"layer_norm": True, "normalize_obs": True}, TRACED])
@pytest.mark.parametrize("sensors", [[[12], [3]], [[15], [3, 22, 20]], [[3, 22, 20]]])
def test_a_file_of_one_that_prefers_a_side_gives_it_back(tmp_path, sensors, options):
    flips, vectors = len(sensors[-1]) == 3, len(sensors[0]) == 1
    if options is TRACED and not vectors:
        options = {}
    mirror = MirrorConfig(
        **(RAYS if vectors else {}), flip_images=flips, **CONTINUOUS, branches=[0, 2, 1], handed=True
    )
    options = {"mirror": mirror, **options}
    actor, sample = make(sensors, 3, [3], head_scale=200, **options), inputs(sensors, [3])
    handed(actor)
    if actor.memory_size:
        sample |= {keys.MEMORY: torch.randn(40, actor.memory_size)}
    data = data_of(actor, sensors)
    assert compare(data, actor, sensors, sample) <= 1e-5

    path = tmp_path / "policy.onnx"
    path.write_bytes(data)
    network, other = read_network(path), make(sensors, 3, [3], **options)
    assert network.options["mirror"]["handed"] is True
    rows, error = copy_network(network, other, sensors)
    assert not any(row.reason for row in rows) and error <= 1e-5
    names = [name for name in other.state_dict() if name.endswith("side")]
    assert torch.allclose(other.state_dict()[names[0]], actor.state_dict()[names[0]], atol=1e-6)


IMAGES = {
    "grid": ([[4], [3, 6, 7]], {}),
    "image alone, channels last": ([[22, 20, 3]], {}),
    "several, layer norms": ([[3], [3, 22, 20], [1], [24, 20, 1]], {"layer_norm": True}),
    "residual": ([[16, 18, 2], [4]], {"image_encoder": ImageKind.resnet}),
}


@pytest.mark.parametrize("name", IMAGES)
def test_images_have_a_mirror_image(name, tmp_path):
    sensors, options = IMAGES[name]
    negate = [1] if len(sensors) > 1 else []
    cfg = options | {"mirror": MirrorConfig(negate=negate, flip_images=True, branches=[0, 2, 1])}
    actor, sample = make(sensors, 1, [3], **cfg), inputs(sensors, [3])
    net = actor[0].module
    obs = [sample[key] for key in actor.obs_keys]
    image = [both[1] for both in net.mirror.both(*obs)]

    for seen, found in zip(obs, image):
        if seen.ndim == 4:
            columns = 2 if seen.shape[-1] <= 3 else 3  # channels last, or first
            assert torch.equal(found, seen.flip(columns)) and not torch.equal(found, seen)
    found, other = net(*obs), net(*image)
    assert torch.allclose(other, found[:, [0, 1, 2, 4, 3]], atol=1e-4)
    assert found[:, 2:].std(0).min() > 1e-2 and (found - other).abs().max() > 1e-2

    data = data_of(actor, sensors)
    assert compare(data, actor, sensors, sample) <= 1e-5
    path = tmp_path / "policy.onnx"
    path.write_bytes(data)
    rows, error = copy_network(read_network(path), make(sensors, 1, [3], **cfg), sensors)
    assert not any(row.reason for row in rows) and error <= 1e-5


def test_a_team_that_sees_images_learns_with_a_mirror(tmp_path):
    lines = ["env=CooperativePushBlock", "max_steps=300", "collect.batch_size=240", "log.loggers=[]"]
    mirror = ["model.mirror.flip_images=true", "model.mirror.branches=[0,1,2,4,3,6,5]", "log.progress=false"]
    assert train_main([*lines, *mirror, "model.mirror.negate=[0]", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    assert (tmp_path / "run" / "checkpoints" / "final.onnx").exists()


TINY = ["env=Basic", "max_steps=512", "collect.batch_size=128", "log.loggers=[]", "log.progress=false"]
BASIC = "model.mirror.swap=[0,19,1,1,18,1,2,17,1]"


def test_a_run_trains_resumes_and_is_what_others_begin_with(tmp_path, capsys):
    run = tmp_path / "run"
    lines = [*TINY, BASIC, "model.mirror.branches=[0,2,1]", f"hydra.run.dir={run}"]
    assert train_main(lines) == 0
    assert train_main([f"resume={run}", "max_steps=1024"]) == 0
    capsys.readouterr()
    assert train_main([f"resume={run}", "max_steps=2048", "model.mirror.branches=[0,1,2]"]) == 2
    assert "model.mirror" in capsys.readouterr().err

    # the file has a mirror, which a run that begins with it takes over
    begun = tmp_path / "begun"
    assert train_main([*TINY, f"init_from={run}/checkpoints/final.onnx", f"hydra.run.dir={begun}"]) == 0
    state = torch.load(sorted((begun / "checkpoints").glob("*.pt"))[-1], weights_only=False)
    assert state["model"]["Basic"]["mirror"]["branches"] == [0, 2, 1]
    capsys.readouterr()
    lines = [*TINY, f"init_from={run}/checkpoints/final.onnx", "model.mirror.negate=[3]"]
    assert train_main([*lines, f"hydra.run.dir={tmp_path / 'no'}"]) == 2
    said = capsys.readouterr().err
    assert "model.mirror=(negate=[3]) contradicts" in said
    assert "has mirror=(swap=[0, 19, 1, 1, 18, 1, 2, 17, ...] branches=[0, 2, 1]): leave" in said


@pytest.mark.parametrize("more", [["model.memory=traces"], ["model.critic_traces=[0.9]"]])
def test_a_run_that_remembers_trains_resumes_and_is_what_others_begin_with(tmp_path, capsys, more):
    run, begun = tmp_path / "run", tmp_path / "begun"
    lines = [*TINY, *more, BASIC, "model.mirror.branches=[0,2,1]", f"hydra.run.dir={run}"]
    assert train_main(lines) == 0
    assert train_main([f"resume={run}", "max_steps=1024"]) == 0
    start = f"init_from={run}/checkpoints/final.onnx"
    assert train_main([*TINY, start, f"hydra.run.dir={begun}"]) == 0
    capsys.readouterr()


def test_what_a_preset_describes_can_be_left_aside():
    config = compose_config([*WALKER, "model.mirror.use=false", "model.memory=lstm"]).config
    assert config.model.mirror.swap and not config.model.mirror.is_used
    assert make_mirror(config.model.mirror, ObsLayout(243), ActionLayout(39, ())) is None


def test_what_a_preset_says_of_a_behavior_gives_way_to_its_file(tmp_path):
    """A user's options contradict a file, a preset's do not; which are whose, the command line tells."""
    plain, mirrored = str(tmp_path / "plain.onnx"), str(tmp_path / "mirrored.onnx")
    mirror = {"rays": [0, 3, 2, 1], "branches": [0, 2, 1]}
    Path(plain).write_bytes(data_of(make([[6]], 0, [3]), [[6]]))
    Path(mirrored).write_bytes(data_of(make([[6]], 0, [3], mirror=MirrorConfig(**mirror)), [[6]]))
    given = "behaviors.Goalie.model.mirror.rays=[0,3,2,1]"

    def adopted(*lines, **options):
        behaviors = {"Goalie": {"model": {"mirror": mirror}, **options}}
        config = compose_config(["env=StrikersVsGoalie", *lines]).config
        config = adopt_file_options(replace(config, behaviors=behaviors), list(lines))
        return behavior_config(config, "Goalie").model

    assert not adopted(init_from=plain).mirror.is_used
    assert not adopted(f"init_from={plain}").mirror.is_used
    assert adopted(f"init_from={plain}", init_from=None).mirror == MirrorConfig(**mirror)
    assert adopted(
        f"init_from={mirrored}", given, "behaviors.Goalie.model.mirror.branches=[0,2,1]"
    ).mirror.rays
    assert not adopted(f"init_from={plain}", "model.mirror.use=false").mirror.is_used
    assert adopted(f"init_from={mirrored}", "recipe=mappo_paper").mirror.is_used

    for lines, options in (([given], {"init_from": plain}), ([f"init_from={plain}", given], {})):
        with pytest.raises(
            ConfigError, match=r"behaviors.Goalie.model.mirror=\(rays=\[0, 3, 2, 1\] .* contra"
        ):
            adopted(*lines, **options)
    with pytest.raises(ConfigError, match=r"model.mirror=none contradicts .*mirrored.onnx"):
        adopted(f"init_from={mirrored}", "model.mirror.use=false")
    for mistake in ("mirror=5", "mirror.ray=[0]"):
        lines = [f"init_from={plain}", f"behaviors.Goalie.model.{mistake}"]
        config = compose_config(["env=StrikersVsGoalie", *lines]).config
        with pytest.raises(ConfigError, match=r"^behaviors.Goalie.model.mirror=.* options among use, rays"):
            adopt_file_options(config, lines)


@pytest.mark.parametrize("option", ["memory=lstm", "memory=gru", "critic=poca", "flatten_branches=true"])
def test_a_presets_mirror_gives_way_to_what_has_no_mirror_image(option):
    lines = ["env=StrikersVsGoalie", f"model.{option}"]
    found = compose_config(lines).config
    assert all(not behavior_config(found, name).model.mirror.is_used for name in found.behaviors)
    kept = compose_config(["env=StrikersVsGoalie", "model.memory=traces"]).config
    assert all(behavior_config(kept, name).model.mirror.is_used for name in kept.behaviors)

    for given in ("model.mirror.use=true", "behaviors.Goalie.model.mirror.rays=[0,41,6,3]"):
        config = compose_config([*lines, given]).config
        with pytest.raises(ConfigError, match=r"needs model\..* model.mirror.use=false does without"):
            behavior_config(config, "Goalie")


def test_a_preferred_side_gives_way_to_weights_that_goals_make(tmp_path):
    file = tmp_path / "options.yaml"
    file.write_text("env: {name: Walker}\nmodel: {mirror: {use: true, handed: true}}\n")
    lines = ["model.goal_conditioning=hyper"]
    kept = compose_config([], file=file).config.model.mirror
    found = compose_config(lines, file=file).config.model.mirror
    assert kept.is_used and kept.handed and found.is_used and not found.handed

    with pytest.raises(ConfigError, match="handed=true needs model.goal_conditioning=none, not hyper"):
        compose_config([*lines, "model.mirror.handed=true"], file=file)


def test_a_file_that_asks_for_both_is_refused(tmp_path):
    file = tmp_path / "options.yaml"
    file.write_text("env: {name: Walker}\nmodel: {memory: gru, mirror: {use: true}}\n")
    with pytest.raises(ConfigError, match="not gru: what that looks like in a mirror is not known"):
        compose_config([], file=file)
    assert not compose_config(["model.memory=lstm"], file=file).config.model.mirror.is_used


# --- mistakes


@pytest.mark.parametrize(
    "options, message",
    [
        ({"rays": [0, 3, 2]}, "rays=[0, 3, 2] holds 3 numbers; it takes 4 for each entry"),
        ({"negate": [-1]}, "negate=[-1] must hold numbers from 0 on"),
        ({"rays": [0, 4, 2, 1]}, "has a sensor of 4 rays; Unity's have one ahead"),
        (
            {"rays": [0, 5, 4, 1]},
            "rays=[0, 5, 4, 1] reaches to number 19; there are 15 columns",
        ),
        ({"swap": [0, 15, 1]}, "swap=[0, 15, 1] reaches to number 15; there are 15 columns"),
        ({"rays": [0, 3, 2, 1], "swap": [5, 6, 1]}, "name column 5 twice: it changes places once"),
        (
            {"swap": [3, 4, 1], "negate": [4]},
            "holds one of 3 and 4, which change places",
        ),
        ({"negate": [15]}, "negate=[15] reaches to number 15; there are 15 columns"),
        ({"swap_actions": [0, 3]}, "reaches to number 3; there are 3 continuous actions"),
        ({"swap_actions": [0, 1, 1, 2]}, "swap_actions=[0, 1, 1, 2] names an action twice"),
        ({"negate_actions": [9]}, "negate_actions=[9] reaches to number 9; there are 3 continuous actions"),
        ({"branches": [0, 2, 1]}, "holds 3 numbers; the branches have [3, 2] actions"),
        ({"branches": [1, 2, 0, 0, 1]}, "[1, 2, 0] is no mirror image of a branch of 3 actions"),
        ({"branches": [0, 1, 2, 0, 3]}, "[0, 3] is no mirror image of a branch of 2 actions"),
    ],
)
def test_what_is_no_mirror_image_is_refused(options, message):
    with pytest.raises(ConfigError) as error:
        make_mirror(MirrorConfig(**options), ObsLayout(15), LAYOUT)
    assert message in str(error.value) and str(error.value).startswith("model.mirror")


def test_traces_of_one_of_two_that_change_places_are_refused():
    obs = with_traces(ObsLayout(15), [0.9], [12, 14])
    with pytest.raises(ConfigError, match="columns 12 and 13 change places, of which traces keep 12 alone"):
        make_mirror(MirrorConfig(**RAYS), obs, LAYOUT)


@pytest.mark.parametrize(
    "lines, message",
    [
        (["env=Basic", "model.mirror.swap=[0,20,1]"], "there are 20 columns, counted from 0 (Basic)"),
        (
            ["env=GridFoodCollector", "model.mirror.branches=[1,0]"],
            "needs model.mirror.flip_images=true, since",
        ),
        (
            ["env=Basic", BASIC, "model.mirror.flip_images=true"],
            "flip_images=true has no effect: there are no images",
        ),
        (
            ["env=Basic", BASIC, "model.memory=lstm"],
            "model.mirror needs model.memory=none or traces, not lstm",
        ),
        (
            ["env=Basic", BASIC, "model.critic_traces=[0.9]", "model.critic_traced=[0,3]"],
            "columns 0 and 19 change places, of which traces keep 0 alone: name both in",
        ),
        (
            [*WALKER, "model.mirror.use=true", "model.memory=gru"],
            "not known; model.mirror.use=false does without",
        ),
        (["env=Basic", BASIC, "model.critic=poca"], "not poca: its baseline sees actions"),
        ([*SOCCER, "model.flatten_branches=true"], "needs model.flatten_branches=false, not true"),
        (
            ["env=Basic", "model.mirror.handed=true"],
            "model.mirror.handed=true has no effect: no mirror image is described (Basic)",
        ),
        (
            ["env=Basic", BASIC, "model.mirror.handed=true", "model.goal_conditioning=hyper"],
            "model.mirror.handed=true needs model.goal_conditioning=none, not hyper",
        ),
    ],
)
def test_what_cannot_be_mirrored_ends_with_a_line(lines, message, tmp_path, capsys):
    assert train_main([*lines, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    assert message in capsys.readouterr().err
