"""Options of the networks: layer norms, initial weights, squashed actions, the prior of the statistics."""

import math
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import TanhNormal
from torchrl.modules.utils import biased_softplus

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import (
    Activation,
    CollectConfig,
    Config,
    CriticKind,
    DistributionKind,
    EnvConfig,
    LogConfig,
    MemoryKind,
    ModelConfig,
    PPOConfig,
    Schedule,
    WeightInit,
)
from mappo_unity.learning.networks.actor_critic import Actor, make_actor, make_critic
from mappo_unity.learning.networks.distributions import ActionDistribution, ActionLayout, state_log_std
from mappo_unity.learning.networks.encoders import ObsLayout, RunningNorm
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.training.trainer import train

IMAGE = ObsLayout.from_shapes([(5,), (3, 8, 8)])
SQUASHED = ActionLayout(2, (), squashed=True)
HYBRID = ActionLayout(1, (3,))
TANH = {"action_distribution": DistributionKind.tanh_normal}


def critic(kind, **options):
    team_size = 1 if kind is CriticKind.local else 3
    cfg = ModelConfig(hidden=[16, 8], critic=kind, **options)
    return make_critic(ObsLayout(5), team_size, cfg, HYBRID)


# --- layer norms


@pytest.mark.parametrize("kind", CriticKind)
def test_every_hidden_activation_of_a_critic_is_normalised(kind):
    net = critic(kind, layer_norm=True)
    widths = [m.normalized_shape[0] for m in net.modules() if isinstance(m, nn.LayerNorm)]
    entities = [16, 16] if kind is CriticKind.poca else []  # of both kinds
    assert widths == [5, *entities, 16, 8]
    plain = critic(kind)
    assert not any(isinstance(m, nn.LayerNorm) for m in plain.modules())


def test_an_actor_is_that_of_the_mappo_repository():
    """Features, then Linear, activation and LayerNorm for each width, then the output layer."""
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[6, 4], activation=Activation.relu, layer_norm=True, normalize_obs=False)
    actor = Actor(ObsLayout(5), ActionLayout(0, (3,)), cfg)
    for part in actor.modules():
        if isinstance(part, nn.LayerNorm):
            nn.init.normal_(part.weight)
            nn.init.normal_(part.bias)
    obs = torch.randn(7, 5)

    norms = [m for m in actor.modules() if isinstance(m, nn.LayerNorm)]
    linears = [m for m in actor.modules() if isinstance(m, nn.Linear)]
    x = norms[0](obs)
    for linear, norm in zip(linears, norms[1:]):
        x = norm(torch.relu(linear(x)))
    assert torch.equal(actor(obs), linears[-1](x))


def test_images_keep_their_own_layers():
    cfg = ModelConfig(hidden=[6], layer_norm=True)
    actor = Actor(IMAGE, ActionLayout(1, ()), cfg)
    assert not any(isinstance(m, nn.LayerNorm) for m in actor.encoder.images.modules())
    assert actor(torch.randn(2, 5), torch.randn(2, 3, 8, 8)).shape == (2, 2)
    alone = Actor(ObsLayout.from_shapes([(3, 8, 8)]), ActionLayout(1, ()), cfg)
    assert alone(torch.randn(2, 3, 8, 8)).shape == (2, 2)


# --- initial weights


def test_kaiming_weights_have_ml_agents_deviations():
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[400, 300], weight_init=WeightInit.kaiming_normal)
    actor = Actor(ObsLayout.from_shapes([(500,), (3, 24, 24)]), ActionLayout(100, (90,)), cfg)
    first, second, head = (m for m in actor.net if isinstance(m, nn.Linear))
    assert first.weight.std().item() == pytest.approx(1 / math.sqrt(628), rel=0.03)
    assert second.weight.std().item() == pytest.approx(1 / math.sqrt(400), rel=0.03)
    assert head.weight[:100].std().item() == pytest.approx(0.2 / math.sqrt(300), rel=0.03)
    assert head.weight[100:].std().item() == pytest.approx(0.1 / math.sqrt(300), rel=0.03)
    image = actor.encoder.images[0].out[0]
    assert image.weight.std().item() == pytest.approx(1.41 / math.sqrt(image.in_features), rel=0.03)
    assert all((m.bias == 0).all() for m in (first, second, head, image))


@pytest.mark.parametrize(
    "kind", [CriticKind.local, CriticKind.central, CriticKind.mean, CriticKind.attention]
)
def test_a_critic_s_last_layer_is_xavier_uniform(kind):
    torch.manual_seed(0)
    net = critic(kind, critic_hidden=[256, 200], weight_init=WeightInit.kaiming_normal)
    last = [m for m in net.modules() if isinstance(m, nn.Linear)][-1]
    limit = math.sqrt(6 / 201)
    assert last.out_features == 1 and (last.bias == 0).all()
    assert last.weight.abs().max() <= limit
    assert last.weight.std().item() == pytest.approx(limit / math.sqrt(3), rel=0.15)


def test_members_of_a_team_do_not_begin_alike():
    cfg = ModelConfig(hidden=[4], weight_init=WeightInit.kaiming_normal, share_parameters=False)
    nets = make_actor(ObsLayout(5), ActionLayout(1, ()), 2, cfg)[0].module.nets
    assert not torch.equal(nets[0].net[0].weight, nets[1].net[0].weight)


@pytest.mark.parametrize("memory", [MemoryKind.lstm, MemoryKind.gru])
def test_heads_behind_a_memory_begin_as_others(memory):
    torch.manual_seed(0)
    cfg = ModelConfig(memory=memory, memory_size=256, weight_init=WeightInit.kaiming_normal, **TANH)
    actor = make_actor(ObsLayout(5), ActionLayout(100, (90,)), 1, cfg)[0].module
    fan = actor.head.in_features
    assert actor.head.weight[:200].std().item() == pytest.approx(0.2 / math.sqrt(fan), rel=0.03)
    assert actor.head.weight[200:].std().item() == pytest.approx(0.1 / math.sqrt(fan), rel=0.03)
    head = make_critic(ObsLayout(5), 1, cfg, HYBRID).module.head
    assert head.weight.abs().max() > 0.05 and head.weight.abs().max() <= math.sqrt(6 / (fan + 1))


# --- squashed actions


def test_squashed_log_probs_are_those_of_torchrl_s_tanh_normal():
    torch.manual_seed(0)
    params = torch.randn(50, 4)
    dist = ActionDistribution(params, SQUASHED)
    reference = TanhNormal(params[:, :2], params[:, 2:].exp(), low=-3.0, high=3.0, safe_tanh=False)
    action = 3 * torch.tanh(torch.randn(50, 2))
    assert torch.allclose(dist.log_prob(action), reference.log_prob(action), atol=1e-3)
    assert torch.allclose(dist.mode, reference.deterministic_sample, atol=1e-5)


def test_squashed_draws_keep_their_limits_and_finite_log_probs():
    params = torch.tensor([40.0, -40.0, 2.0, 2.0]).expand(1000, 4).clone().requires_grad_()
    dist = ActionDistribution(params, SQUASHED)
    sample = dist.sample()
    assert sample.abs().max() < 3.0
    log_prob = dist.log_prob(sample)
    (log_prob.sum() + dist.entropy().sum()).backward()
    assert log_prob.isfinite().all() and params.grad.isfinite().all()


def test_squashed_entropy_is_the_mean_of_the_log_probs():
    torch.manual_seed(0)
    params = torch.tensor([[0.5, -1.5, math.log(0.4), math.log(1.3)]])
    dist = ActionDistribution(params, SQUASHED)
    drawn = -dist.log_prob(dist.sample((200_000,))).mean()
    assert dist.entropy().item() == pytest.approx(drawn.item(), abs=0.01)


def test_a_state_dependent_deviation_begins_at_init_log_std():
    assert torch.allclose(
        state_log_std(torch.linspace(-4, 4, 9), 0.0).exp(), biased_softplus(1.0)(torch.linspace(-4, 4, 9))
    )
    for init in (-5.0, -0.5, 0.0, 1.0, 3.0):
        assert state_log_std(torch.zeros(1), init).item() == pytest.approx(init, abs=1e-4)
    actor = Actor(ObsLayout(4), SQUASHED, ModelConfig(init_log_std=-0.5))
    params = actor(torch.randn(100, 4))
    assert params.shape == (100, 4)
    assert (params[:, 2:] + 0.5).abs().max() < 0.1
    assert params[:, 2:].std() > 0  # it depends on the observation
    assert "log_std" not in dict(actor.named_parameters())


def test_discrete_actions_know_no_squashing():
    actor = make_actor(ObsLayout(4), ActionLayout(0, (3,)), 1, ModelConfig(**TANH))
    assert not actor.layout.squashed
    hybrid = make_actor(ObsLayout(4), ActionLayout(2, (3,)), 1, ModelConfig(**TANH))
    mask = torch.tensor([True, False, True]).expand(9, 3)
    out = hybrid(TensorDict({"observation": torch.randn(9, 4), "action_mask": mask}, [9]))
    assert out["action"].shape == (9, 3) and (out["action"][:, 2] != 1).all()
    assert out["params"].shape == (9, 7)


# --- the prior of the statistics


def test_a_normaliser_with_a_prior_is_ml_agents_one():
    """mean' = mean + sum(x - mean) / n', S' = S + sum((x - mean') (x - mean)), from n = 1, S = 1."""
    torch.manual_seed(0)
    norm = RunningNorm(3)
    norm.begin_with_prior()
    count, mean, total = 1, torch.zeros(3), torch.ones(3)
    for rows in (torch.randn(1, 3), torch.randn(7, 3) * 4 + 2, torch.tensor([[5.0, 5.0, 5.0]] * 4)):
        norm.update(rows)
        count += len(rows)
        new = mean + ((rows - mean) / count).sum(0)
        total = total + ((rows - new) * (rows - mean)).sum(0)
        mean = new
    x = torch.randn(20, 3) * 3
    expected = ((x - mean) / torch.sqrt(total / count)).clamp(-5, 5)
    assert torch.allclose(norm(x), expected, atol=1e-5)


def test_the_option_reaches_actor_and_critic():
    cfg = ModelConfig(hidden=[4], obs_norm_prior=True)
    actor = make_actor(ObsLayout(3), ActionLayout(1, ()), 2, cfg)
    for net in (actor, make_critic(ObsLayout(3), 2, cfg, HYBRID)):
        norms = [m for m in net.modules() if isinstance(m, RunningNorm)]
        assert norms and all(norm.count == 1 and norm.epsilon == 0 for norm in norms)


# --- whole runs


@pytest.mark.parametrize(
    "options",
    [
        {"layer_norm": True},
        {"layer_norm": True, "memory": MemoryKind.gru, "memory_size": 16} | TANH,
        {"weight_init": WeightInit.kaiming_normal, "obs_norm_prior": True},
        TANH,
    ],
)
def test_a_run_trains_exports_and_resumes(options, tmp_path):
    cfg = Config(
        env=EnvConfig(num_areas=4),
        model=ModelConfig(hidden=[16], **options),
        ppo=PPOConfig(minibatch_size=32, entropy_coef=0.01),
        collect=CollectConfig(rounds=16),
        log=LogConfig(loggers=[], progress=False),
        max_steps=256,
        checkpoint_interval=64,
    )
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    cfg = replace(
        cfg, ppo=replace(cfg.ppo, lr_schedule=Schedule.constant, entropy_schedule=Schedule.constant)
    )
    unbroken = train(cfg, whole).last_checkpoint
    half = train(replace(cfg, max_steps=128), parts).last_checkpoint
    resumed = train(cfg, parts, half).last_checkpoint
    ends = [checkpoint.load(path)["learners"]["3DBall"]["actor"] for path in (unbroken, resumed)]
    assert all(torch.equal(ends[0][key], ends[1][key]) for key in ends[0])

    onnx = OnnxPolicy(whole / "checkpoints" / "final.onnx", deterministic=True)
    assert onnx.agent_steps == 256
    CheckpointPolicy(whole / "checkpoints" / "best.pt", deterministic=True)
    model = checkpoint.load(unbroken)["model"]["3DBall"]
    assert {name: model[name] for name in options} == {
        name: getattr(value, "value", value) for name, value in options.items()
    }


def test_the_command_line_takes_them():
    lines = ["model.layer_norm=true", "model.weight_init=kaiming_normal", "model.obs_norm_prior=true"]
    model = compose_config([*lines, "model.action_distribution=tanh_normal"]).config.model
    assert model.layer_norm and model.obs_norm_prior
    assert model.weight_init is WeightInit.kaiming_normal
    assert model.action_distribution is DistributionKind.tanh_normal


def test_statistics_and_schedules_can_move_before_a_batch_is_learnt(tmp_path):
    """As ML-Agents': the first update sees observations that are normalised already."""
    lines = ["recipe=mlagents", "env=3DBall", "env.num_areas=4", "model.hidden=[8]", "collect.rounds=16"]
    cfg = compose_config([*lines, "max_steps=256", "log.loggers=[]", "log.progress=false"]).config
    counts, states, rates = [], [], []

    def look(state):
        learner = state.setup.learners["3DBall"]
        of_actor, of_critic = learner.norms
        counts.append((state.agent_steps, float(of_actor.count)))
        assert torch.equal(of_actor.mean, of_critic.mean) and not torch.equal(of_actor.var, torch.ones(8))
        states.append(learner.state_dict()["actor"])
        rates.append(learner.optimizer.param_groups[0]["lr"])
        return None

    whole = train(cfg, tmp_path / "whole", after_iteration=look)
    assert counts == [(steps, steps + 1) for steps in (64, 128, 192, 256)]  # 1: the prior
    assert [float(next(v for k, v in s.items() if k.endswith("count"))) for s in states] == [
        65,
        129,
        193,
        257,
    ]

    # and the schedules count the batch that is learnt: the last one is learnt with their final value
    assert rates == pytest.approx([2.25e-4, 1.5e-4, 7.5e-5, 1e-10], rel=1e-4)

    stop = lambda state: "interrupted" if state.iteration == 2 else None  # noqa: E731
    half = train(cfg, tmp_path / "parts", after_iteration=stop).last_checkpoint
    resumed = train(cfg, tmp_path / "parts", half)
    ends = [checkpoint.load(out.last_checkpoint)["learners"]["3DBall"]["actor"] for out in (whole, resumed)]
    assert all(torch.equal(ends[0][key], ends[1][key]) for key in ends[0])
