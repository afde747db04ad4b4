"""What an epoch may see anew: estimates by the critic as it then is, the members of teams in other orders."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from masked import whole
from test_memory import options
from test_ppo import make_batch, make_learner

from mappo_unity import keys
from mappo_unity.config.compose import compose_config
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.schema import CriticKind, MemoryKind, ValueNormKind
from mappo_unity.errors import ConfigError
from mappo_unity.learning.loss import MEMBER, TEAM
from mappo_unity.training.setup import set_up

ANEW = {"recompute_advantages": True}


def advantage_and_target(learner: Any, buffer: Any) -> list[torch.Tensor]:
    """Return both of all rows of a buffer, 0 where nobody learns."""
    rows = learner.rows.take(buffer[:])
    mask = rows.get("critic_learns", None)
    entries = (rows[keys.ADVANTAGE], rows[keys.VALUE_TARGET])
    return [entry if mask is None else torch.where(mask, entry, 0.0) for entry in entries]


@pytest.mark.parametrize("critic", list(CriticKind))
@pytest.mark.parametrize("memory", list(MemoryKind))
def test_with_the_same_critic_they_are_the_same(
    memory: MemoryKind, critic: CriticKind, tmp_path: Path
) -> None:
    cfg = options("Staggered", memory=memory, critic=critic, ppo=ANEW)
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        learner = setup.learners["Probe"]
        for _ in range(3):
            buffer, _ = learner.prepare(*next(batches).of("Probe"))
            first = advantage_and_target(learner, buffer)
            kept = copy.deepcopy((learner.reader.state_dict(), learner.carried.state_dict()))

            for one, other in zip(first, advantage_and_target(learner, learner.prepare_again())):
                assert torch.allclose(one, other, atol=1e-4)
            # what the next batch begins with is not read twice
            for before, after in zip(kept, (learner.reader.state_dict(), learner.carried.state_dict())):
                assert (before is None) == (after is None)
                for name, values in (before or {}).items():
                    assert torch.equal(values, after[name]), name


def test_another_critic_gives_others_by_hand() -> None:
    """Of a critic that says c more everywhere, one-step targets are gamma c higher until the end."""
    learner = make_learner(
        gamma=0.9, gae_lambda=0.0, normalize_values=ValueNormKind.none, normalize_advantages=False, **ANEW
    )
    batch = make_batch(learner)
    batch["next", "terminated"] = torch.zeros_like(batch["next", "terminated"])
    first = learner.prepare(*whole(batch))[0][:].clone()
    with torch.no_grad():
        for layer in learner.value_layers:
            layer.bias += 2.0
    again = learner.prepare_again()[:]

    assert torch.allclose(again["value_target"] - first["value_target"], torch.tensor(0.9 * 2.0), atol=1e-5)
    assert torch.allclose(again["advantage"] - first["advantage"], torch.tensor((0.9 - 1) * 2.0), atol=1e-5)

    # what the policy and a clipped value are compared with stays
    for key in ("action_log_prob", "state_value", "observation", "action"):
        assert torch.equal(again[key], first[key]), key


def test_the_statistics_of_returns_move_once_a_batch() -> None:
    learner = make_learner(**ANEW)
    learner.prepare(*whole(make_batch(learner)))
    before = learner.value_norm.state_dict()
    before = {name: value.clone() for name, value in before.items()}
    learner.prepare_again()
    assert all(torch.equal(before[name], value) for name, value in learner.value_norm.state_dict().items())


@pytest.mark.parametrize("epochs", [1, 3])
def test_the_first_epoch_learns_from_the_first_estimates(epochs: int) -> None:
    plain, anew = make_learner(epochs=epochs), make_learner(epochs=epochs, **ANEW)
    batch = make_batch(plain)
    for learner in (plain, anew):
        torch.manual_seed(1)
        learner.learn(*whole(batch.clone()), 0.0)
        assert learner.prepared is None  # nothing of a batch is held longer than its update
    same = [torch.equal(one, other) for one, other in zip(plain.params, anew.params)]
    assert all(same) == (epochs == 1)


def test_each_further_epoch_asks_the_critic_once(monkeypatch: pytest.MonkeyPatch) -> None:
    learner = make_learner(epochs=4, **ANEW)
    asked: list[int] = []
    read = learner.reader.read_again

    def count(*args: Any) -> Any:
        asked.append(1)
        return read(*args)

    monkeypatch.setattr(learner.reader, "read_again", count)
    learner.learn(*whole(make_batch(learner)), 0.0)
    assert len(asked) == 3


# --- members in another order


def test_members_of_a_minibatch_change_places_with_all_that_is_theirs() -> None:
    learner = make_learner(shuffle_members=True)
    rows = learner.prepare(*whole(make_batch(learner)))[0][:]
    flips = []
    for _ in range(40):
        taken = learner.rows.take(rows)
        flips.append(not torch.equal(taken["observation"], rows["observation"]))
        for key in rows.keys():
            assert torch.equal(taken[key], rows[key].flip(1) if flips[-1] else rows[key]), key
    assert 5 < sum(flips) < 35  # half of the orders of two are others; five standard errors are 16


@pytest.mark.parametrize("critic", [CriticKind.local, CriticKind.central, CriticKind.poca])
def test_members_of_a_sequence_change_places_with_all_that_is_theirs(
    critic: CriticKind, tmp_path: Path
) -> None:
    ppo = {"shuffle_members": True}
    cfg = options("MateKnows", memory=MemoryKind.gru, critic=critic, ppo=ppo)
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        learner = setup.learners["Probe"]
        buffer, _ = learner.prepare(*next(batches).of("Probe"))
        drawn = [learner.rows.take(buffer[:]) for _ in range(20)]

        for sequences in drawn:
            team, own = sequences[TEAM], sequences[MEMBER]
            if critic is CriticKind.local:
                assert torch.equal(team["observation"], sequences["observation"])
                continue
            at = torch.arange(len(own))
            for key in team.keys():
                if key in sequences.keys():
                    assert torch.equal(team[key][at, :, own], sequences[key]), key

        members = torch.stack([sequences[MEMBER] for sequences in drawn])
        assert bool((members != members[0]).any()) == (critic is not CriticKind.local)


def test_a_critic_that_knows_no_order_learns_the_same_from_any() -> None:
    model = {"critic": CriticKind.mean, "normalize_obs": False}
    one, other = make_learner(model=model), make_learner(model=model, shuffle_members=True)
    batch = make_batch(one)
    rows = [learner.prepare(*whole(batch.clone()))[0][:] for learner in (one, other)]
    wanted = one.loss(rows[0])
    for _ in range(5):
        for name, loss in other.loss(other.rows.take(rows[1])).items():
            assert torch.allclose(loss, wanted[name], atol=1e-5), name


def test_members_with_networks_of_their_own_keep_their_places() -> None:
    cfg = compose_config(
        ["env=SoccerTwos", "ppo.shuffle_members=true", "model.share_parameters=false"]
    ).config
    with pytest.raises(ConfigError, match="ppo.shuffle_members=false"):
        behavior_config(cfg, "SoccerTwos")
    cfg = compose_config(["env=SoccerTwos", "ppo.shuffle_members=true"]).config
    assert behavior_config(cfg, "SoccerTwos").ppo.shuffle_members
