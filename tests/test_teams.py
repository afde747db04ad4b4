"""Sides, transforms, critics of teams, options by behavior."""

import pytest
import torch
from fakes import Record as R
from fakes import ScriptedEnv, behavior_spec
from mlagents_envs.base_env import ActionSpec
from torchrl.envs.utils import check_env_specs

from mappo_unity.config.per_behavior import behavior_config, check_behaviors
from mappo_unity.config.schema import Config, CriticKind, ModelConfig
from mappo_unity.envs.transforms import transformed
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.critics import CentralCritic, PooledCritic
from mappo_unity.learning.networks.distributions import ActionDistribution, ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.scenes import make_scene


def soccer(areas=2):
    return UnityEnv(lambda seed: make_scene("SoccerTwos", seed=seed, num_areas=areas))


def test_sides_are_stacked_and_actions_find_their_side():
    names = ("Soccer?team=1", "Soccer?team=0")
    script = [[R(0, obs=1, behavior=names[0]), R(1, obs=2, behavior=names[1])]] * 2
    base = ScriptedEnv(script, {name: behavior_spec() for name in names})
    env = transformed(UnityEnv(lambda seed: base))
    td = env.reset()
    assert td["Soccer", "observation"].flatten().tolist() == [1, 2]
    assert td["Soccer", "observation"].shape == (2, 1, 1, 1)
    assert ("Soccer", "obs_0") not in td.keys(True)
    td["Soccer", "action"] = torch.tensor([0.25, -0.5]).reshape(2, 1, 1, 1)
    env.step(td)
    assert [(name, a.item()) for name, a, _ in base.actions] == [(names[0], 0.25), (names[1], -0.5)]


def test_one_side_s_end_resets_no_scene_and_leaves_the_other_side_s_episode_alone():
    names = ("Soccer?team=1", "Soccer?team=0")
    ends = [R(0, ends="terminated", reward=5, behavior=names[0]), R(0, behavior=names[0])]
    asked = [R(0, behavior=names[0]), R(1, reward=1, behavior=names[1])]
    script = [
        asked,
        [*ends, asked[1]],
        asked,
        [*ends, R(1, ends="terminated", reward=1, behavior=names[1]), asked[1]],
    ]
    base = ScriptedEnv(script, {name: behavior_spec() for name in names})
    plain = UnityEnv(lambda seed: base)
    rows = transformed(plain).rollout(3, break_when_any_done=False)
    assert base.resets == 1
    assert rows["next", "Soccer", "done"].flatten(1).tolist() == [[True, False], [False, False], [True, True]]
    finished = plain.pop_episodes()
    assert [episode.length for episode in finished[names[0]]] == [1, 2]
    assert [(episode.length, episode.individual_return) for episode in finished[names[1]]] == [(3, 4.0)]


def test_soccer_s_shapes_through_the_transforms():
    env = transformed(soccer())
    check_env_specs(env, seed=0)
    td = env.rollout(3)
    assert td["SoccerTwos", "observation"].shape == (3, 2, 2, 2, 336)  # T S G A O
    assert td["SoccerTwos", "action"].shape == (3, 2, 2, 2, 3)
    assert td["next", "SoccerTwos", "group_reward"].shape == (3, 2, 2, 2, 1)


def test_two_sides_with_different_specs_under_one_name_are_refused():
    names = ("Soccer?team=1", "Soccer?team=0")
    script = [[R(0, behavior=names[0]), R(1, behavior=names[1])]]
    env = UnityEnv(lambda seed: ScriptedEnv(script, {names[0]: behavior_spec(1), names[1]: behavior_spec(2)}))
    with pytest.raises(
        ConfigError, match=r"share the policy 'Soccer' but differ: sensors \[\(1,\)\] and \[\(2,\)\]"
    ):
        transformed(env)


def team_inputs(present):
    flags = torch.tensor(present).reshape(1, -1, 1)
    return torch.randn(1, flags.shape[1], 3), flags, torch.zeros_like(flags)


@pytest.mark.parametrize("kind", [CriticKind.central, CriticKind.mean, CriticKind.attention])
def test_critics_ignore_who_is_not_there_and_see_who_is(kind):
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[16, 8], critic=kind, normalize_obs=False)
    build = CentralCritic if kind is CriticKind.central else PooledCritic
    critic = build(ObsLayout(3), 3, cfg)
    obs, present, departed = team_inputs([True, True, False])
    value = critic(obs, present, departed)
    assert value.shape == (1, 3, 1)
    unseen, seen = obs.clone(), obs.clone()
    unseen[:, 2] += 5.0
    seen[:, 1] += 5.0
    assert torch.equal(critic(unseen, present, departed), value)
    assert not torch.allclose(critic(seen, present, departed)[:, 0], value[:, 0])
    gone = torch.tensor([False, True, False]).reshape(1, 3, 1)
    assert not torch.allclose(critic(obs, present, gone), value)
    nobody = critic(obs, torch.zeros_like(present), departed)
    assert torch.isfinite(nobody).all()


def test_a_pooled_critic_does_not_care_in_which_order_team_mates_stand():
    cfg = ModelConfig(hidden=[16], critic=CriticKind.attention, normalize_obs=False)
    critic = PooledCritic(ObsLayout(3), 3, cfg)
    obs, present, departed = team_inputs([True, True, True])
    swapped = obs[:, [0, 2, 1]]
    assert torch.allclose(
        critic(obs, present, departed)[:, 0], critic(swapped, present, departed)[:, 0], atol=1e-5
    )


@pytest.mark.parametrize("shape", [(3, 40, 40), (40, 40, 3), (5, 12, 12)])
def test_images_are_encoded(shape):
    layout = ObsLayout.from_shapes([(4,), shape])
    encoder = Encoder(layout, True)
    assert layout.keys == ["observation", "obs_1"]
    assert encoder(torch.zeros(2, 3, 4), torch.zeros(2, 3, *shape)).shape == (2, 3, encoder.size)


def test_joint_branches_are_the_same_actions_under_one_categorical():
    layout = ActionLayout.from_spec(ActionSpec(0, (3, 2, 2)), joint=True)
    assert layout.categoricals == (12,)
    branches = torch.cartesian_prod(torch.arange(3), torch.arange(2), torch.arange(2))
    assert torch.equal(layout.to_categories(branches).squeeze(-1), torch.arange(12))
    assert torch.equal(layout.to_branches(torch.arange(12).unsqueeze(-1)), branches)
    logits = torch.randn(12)
    mask = torch.tensor([True, False, True, True, True, True, False])
    dist = ActionDistribution(logits.expand(5000, 12), layout, mask.expand(5000, 7))
    sample = dist.sample()
    assert (sample[:, 0] != 1).all() and (sample[:, 2] == 0).all()
    allowed = (branches[:, 0] != 1) & (branches[:, 2] == 0)
    expected = logits.masked_fill(~allowed, -torch.inf).log_softmax(0)
    found = ActionDistribution(logits.expand(12, 12), layout, mask.expand(12, 7)).log_prob(branches)
    assert torch.allclose(found[allowed], expected[allowed], atol=1e-5)


def test_options_of_one_behavior():
    cfg = Config(behaviors={"Goalie": {"ppo": {"lr": 1e-5}, "model": {"hidden": [7]}}})
    model, ppo, *_ = behavior_config(cfg, "Goalie")
    assert (model.hidden, ppo.lr, ppo.gamma) == ([7], 1e-5, cfg.ppo.gamma)
    assert behavior_config(cfg, "Striker") == (cfg.model, cfg.ppo, cfg.rewards, cfg.bc)
    check_behaviors(cfg, ["Goalie", "Striker"])


@pytest.mark.parametrize(
    ("behaviors", "message"),
    [
        ({"Golie": {}}, r"behaviors\.Golie: the environment has no behavior 'Golie'; it has Goalie, Striker"),
        ({"Goalie": {"pp": {}}}, "only the sections model, ppo, rewards, bc, init_from and train"),
        (
            {"Goalie": {"ppo": {"lrr": 1}}},
            r"behaviors\.Goalie\.ppo\.lrr: there is no such option; did you mean lr",
        ),
        ({"Goalie": {"ppo": {"lr": "fast"}}}, r"behaviors\.Goalie\.ppo.*fast"),
        ({"Goalie": {"ppo": {"gamma": 2}}}, "gamma=2.0 is out of range"),
        ({"Goalie": {"ppo": 3}}, "must hold options"),
        ({"Goalie": 3}, "must hold sections"),
    ],
)
def test_wrong_options_of_one_behavior(behaviors, message):
    with pytest.raises(ConfigError, match=message):
        check_behaviors(Config(behaviors=behaviors), ["Goalie", "Striker"])
