"""The learner: first ratio, masks, rollback, schedules."""

import copy
import math

import pytest
import torch
from masked import whole
from tensordict import TensorDict

from mappo_unity.config.schema import (
    Activation,
    BCConfig,
    CriticKind,
    ModelConfig,
    ObsNormUpdate,
    PPOConfig,
    RatioKind,
    Schedule,
    ValueLoss,
    ValueNormKind,
    ValueNormUpdate,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.loss import ACTOR_LEARNS, move_with_minibatch
from mappo_unity.learning.networks.actor_critic import make_actor, make_critic
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.rewards.streams import RewardStreams
from mappo_unity.learning.value_norm import move_statistics

T, G, A, OBS = 12, 5, 2, 3
TWO_CONTINUOUS = ActionLayout(2, ())


def make_learner(layout=TWO_CONTINUOUS, model=None, **options):
    torch.manual_seed(0)
    model = ModelConfig(**{"hidden": [16], "activation": Activation.tanh} | (model or {}))
    cfg = PPOConfig(**({"minibatch_size": 40} | options))
    obs = ObsLayout(OBS)
    return PolicyLearner(make_actor(obs, layout, A, model), make_critic(obs, A, model, layout), cfg)


def make_batch(learner, acting=None):
    shape = (T, G, A)
    flags = torch.ones(*shape, 1, dtype=torch.bool)
    batch = TensorDict(
        {"observation": torch.randn(*shape, OBS) * 4 + 1, "acting": flags if acting is None else acting},
        shape,
    )
    if learner.actor.layout.branches:
        batch["action_mask"] = torch.ones(*shape, sum(learner.actor.layout.branches), dtype=torch.bool)
    with torch.no_grad():
        out = learner.actor(batch.clone())
    batch["action"], batch["action_log_prob"] = out["action"], out["action_log_prob"]
    none = torch.zeros(*shape, 1, dtype=torch.bool)
    batch["present"], batch["departed"] = ~none, none
    batch["next"] = TensorDict(
        {
            "observation": torch.randn(*shape, OBS),
            "acting": batch["acting"].roll(-1, 0),
            "present": ~none,
            "departed": none,
            "reward": torch.randn(*shape, 1),
            "group_reward": torch.zeros(*shape, 1),
            "terminated": torch.rand(*shape, 1) < 0.05,
            "truncated": none,
            "done": none,
        },
        shape,
    )
    return batch


def prepared(learner, batch):
    """Return all rows that an update would draw from."""
    return learner.prepare(*whole(batch))[0][:]


@pytest.mark.parametrize("layout", [ActionLayout(2, ()), ActionLayout(0, (3, 2)), ActionLayout(1, (4,))])
def test_the_first_minibatch_has_ratio_one_and_kl_zero(layout):
    learner = make_learner(layout)
    for _ in range(3):  # after the normalisers have moved, too
        batch = make_batch(learner)
        buffer, _ = learner.prepare(*whole(batch))
        first = next(iter(buffer))
        terms = learner.step(first)
        assert learner.loss.log_ratio.abs().max() < 1e-5
        assert terms["kl"].abs() < 1e-6
        assert terms["clip_fraction"] == 0
        learner.learn(*whole(make_batch(learner)), 0.0)


def test_rows_in_which_nobody_acted_carry_no_loss():
    acting = torch.ones(T, G, A, 1, dtype=torch.bool)
    acting[::2] = False
    learner = make_learner()
    batch = make_batch(learner, acting)
    rows = prepared(learner, batch)
    # five rounds of decisions with their outcomes; of the sixth only what ended in the last round
    ended_last = batch["next", "terminated"][-1]
    assert len(rows) == (T // 2 - 1) * G + int(ended_last.any(1).sum())
    learnt = rows.get(ACTOR_LEARNS, None)  # absent where every slot of every row learns
    count = len(rows) * A if learnt is None else int(learnt.sum())
    assert count == (T // 2 - 1) * G * A + int(ended_last.sum())
    # garbage in rows without a decision changes nothing
    other = batch.clone()
    quiet = ~acting.expand_as(batch["observation"])
    other["observation"] = torch.where(quiet, 777.0, batch["observation"])
    other["action"] = torch.where(~acting, 99.0, batch["action"])
    twin = copy.deepcopy(learner)
    torch.manual_seed(1)
    first = learner.learn(*whole(batch), 0.0)
    torch.manual_seed(1)
    second = twin.learn(*whole(other), 0.0)
    assert first["policy_loss"] == second["policy_loss"] and first["value_loss"] == second["value_loss"]
    for one, two in zip(learner.params, twin.params):
        assert torch.equal(one, two)


def test_an_update_that_turns_nan_is_taken_back_and_counted():
    # (PopArt rescales the last layer before the update begins; that is not part of the update)
    learner = make_learner(normalize_values=ValueNormKind.running)
    before = copy.deepcopy(learner._trainable_state())
    batch = make_batch(learner)
    batch["action_log_prob"][3, 2, 1] = math.nan
    metrics = learner.learn(*whole(batch), 0.0)
    assert metrics["rolled_back"] == 1.0 and metrics["rollbacks"] == 1.0
    after = learner._trainable_state()
    for part in ("actor", "critic"):
        for name in before[part]:
            if "norm." not in name:
                assert torch.equal(before[part][name], after[part][name]), name
    assert learner.learn(*whole(make_batch(learner)), 0.0)["rolled_back"] == 0.0


def test_an_update_whose_kl_explodes_is_taken_back():
    learner = make_learner(lr=0.5, epochs=8, max_kl=0.05)
    metrics = learner.learn(*whole(make_batch(learner)), 0.0)
    assert metrics["kl_last"] > 0.05 and metrics["rolled_back"] == 1.0


def test_target_kl_stops_the_epochs_early():
    eager = make_learner(lr=3e-2, epochs=10, target_kl=1e-3, max_kl=100.0)
    assert eager.learn(*whole(make_batch(eager)), 0.0)["kl_stopped"] == 1.0
    calm = make_learner(lr=1e-6, epochs=2, target_kl=1e-3)
    assert calm.learn(*whole(make_batch(calm)), 0.0)["kl_stopped"] == 0.0


def test_schedules_reach_the_optimizer_and_the_loss():
    learner = make_learner(
        lr=1e-3,
        lr_final=1e-4,
        clip_schedule=Schedule.linear,
        clip_epsilon=0.3,
        entropy_coef=0.02,
        entropy_coef_final=0.01,
    )
    metrics = learner.learn(*whole(make_batch(learner)), 0.5)
    assert metrics["lr"] == pytest.approx(5.5e-4)
    assert learner.optimizer.param_groups[0]["lr"] == pytest.approx(5.5e-4)
    assert float(learner.loss.clip_epsilon) == pytest.approx(0.2)
    assert float(learner.loss.entropy_coeff) == pytest.approx(0.015)


def test_a_discount_moves_over_the_run_and_reaches_the_targets():
    def learnt(**options):
        learner = make_learner(**options)
        metrics = learner.learn(*whole(make_batch(learner)), 0.5)
        return metrics.get("gamma"), metrics["explained_variance"]

    moved, explained = learnt(gamma=0.5, gamma_schedule=Schedule.linear, gamma_final=0.9)
    assert moved == pytest.approx(0.7)  # half way
    assert (None, pytest.approx(explained)) == learnt(gamma=0.7)
    assert (None, pytest.approx(explained)) != learnt(gamma=0.5, gamma_final=0.9)  # constant

    with pytest.raises(ConfigError, match="ppo.gamma_final must be from 0 to 1"):
        make_learner(gamma_final=1.1)


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        (0.0, 0.5, [0.5, 0.7, 0.9, 0.9, 0.9]),
        (0.5, 1.0, [0.5, 0.5, 0.5, 0.7, 0.9]),
        (0.75, 0.75, [0.5, 0.5, 0.5, 0.9, 0.9]),  # at once
        (1.0, 1.0, [0.5, 0.5, 0.5, 0.5, 0.9]),
        (0.0, 0.0, [0.9] * 5),
    ],
)
def test_a_discount_moves_within_a_part_of_the_run(first: float, last: float, expected: list[float]):
    cfg = PPOConfig(
        gamma=0.5, gamma_schedule=Schedule.linear, gamma_final=0.9, gamma_from=first, gamma_until=last
    )
    streams = RewardStreams(cfg)
    assert [streams.begin(p)["gamma"] for p in (0, 0.25, 0.5, 0.75, 1)] == pytest.approx(expected)


def test_the_part_in_which_a_discount_moves_lies_in_the_run():
    with pytest.raises(ConfigError, match="ppo.gamma_from must be from 0 to 1"):
        make_learner(gamma_from=-0.1)
    with pytest.raises(ConfigError, match="ppo.gamma_until must be from ppo.gamma_from=0.4 to 1"):
        make_learner(gamma_from=0.4, gamma_until=0.3)


def test_a_weight_of_entropy_below_0_takes_randomness_away():
    learner = make_learner(lr=1e-2, lr_schedule=Schedule.constant, entropy_coef_final=-1.0)
    batch = make_batch(learner)
    entropies = [learner.learn(*whole(batch), 1.0)["entropy"] for _ in range(2)]
    assert entropies[1] < entropies[0] - 0.05

    with pytest.raises(ConfigError, match="ppo.entropy_coef_final must be >= -1"):
        make_learner(entropy_coef_final=-1.1)


def test_learning_rates_are_steered_by_the_kl_of_updates():
    learner = make_learner(lr=1e-3, critic_lr=4e-3, lr_schedule=Schedule.constant, lr_target_kl=0.02)
    rates = learner.rates

    # within a factor of two nothing changes; then a third less, a half more; nothing else learns faster
    for kl, lr in (
        (0.039, 1e-3),
        (0.041, 1e-3 / 1.5),
        (0.011, 1e-3 / 1.5),
        (0.009, 1e-3),
        (math.inf, 1e-3 / 1.5),
    ):
        rates.steer(kl)
        assert rates.begin(0.5) == pytest.approx(lr)
        groups = learner.optimizer.param_groups
        assert [group["lr"] for group in groups] == pytest.approx([lr, 4 * lr])

    # not farther than 0.01 to 10 times the scheduled rates
    for kl, lr in ((1.0, 1e-5), (0.0, 1e-2)):
        for _ in range(30):
            rates.steer(kl)
        assert rates.begin(0.0) == pytest.approx(lr)


def test_an_update_that_goes_too_far_is_followed_by_a_slower_one_also_after_resuming():
    learner = make_learner(lr=0.5, epochs=8, max_kl=0.05, lr_target_kl=0.02, lr_schedule=Schedule.constant)
    batch = make_batch(learner)
    assert learner.learn(*whole(batch), 0.0)["rolled_back"] == 1.0
    assert learner.learn(*whole(batch), 0.0)["lr"] == pytest.approx(0.5 / 1.5)

    resumed = make_learner(lr=0.5, lr_target_kl=0.02, lr_schedule=Schedule.constant)
    resumed.load_state_dict(learner.state_dict())
    assert resumed.rates.begin(0.0) == learner.rates.begin(0.0) == pytest.approx(0.5 / 1.5**2)

    free = make_learner(lr=0.5, epochs=8, max_kl=0.05, lr_schedule=Schedule.constant)
    free.learn(*whole(batch), 0.0)
    assert free.learn(*whole(batch), 0.0)["lr"] == 0.5


def test_a_critic_that_learns_alone_does_not_steer_the_rates():
    learner = make_learner(lr=1e-3, lr_target_kl=0.02, critic_warmup_steps=1, lr_schedule=Schedule.constant)
    batch = make_batch(learner)
    assert learner.learn(*whole(batch), 0.0)["critic_warmup"] == 1.0
    assert learner.rates.scale == 1.0

    learner.learn(*whole(batch), 0.0)
    assert learner.rates.scale != 1.0


def test_the_huber_threshold_is_the_one_asked_for():
    learner = make_learner(value_loss=ValueLoss.huber, huber_delta=4.0, value_coef=1.0)
    rows = prepared(learner, make_batch(learner))
    rows["value_target"] = torch.linspace(-30, 30, rows["value_target"].numel()).view_as(rows["value_target"])
    value = learner.critic(rows.clone())["state_value"]
    expected = torch.nn.functional.huber_loss(value, rows["value_target"], delta=4.0)
    assert learner.loss(rows)["loss_critic"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_state_goes_on_to_the_bit():
    one, two = make_learner(), make_learner()
    one.learn(*whole(make_batch(one)), 0.0)
    two.load_state_dict(copy.deepcopy(one.state_dict()))
    batch = make_batch(one)
    for learner in (one, two):
        torch.manual_seed(5)
        learner.learn(*whole(batch.clone()), 0.1)
    for a, b in zip(one.params, two.params):
        assert torch.equal(a, b)
    assert one.value_norm.statistics() == two.value_norm.statistics()


@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize("kind", list(CriticKind))
@pytest.mark.parametrize("hidden", [[16], [1], [4, 1, 1]])
def test_popart_moves_the_statistics_and_leaves_the_values(kind, hidden, share):
    model = {"critic": kind, "critic_hidden": hidden, "share_parameters": share}
    if kind is CriticKind.poca and not share:
        pytest.skip("refused with the options")
    learner = make_learner(model=model, normalize_values=ValueNormKind.popart)
    assert len(learner.value_layers) == (1 if share else A)
    batch = make_batch(learner)
    move_statistics(learner.value_norm, torch.randn(100, 1) * 5 + 30, learner.value_layers)
    before = learner.reader.values_of(batch)
    move_statistics(learner.value_norm, torch.randn(100, 1) * 50 - 300, learner.value_layers)
    after = learner.reader.values_of(batch)
    assert learner.value_norm.statistics()[0] < -100
    assert torch.allclose(before, after, rtol=1e-4, atol=1e-2)


def test_a_step_leaves_the_deviations_in_their_range():
    learner = make_learner(model={"init_log_std": 2}, lr=0.5, entropy_coef=10.0, max_kl=1e9)
    learner.learn(*whole(make_batch(learner)), 0.0)
    log_std = learner.actor[0].module.log_std.detach()
    assert float(log_std.max()) == 2 and learner.rollbacks == 0


def test_departed_members_train_the_critic_and_not_the_policy():
    learner = make_learner(death_masking=True)
    acting = torch.ones(T, G, A, 1, dtype=torch.bool)
    acting[:, :, 1] = False
    batch = make_batch(learner, acting)
    batch["departed"] = batch["next", "departed"] = ~acting
    rows = prepared(learner, batch)
    assert rows["actor_learns"][:, 1].sum() == 0
    assert rows["critic_learns"][:, 1].sum() == rows["critic_learns"][:, 0].sum() > 0
    one, two = copy.deepcopy(learner), copy.deepcopy(learner)
    other = rows.clone()
    other["value_target"][:, 1] += 5.0
    first, second = one.step(rows), two.step(other)
    assert first["policy_loss"] == second["policy_loss"]
    assert first["value_loss"] < second["value_loss"]


def test_the_last_step_is_seen_by_the_guard():
    # one minibatch, one epoch: before its step the KL is 0, after it enormous
    learner = make_learner(lr=1.0, epochs=1, num_minibatches=1, max_kl=0.5)
    before = copy.deepcopy(learner._trainable_state())
    metrics = learner.learn(*whole(make_batch(learner)), 0.0)
    assert metrics["kl"] < 1e-6 and metrics["kl_last"] > 0.5 and metrics["rolled_back"] == 1.0
    for name, value in before["actor"].items():
        if "norm." not in name:
            assert torch.equal(value, learner.actor.state_dict()[name])


def test_value_clipping_follows_the_schedule():
    learner = make_learner(
        clip_value=True,
        clip_epsilon=0.4,
        clip_epsilon_final=0.2,
        clip_schedule=Schedule.linear,
        value_coef=1.0,
    )
    learner.loss.begin(0.5)
    rows = prepared(learner, make_batch(learner))
    with torch.no_grad():
        value = learner.critic(rows.clone())["state_value"]
    rows["state_value"], rows["value_target"] = value - 1.0, value.clone()
    # the critic is right, and has moved by 1 since: only 0.3 of that count
    expected = torch.nn.functional.huber_loss(value - 0.7, value, delta=10.0)
    assert learner.loss(rows)["loss_critic"].item() == pytest.approx(expected.item(), rel=1e-4)


@pytest.mark.parametrize("kind", list(ValueNormKind))
@pytest.mark.parametrize("update", list(ValueNormUpdate))
def test_values_are_clipped_around_what_the_critic_said(kind, update):
    if kind is ValueNormKind.popart and update is ValueNormUpdate.minibatch:
        pytest.skip("they do not go together")
    learner = make_learner(clip_value=True, normalize_values=kind, value_norm_update=update, lr=1e-9)
    for _ in range(3):  # the statistics move
        batch = make_batch(learner)
        batch["next", "reward"] += 3.0
        rows = prepared(learner, batch)
        if update is ValueNormUpdate.minibatch:
            move_with_minibatch(learner.value_norm, rows)
        with torch.no_grad():
            said = learner.critic(rows.clone())["state_value"]
        torch.testing.assert_close(rows["state_value"], said, atol=1e-5, rtol=1e-5)


def test_a_normaliser_that_moves_with_each_round_stands_still_while_the_critic_warms_up():
    options = {"critic_warmup_steps": 2 * T * G * A, "obs_norm_update": ObsNormUpdate.round}
    learner = make_learner(model={"normalize_obs": True}, **options)
    assert learner.actor.moving_norms == []
    batch = make_batch(learner)
    assert learner.learn(*whole(batch), 0.0)["critic_warmup"] == 1.0
    assert learner.actor.moving_norms == []

    resumed = make_learner(model={"normalize_obs": True}, **options)
    resumed.load_state_dict(learner.state_dict())
    for one in (learner, resumed):
        assert one.actor.moving_norms == []
        one.learn(*whole(batch), 0.0)
        assert len(one.actor.moving_norms) == 1  # the critic has learnt its steps


def test_cloning_waits_while_the_critic_warms_up():
    class Clone:
        cfg, learnt = BCConfig(demos=["x"]), 0

        def learn(self, *_):
            self.learnt += 1
            return {}

    learner = make_learner(critic_warmup_steps=T * G * A)
    learner.cloning = clone = Clone()
    before = copy.deepcopy(learner.actor.state_dict())
    learner.learn(*whole(make_batch(learner)), 0.0)
    assert clone.learnt == 0
    assert all(torch.equal(before[name], value) for name, value in learner.actor.state_dict().items())

    learner.learn(*whole(make_batch(learner)), 0.0)
    assert clone.learnt == 1


def test_a_poca_critic_reads_what_waiting_mates_are_doing():
    learner = make_learner(model={"critic": CriticKind.poca})
    asked = torch.ones(T, G, A, 1, dtype=torch.bool)
    asked[1::2, :, 1] = False  # the second member acts for two rounds
    batch = make_batch(learner, asked)
    seen, drawn = learner.reader.with_actions_under_way(batch)["action"], batch["action"]
    assert torch.equal(seen[1::2, :, 1], drawn[::2, :, 1])
    assert torch.equal(seen[::2], drawn[::2]) and torch.equal(seen[:, :, 0], drawn[:, :, 0])

    # over the border of batches, and after a resume
    resumed = make_learner(model={"critic": CriticKind.poca})
    resumed.load_state_dict(learner.state_dict())
    later = make_batch(learner, asked.roll(1, 0))
    for one in (learner, resumed):
        assert torch.equal(one.reader.with_actions_under_way(later)["action"][0, :, 1], drawn[-2, :, 1])

    # what was drawn for members that wait changes nothing
    other = batch.clone()
    other["action"] = torch.where(asked, batch["action"], 99.0)
    one, two = (prepared(copy.deepcopy(learner), b) for b in (batch, other))
    assert torch.equal(one["advantage"], two["advantage"])

    local = make_learner()
    assert local.reader.with_actions_under_way(batch) is batch


def test_a_ratio_of_each_component_is_clipped_by_itself():
    learner = make_learner(ratio=RatioKind.component, clip_epsilon=0.2)
    batch = make_batch(learner)
    with torch.no_grad():
        batch["action_log_probs"] = learner.actor.draw(batch).log_probs
        dist = learner.actor.get_dist(batch)
        batch["action_log_probs"] = dist.component_log_probs(batch["action"])
    rows = prepared(learner, batch)
    rows["action_log_probs"] = rows["action_log_probs"] - torch.tensor([0.5, 0.0])
    rows["advantage"] = torch.ones_like(rows["advantage"])
    # the first component's ratio is e^0.5, clipped to 1.2; the second's is 1
    assert learner.loss(rows)["loss_objective"].item() == pytest.approx(-1.1, abs=1e-4)


def test_actor_and_critic_have_rates_and_norms_of_their_own():
    learner = make_learner(lr=1e-3, critic_lr=1e-4, lr_schedule=Schedule.linear, separate_optimizers=True)
    learner.learn(*whole(make_batch(learner)), 0.5)
    assert [group["lr"] for group in learner.optimizer.param_groups] == pytest.approx([5e-4, 5e-5])
    free = make_learner(max_grad_norm=None)
    assert free.learn(*whole(make_batch(free)), 0.0)["grad_norm"] > 0
