"""The critic of MA-POCA: what value and baselines depend on, and their numbers."""

import math

import pytest
import torch
from torch import nn

from mappo_unity.config.schema import Activation, ModelConfig
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.networks.poca import PocaCritic, flat_actions

CONTINUOUS = ActionLayout(2, ())
DISCRETE = ActionLayout(0, (3, 2))
HYBRID = ActionLayout(1, (3,))
VECTOR = ObsLayout(3)
LAYOUTS = [CONTINUOUS, DISCRETE, HYBRID, ActionLayout(0, (3, 2), joint=True)]


def critic_of(layout=HYBRID, team_size=4, obs=VECTOR, **options):
    torch.manual_seed(0)
    options = {"hidden": [16, 8], "activation": Activation.silu, "normalize_obs": False} | options
    critic = PocaCritic(obs, layout, team_size, ModelConfig(**options))

    # the initial weights are small on purpose: larger ones show what depends on what
    for part in critic.modules():
        if isinstance(part, nn.Linear):
            nn.init.orthogonal_(part.weight, 1.5)
            nn.init.normal_(part.bias, std=0.1)
    return critic


def actions_of(layout, *dims):
    continuous = torch.randn(*dims, layout.continuous)
    branches = [torch.randint(size, dims) for size in layout.branches]
    if not layout.continuous:
        return torch.stack(branches, -1)
    return torch.cat([continuous, *[branch.unsqueeze(-1).float() for branch in branches]], -1)


def team(layout=HYBRID, dims=(5,), team_size=4):
    obs = torch.randn(*dims, team_size, 3)
    present = torch.ones(*dims, team_size, 1, dtype=torch.bool)
    return obs, present, torch.zeros_like(present), actions_of(layout, *dims, team_size)


def by_hand(critic, entities):
    """The features of one team from its entities, each a vector, one head and one score at a time."""
    width = critic.attention.width
    if entities:

        def normed(x):
            return (x - x.mean()) / torch.sqrt(((x - x.mean()) ** 2).mean() + 1e-5)

        rows = [normed(entity) for entity in entities]
        size = width // 4
        outs = []
        for row in rows:
            parts = []
            for head in range(4):
                part = slice(head * size, (head + 1) * size)
                scores = [
                    (critic.attention.query(row)[part] * critic.attention.key(other)[part]).sum()
                    / math.sqrt(width)
                    for other in rows
                ]
                weights = torch.stack(scores).softmax(0)
                parts.append(
                    sum(w * critic.attention.content(other)[part] for w, other in zip(weights, rows))
                )
            outs.append(normed(critic.attention.out(torch.cat(parts)) + row))
        pooled = sum(outs) / len(outs)
    else:
        pooled = torch.zeros(width)

    count = torch.tensor([2.0 * len(entities) / critic.team_size - 1.0])
    return critic.head(torch.cat([critic.trunk(pooled), count]))


def one_hots(action, layout):
    values = action.tolist()
    out = values[: layout.continuous]
    for size, index in zip(layout.branches, values[layout.continuous :]):
        out += [1.0 if k == int(index) else 0.0 for k in range(size)]
    return torch.tensor(out)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_numbers_are_those_of_a_loop_over_teams_and_members(layout):
    critic = critic_of(layout)
    obs, present, departed, action = team(layout, dims=(6,))
    present[1, 2:] = False
    departed[2, 0] = True
    present[3] = False
    present[4, :3] = False
    value = critic.value(obs, present, departed)
    baseline = critic.baseline(obs, present, departed, action)

    for row in range(6):
        there = [m for m in range(4) if present[row, m] and not departed[row, m]]
        expected = by_hand(critic, [critic.observed(obs[row, m]) for m in there])
        assert torch.allclose(value[row], expected.expand(4, 1), atol=1e-5)

        for judged in there:
            entities = [
                critic.observed(obs[row, m])
                if m == judged
                else critic.acted(torch.cat([obs[row, m], one_hots(action[row, m], layout)]))
                for m in there
            ]
            assert torch.allclose(baseline[row, judged], by_hand(critic, entities), atol=1e-5)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_value_beside_baselines_is_the_value_alone_with_its_gradients(layout):
    critic, entries = critic_of(layout), team(layout)
    entries[2][1, 2] = True  # one has departed
    weights = [weight for name, weight in critic.named_parameters() if not name.startswith("acted")]

    value, _ = critic.value_and_baseline(*entries)
    alone = critic.value(*entries[:-1])
    torch.testing.assert_close(value, alone)
    torch.testing.assert_close(
        torch.autograd.grad((value**2).sum(), weights), torch.autograd.grad((alone**2).sum(), weights)
    )


def test_a_team_of_one_and_of_nobody_have_finite_values_and_gradients():
    critic = critic_of(team_size=1)
    obs, present, departed, action = team(team_size=1)
    present[2:] = False
    out = critic.value(obs, present, departed) + critic.baseline(obs, present, departed, action)
    assert out.isfinite().all()
    out.sum().backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in critic.parameters())


def test_the_order_of_members_changes_no_value_and_carries_the_baselines_along():
    critic = critic_of()
    obs, present, departed, action = team()
    present[:, 3] = False
    order = torch.tensor([2, 3, 0, 1])
    moved = [x[:, order] for x in (obs, present, departed, action)]
    assert torch.allclose(critic.value(*moved[:3]), critic.value(obs, present, departed), atol=1e-5)
    baseline = critic.baseline(obs, present, departed, action)
    assert torch.allclose(critic.baseline(*moved), baseline[:, order], atol=1e-5)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_baseline_looks_at_mates_actions_and_never_at_its_own(layout):
    critic = critic_of(layout)
    obs, present, departed, action = team(layout)
    before = critic.baseline(obs, present, departed, action)

    other = action.clone()
    other[:, 1] = (action[:, 1] + 1) % 2 if layout.branches else action[:, 1] + 1.0
    after = critic.baseline(obs, present, departed, other)
    assert torch.equal(after[:, 1], before[:, 1])
    for mate in (0, 2, 3):
        assert (after[:, mate] - before[:, mate]).abs().min() > 1e-6


@pytest.mark.parametrize("gone", ["absent", "departed"])
def test_members_who_are_not_there_change_nothing(gone):
    critic = critic_of()
    obs, present, departed, action = team()
    if gone == "absent":
        present[:, 2] = False
    else:
        departed[:, 2] = True
    value = critic.value(obs, present, departed)
    baseline = critic.baseline(obs, present, departed, action)

    obs[:, 2], action[:, 2, 0], action[:, 2, 1] = 7.0, -2.0, 0.0
    assert torch.equal(critic.value(obs, present, departed), value)
    others = [0, 1, 3]
    assert torch.equal(critic.baseline(obs, present, departed, action)[:, others], baseline[:, others])

    present[:, 3] = False
    assert not torch.allclose(critic.value(obs, present, departed), value)


def test_the_value_is_one_number_a_team_and_the_count_tells_teams_of_equals_apart():
    critic = critic_of()
    obs, present, departed, _ = team(dims=(1,))
    obs[:] = obs[:, :1]  # the mean of equal members is the same for any number of them
    value = critic.value(obs, present, departed)
    assert value.shape == (1, 4, 1) and (value == value[:, :1]).all()
    present[:, 2:] = False
    assert not torch.allclose(critic.value(obs, present, departed), value)
    features = critic.features(obs, present, departed)
    assert features.shape == (1, 4, critic.size + 1) and (features[..., -1] == 0.0).all()
    assert torch.equal(critic.head(features), critic.value(obs, present, departed))


def test_gradients_reach_every_weight_and_teams_do_not_mix():
    critic = critic_of()
    obs, present, departed, action = team()
    obs.requires_grad_()
    value = critic.value(obs, present, departed)
    baseline = critic.baseline(obs, present, departed, action)
    (grad,) = torch.autograd.grad(value[1].sum() + baseline[1].sum(), obs, retain_graph=True)
    assert (grad[1] != 0).any(-1).all()
    assert (grad[[0, 2, 3, 4]] == 0).all()
    (value.sum() + baseline.sum()).backward()
    assert all((p.grad != 0).any() for p in critic.parameters())


def test_any_leading_dimensions_and_images():
    layout = ObsLayout.from_shapes([(3,), (2, 8, 8)])
    critic = critic_of(obs=layout, team_size=2, normalize_obs=True, critic_hidden=[10])
    obs, present, departed, action = team(dims=(2, 3, 4), team_size=2)
    image = torch.randn(2, 3, 4, 2, 2, 8, 8)
    value = critic(obs, image, present, departed)
    baseline = critic.baseline(obs, image, present, departed, action)
    assert value.shape == baseline.shape == (2, 3, 4, 2, 1)
    flat = [x.flatten(0, 2) for x in (obs, image, present, departed, action)]
    assert torch.allclose(critic.value(*flat[:4]), value.flatten(0, 2), atol=1e-5)
    assert torch.allclose(critic.baseline(*flat), baseline.flatten(0, 2), atol=1e-5)


def test_initial_weights_are_those_of_ml_agents():
    torch.manual_seed(0)
    critic = PocaCritic(ObsLayout(64), CONTINUOUS, 2, ModelConfig(hidden=[256, 256]))
    gain = math.sqrt(0.125 / 256)
    assert critic.observed[0].weight.std().item() == pytest.approx(gain, rel=0.03)
    assert critic.attention.query.weight.std().item() == pytest.approx(gain, rel=0.03)
    assert critic.trunk[2].weight.std().item() == pytest.approx(gain / math.sqrt(256), rel=0.03)
    assert critic.head.weight.abs().max() <= math.sqrt(6 / 258)
    assert all((m.bias == 0).all() for m in critic.modules() if isinstance(m, nn.Linear))


def test_actions_become_one_hots_beside_the_continuous_ones():
    flat = flat_actions(torch.tensor([[0.5, 2.0]]), HYBRID)
    assert flat.tolist() == [[0.5, 0.0, 0.0, 1.0]]
    assert flat_actions(torch.tensor([[2, 0]]), DISCRETE).tolist() == [[0.0, 0.0, 1.0, 1.0, 0.0]]
