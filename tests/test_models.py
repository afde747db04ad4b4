"""Networks, distributions, normalisers."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical, Normal
from torchrl.envs import ExplorationType, set_exploration_type

from mappo_unity.config.schema import ModelConfig
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import Actor, make_actor
from mappo_unity.learning.networks.distributions import ActionDistribution, ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout, RunningNorm
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.learning.value_norm import ValueNorm


def test_hybrid_log_prob_and_entropy_are_the_sums_of_torchs_own():
    layout = ActionLayout(2, (3, 2))
    params = torch.randn(5, layout.num_params)
    dist = ActionDistribution(params, layout)
    action = dist.sample()
    normal = Normal(params[:, :2], params[:, 2:4].exp())
    branches = Categorical(logits=params[:, 4:7]), Categorical(logits=params[:, 7:9])
    log_prob = normal.log_prob(action[:, :2]).sum(-1)
    entropy = normal.entropy().sum(-1)
    for column, branch in enumerate(branches):
        log_prob = log_prob + branch.log_prob(action[:, 2 + column])
        entropy = entropy + branch.entropy()
    assert torch.allclose(dist.log_prob(action), log_prob, atol=1e-5)
    assert torch.allclose(dist.entropy(), entropy, atol=1e-5)


def test_masked_actions_are_never_drawn_and_frequencies_follow_the_probabilities():
    torch.manual_seed(0)
    layout = ActionLayout(0, (3,))
    logits = torch.log(torch.tensor([0.2, 0.5, 0.3])).expand(20_000, 3)
    mask = torch.tensor([True, False, True]).expand(20_000, 3)
    dist = ActionDistribution(logits, layout, mask)
    counts = torch.bincount(dist.sample().squeeze(-1), minlength=3) / 20_000
    assert counts[1] == 0
    assert counts[0] == pytest.approx(0.4, abs=0.015)
    assert dist.sample().dtype == torch.int64
    assert dist.entropy()[0] == pytest.approx(-(0.4 * math.log(0.4) + 0.6 * math.log(0.6)), abs=1e-5)
    assert dist.mode[0].item() == 2


def test_continuous_samples_have_the_mean_and_deviation_asked_for():
    torch.manual_seed(0)
    params = torch.tensor([1.0, -2.0, math.log(0.5), math.log(2.0)]).expand(20_000, 4)
    sample = ActionDistribution(params, ActionLayout(2, ())).sample()
    assert sample.mean(0).tolist() == pytest.approx([1.0, -2.0], abs=0.06)
    assert sample.std(0).tolist() == pytest.approx([0.5, 2.0], rel=0.03)


def test_running_norm_matches_the_statistics_of_all_rows():
    norm = RunningNorm(3)
    rows = torch.randn(1000, 3) * torch.tensor([1.0, 10.0, 0.1]) + torch.tensor([5.0, -3.0, 0.0])
    for part in rows.split([1, 99, 400, 500]):
        norm.update(part)
    assert torch.allclose(norm.mean, rows.mean(0), atol=1e-4)
    assert torch.allclose(norm.var, rows.var(0, unbiased=False), rtol=1e-3)
    assert norm(rows).std(0).tolist() == pytest.approx([1.0, 1.0, 1.0], rel=0.02)
    assert norm(rows * 1e6).abs().max() == 5.0


def test_value_norm_is_debiased_and_inverts():
    norm = ValueNorm(beta=0.9)
    returns = torch.randn(4000, 1) * 3 + 50
    norm.update(returns)
    mean, std = norm.statistics()
    assert float(mean) == pytest.approx(float(returns.mean()), rel=1e-5)
    assert float(std) == pytest.approx(float(returns.std(unbiased=False)), rel=1e-4)
    assert torch.allclose(norm.denormalize(norm.normalize(returns)), returns, atol=1e-3)
    assert ValueNorm(0.9, enabled=False).normalize(returns) is not None
    assert ValueNorm(0.9, enabled=False).statistics() == (torch.zeros(1), torch.ones(1))


def test_the_first_actions_are_near_the_middle_and_spread_by_init_log_std():
    actor = Actor(ObsLayout(4), ActionLayout(2, ()), ModelConfig(init_log_std=-0.5))
    params = actor(torch.randn(100, 4))
    assert params[:, :2].abs().max() < 0.2
    assert params[:, 2:].unique().item() == pytest.approx(-0.5)


@pytest.mark.parametrize(("start", "value"), [(-5.0, -5.0), (2.0, 2.0), (-7.3, -5.0), (2.7, 2.0), (0.3, 0.3)])
def test_deviations_learn_at_their_bounds_and_come_back_from_beyond(start, value):
    actor = Actor(ObsLayout(4), ActionLayout(2, ()), ModelConfig())
    with torch.no_grad():
        actor.log_std.fill_(start)
    log_std = actor(torch.randn(10, 4))[:, 2:]
    assert log_std.unique().item() == pytest.approx(value, abs=1e-7)
    log_std.sum().backward()
    assert actor.log_std.grad.tolist() == [10.0, 10.0]
    actor.project()
    assert actor.log_std.tolist() == pytest.approx([value, value], abs=1e-7)


@pytest.mark.parametrize("value", [-5.1, 2.1])
def test_initial_deviations_beyond_their_bounds_are_refused(value):
    with pytest.raises(ConfigError, match=f"model.init_log_std={value} .* must be from -5 to 2"):
        ModelConfig(init_log_std=value)


def test_actor_writes_action_and_log_prob():
    actor = make_actor(ObsLayout(4), ActionLayout(0, (3, 3)), 2, ModelConfig())
    mask = torch.ones(7, 2, 6, dtype=torch.bool)
    out = actor(TensorDict({"observation": torch.randn(7, 2, 4), "action_mask": mask}, [7, 2]))
    assert out["action"].shape == (7, 2, 2)
    assert out["action_log_prob"].shape == (7, 2)


@pytest.mark.parametrize(
    "layout",
    [ActionLayout(2, ()), ActionLayout(0, (3, 2)), ActionLayout(1, (2,)), ActionLayout(0, (2, 2), True)],
)
def test_draws_are_what_the_actor_writes_while_exploring(layout):
    torch.manual_seed(0)
    actor = make_actor(ObsLayout(3), layout, 2, ModelConfig(hidden=[8], share_parameters=False))
    entries = TensorDict({"observation": torch.randn(5, 2, 3)}, [5, 2])
    mask = [torch.arange(size) < torch.randint(1, size + 1, (5, 2, 1)) for size in layout.branches]
    entries["action_mask"] = torch.cat(mask, -1) if mask else torch.ones(5, 2, 0, dtype=torch.bool)
    torch.manual_seed(1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        out = actor(entries.copy())
    torch.manual_seed(1)
    action, log_prob, parts, memory = actor.draw(entries)
    assert parts is None and memory is None
    assert torch.equal(action, out["action"]) and action.dtype == out["action"].dtype
    assert torch.equal(log_prob, out["action_log_prob"]) and not log_prob.requires_grad
    policy = JointPolicy({"Fake": actor})
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        likely = policy(TensorDict({"Fake": entries.copy()}))["Fake", "action"]
        assert torch.equal(likely, actor(entries.copy())["action"])
