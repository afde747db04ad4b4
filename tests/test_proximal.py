"""The decoupled objective: the policy that an update begins with beside the one that collected the batch."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from masked import whole
from test_memory import options
from test_ppo import A, G, T, make_batch, make_learner

from mappo_unity import keys
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import (
    AdvantageKind,
    CriticKind,
    MemoryKind,
    ObjectiveKind,
    RatioKind,
    ValueNormKind,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.loss import ACTOR_LEARNS, MOST_WEIGHT, PROXIMAL
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.training.setup import set_up

LAYOUTS = [ActionLayout(2, ()), ActionLayout(0, (3, 2)), ActionLayout(1, (4,))]
DECOUPLED = ObjectiveKind.decoupled


def batch_of(learner: Any) -> Any:
    """Return a batch of the learner's policy, with the log-probabilities of components, too."""
    batch = make_batch(learner)
    with torch.no_grad():
        dist = learner.actor.get_dist(batch.clone())
        batch[keys.LOG_PROBS] = dist.component_log_probs(batch[keys.ACTION])
    return batch


def move(learner: Any, amount: float = 0.3) -> None:
    """Make the policy another one than that which collected."""
    with torch.no_grad():
        for parameter in learner.actor.parameters():
            parameter.add_(torch.randn_like(parameter) * amount)


@pytest.mark.parametrize("ratio", list(RatioKind))
@pytest.mark.parametrize("layout", LAYOUTS, ids=["continuous", "discrete", "mixed"])
def test_where_both_policies_are_one_the_loss_is_that_of_ppo(layout: ActionLayout, ratio: RatioKind) -> None:
    plain = make_learner(layout, ratio=ratio)
    decoupled = make_learner(layout, ratio=ratio, objective=DECOUPLED)
    batch = batch_of(plain)
    first, second = (learner.prepare(*whole(batch.clone()))[0] for learner in (plain, decoupled))
    rows = first[:], second[:]
    for learner in (plain, decoupled):  # the same step away from the batch's policy
        torch.manual_seed(3)
        move(learner, 0.1)

    losses = plain.loss(rows[0]), decoupled.loss(rows[1])
    for name, value in losses[0].items():
        assert value.item() == pytest.approx(losses[1][name].item(), rel=1e-5, abs=1e-6), name
    assert losses[0]["loss_objective"].abs() > 1e-3  # ratios were clipped, or not 1 at least
    assert torch.allclose(plain.loss.ratio, decoupled.loss.ratio, rtol=1e-4)


@pytest.mark.parametrize("ratio", list(RatioKind))
@pytest.mark.parametrize("layout", LAYOUTS, ids=["continuous", "discrete", "mixed"])
def test_ratios_of_an_old_batch_begin_at_one(layout: ActionLayout, ratio: RatioKind) -> None:
    learner = make_learner(layout, ratio=ratio, objective=DECOUPLED)
    batch = batch_of(learner)
    move(learner)
    buffer, metrics = learner.prepare(*whole(batch))
    assert metrics["stale_kl"] > 1e-3
    terms = learner.step(next(iter(buffer)))
    assert learner.loss.log_ratio.abs().max() < 1e-5
    assert terms["kl"].abs() < 1e-6 and terms["clip_fraction"] == 0

    # without the proximal policy both would show how old the batch is
    plain = make_learner(layout, ratio=ratio)
    plain.load_state_dict(copy.deepcopy(learner.state_dict()))
    assert plain.step(plain.prepare(*whole(batch))[0][:])["kl"] > 1e-3


def test_the_decoupled_objective_by_hand() -> None:
    learner = make_learner(objective=DECOUPLED, clip_epsilon=0.2, normalize_advantages=False)
    rows = learner.prepare(*whole(batch_of(learner)))[0][:]
    now = learner.loss.log_probs(rows)
    rows[ACTOR_LEARNS] = torch.zeros(*rows.shape, 1, dtype=torch.bool)
    rows[ACTOR_LEARNS][0] = True  # two agents are learnt from, A = 2
    rows[PROXIMAL], rows["advantage"] = now.clone(), torch.ones(*rows.shape, 1)
    rows["action_log_prob"] = now.squeeze(-1).clone()
    assert A == 2

    # the first: r = e^0.5, clipped to 1.2, w = e^-0.25 = 0.7788; the second: r = 0.9, w = 2
    rows[PROXIMAL][0, 0] -= 0.5
    rows["action_log_prob"][0, 0] -= 0.25
    rows[PROXIMAL][0, 1] -= torch.tensor(0.9).log()
    rows["action_log_prob"][0, 1] -= torch.tensor(0.9).log() + torch.tensor(2.0).log()
    wanted = -(1.2 * 0.7788008 + 0.9 * 2) / 2
    assert learner.loss(rows)["loss_objective"].item() == pytest.approx(wanted, rel=1e-5)

    # what is not learnt from may be anything, and no weight is larger than the largest
    rows[PROXIMAL][1:] = float("nan")
    rows["action_log_prob"][0, 1] -= 50.0
    wanted = -(1.2 * 0.7788008 + 0.9 * MOST_WEIGHT) / 2
    assert learner.loss(rows)["loss_objective"].item() == pytest.approx(wanted, rel=1e-5)


def test_the_kl_limits_look_at_the_update_alone() -> None:
    for objective, rolled_back in ((ObjectiveKind.clip, 1.0), (DECOUPLED, 0.0)):
        learner = make_learner(objective=objective, lr=1e-5, max_kl=0.02)
        batch = batch_of(learner)
        torch.manual_seed(3)
        move(learner)
        assert learner.learn(*whole(batch), 0.0)["rolled_back"] == rolled_back, objective


def test_rows_are_read_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = make_learner(objective=DECOUPLED)
    batch = batch_of(learner)
    wholly = copy.deepcopy(learner).prepare(*whole(batch))[0][:][PROXIMAL]
    sizes: list[int] = []
    read = learner.loss.log_probs
    monkeypatch.setattr("mappo_unity.learning.rows._PIECE", 16)
    monkeypatch.setattr(learner.loss, "log_probs", lambda rows: sizes.append(len(rows)) or read(rows))
    assert torch.allclose(learner.prepare(*whole(batch))[0][:][PROXIMAL], wholly, atol=1e-6)
    assert sizes == [8] * (T * G // 8) + [4]


@pytest.mark.parametrize(
    ("probe", "critic", "kind"),
    [
        ("Staggered", CriticKind.local, MemoryKind.lstm),
        ("EarlyDeath", CriticKind.poca, MemoryKind.gru),
        ("MateKnows", CriticKind.central, MemoryKind.lstm),
        ("EarlyDeath", CriticKind.central, MemoryKind.traces),
    ],
)
def test_with_a_memory(
    probe: str, critic: CriticKind, kind: MemoryKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mappo_unity.learning.rows._PIECE", 64)
    ppo = {"minibatch_size": 10**6, "epochs": 1, "lr": 1e-12, "objective": DECOUPLED}
    with set_up(options(probe, memory=kind, critic=critic, ppo=ppo), tmp_path) as setup:
        with setup.collecting() as batches:
            (learner,) = setup.learners.values()
            for number in range(2):
                batch = next(batches).of("Probe")
                if number:  # the first one is the policy's own
                    move(learner)
                buffer, metrics = learner.prepare(*batch)
                assert buffer is not None
                assert (metrics["stale_kl"] > 1e-5) == bool(number)

                rows = learner.rows.take(buffer[:])
                loss = learner.loss(rows)["loss_objective"]
                assert learner.loss.log_ratio.abs().max() < 1e-5
                mask = rows[ACTOR_LEARNS]
                weight = learner.loss._weight(rows, mask)
                if not number:
                    assert (weight - 1).abs().max() < 1e-5
                expected = (weight * rows[keys.ADVANTAGE])[mask].mean()
                assert loss.item() == pytest.approx(-expected.item(), rel=1e-4, abs=1e-6)


@pytest.mark.parametrize("objective", list(ObjectiveKind))
def test_updates_of_overlapping_batches_begin_at_one(objective: ObjectiveKind, tmp_path: Path) -> None:
    lines = ["env=3DBall", "env.num_areas=4", "collect.rounds=12", f"ppo.objective={objective.value}"]
    lines += ["collect.workers=1", "collect.engine=local", "ppo.epochs=1", "ppo.num_minibatches=1"]
    with set_up(compose_config([*lines, "log.loggers=[]"]).config, tmp_path) as setup:
        setup.cfg.collect.overlap = True  # what workers in this process collect late, with the older weights
        with setup.collecting() as batches:
            metrics = [setup.learn(next(batches), 0.0)["3DBall"] for _ in range(3)]

    # an epoch of one minibatch: its KL is that before the step
    first, *others = [row["kl"] for row in metrics]
    assert first < 1e-6 and all((kl < 1e-6) == (objective is DECOUPLED) for kl in others)
    if objective is DECOUPLED:
        assert all(row["stale_kl"] > 1e-6 for row in metrics[1:])


# --- V-trace


@pytest.mark.parametrize("critic", [CriticKind.central, CriticKind.poca])
@pytest.mark.parametrize("ratio", list(RatioKind))
def test_what_an_older_policy_did_counts_less(ratio: RatioKind, critic: CriticKind) -> None:
    same = {"normalize_advantages": False, "normalize_values": ValueNormKind.none, "ratio": ratio}
    batch = batch_of(make_learner(model={"critic": critic}, **same))

    def rows(shift: float, kind: AdvantageKind, gae_lambda: float) -> Any:
        learner = make_learner(model={"critic": critic}, **same, advantage=kind, gae_lambda=gae_lambda)
        older = batch.clone()
        older["action_log_prob"] += shift  # of every action alike
        return learner.prepare(*whole(older))[0][:]

    # rho 0.5 everywhere is a lambda of half the size, and targets half as far from the values
    found = rows(math.log(2), AdvantageKind.vtrace, 0.8)
    wanted = rows(0.0, AdvantageKind.gae, 0.4)
    assert torch.allclose(found["advantage"], wanted["advantage"], atol=1e-5)
    moved = found["value_target"] - found["state_value"]
    assert torch.allclose(moved, 0.5 * (wanted["value_target"] - wanted["state_value"]), atol=1e-5)
    assert moved.abs().max() > 0.1

    # actions that are likelier now than they were count as they are
    found, wanted = rows(-1.0, AdvantageKind.vtrace, 0.8), rows(0.0, AdvantageKind.gae, 0.8)
    assert torch.equal(found["advantage"], wanted["advantage"])


def test_departed_members_have_no_action_to_correct() -> None:
    acting = torch.ones(T, G, A, 1, dtype=torch.bool)
    acting[:, :, 1] = False
    same = {"normalize_values": ValueNormKind.none, "gae_lambda": 0.8}
    batch = make_batch(make_learner(), acting)
    batch["departed"] = batch["next", "departed"] = ~acting
    batch["action_log_prob"] += math.log(2)
    targets = []
    for kind in AdvantageKind:
        rows = make_learner(advantage=kind, **same).prepare(*whole(batch.clone()))[0][:]
        targets.append(rows["value_target"].transpose(0, 1))
    assert torch.equal(targets[0][1], targets[1][1]) and not torch.allclose(targets[0][0], targets[1][0])


def test_a_batch_in_which_nobody_learns() -> None:
    learner = make_learner(objective=DECOUPLED, advantage=AdvantageKind.vtrace)
    batch = make_batch(learner, torch.zeros(T, G, A, 1, dtype=torch.bool))
    assert learner.prepare(*whole(batch))[0] is None


# --- options


@pytest.mark.parametrize(
    ("option", "choices"),
    [("ppo.objective=clipped", "clip.*decoupled"), ("ppo.advantage=td", "gae.*vtrace")],
)
def test_what_is_not_there_is_refused(option: str, choices: str) -> None:
    with pytest.raises(ConfigError, match=rf"{option.split('=')[0]}.*{choices}"):
        compose_config([option])
