"""Probe environments: a run of seconds must find the known answer."""

from pathlib import Path

import numpy as np
import pytest
import torch
from probes import PROBES

from mappo_unity.config.schema import (
    Backend,
    CollectConfig,
    Config,
    CriticKind,
    EnvConfig,
    LogConfig,
    ModelConfig,
    PPOConfig,
    Schedule,
)
from mappo_unity.training.setup import set_up

GAMMA = 0.9


def learn(
    probe,
    tmp_path,
    iterations=60,
    actions="discrete",
    model=None,
    ppo=None,
    rounds=8,
    factory="probes:make",
    teams=16,
):
    """Train on a probe; return what was set up, the last batch, and what followed it."""
    cfg = Config(
        env=EnvConfig(
            name="custom",
            backend=Backend.custom,
            factory=factory,
            params={"probe": probe, "actions": actions, "teams": teams},
        ),
        model=ModelConfig(**({"hidden": [32], "normalize_obs": False} | (model or {}))),
        ppo=PPOConfig(
            **(
                {
                    "lr": 1e-2,
                    "lr_schedule": Schedule.constant,
                    "gamma": GAMMA,
                    "epochs": 6,
                    "minibatch_size": 64,
                }
                | {"value_norm_beta": 0.9}
                | (ppo or {})
            )
        ),
        collect=CollectConfig(rounds=rounds),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        for _ in range(iterations):
            setup.learners["Probe"].learn(*next(batches).of("Probe"), 0.0)
        return setup, *next(batches).of("Probe")


def values(setup, batch):
    return setup.learners["Probe"].reader.values_of(batch).squeeze(-1)


def chosen(batch, actions="discrete"):
    """Choices in [-1, 1] of the acting agents, as the probe sees them."""
    action = batch["action"].float()
    if actions == "continuous":
        return action[..., 0].clamp(-3, 3) / 3
    if actions == "mixed":
        return (action[..., 0].clamp(-3, 3) / 3 + action[..., 1] * 2 - 1) / 2
    return action[..., 0] * 2 - 1


def test_constant_reward(tmp_path):
    setup, batch, _ = learn("Constant", tmp_path, 30)
    assert values(setup, batch).mean().item() == pytest.approx(1.0, abs=0.02)


def test_reward_that_depends_on_the_observation(tmp_path):
    setup, batch, _ = learn("ObsReward", tmp_path, 40)
    assert torch.allclose(values(setup, batch), batch["observation"].squeeze(-1), atol=0.06)


def test_delayed_reward_is_discounted(tmp_path):
    setup, batch, _ = learn("Delayed", tmp_path, 80)
    early = batch["observation"].squeeze(-1) == 0
    value = values(setup, batch)
    assert value[early].mean().item() == pytest.approx(GAMMA, abs=0.03)
    assert value[~early].mean().item() == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["continuous", "discrete", "mixed"])
def test_action_dependent_reward(tmp_path, actions):
    _, batch, _ = learn("ActionReward", tmp_path, 70, actions)
    assert chosen(batch, actions).mean() > 0.9


@pytest.mark.parametrize("actions", ["continuous", "discrete", "mixed"])
def test_observation_and_action_dependent_reward(tmp_path, actions):
    _, batch, _ = learn("ObsActionReward", tmp_path, 100, actions)
    earned = batch["observation"].squeeze(-1) * chosen(batch, actions)
    assert earned.mean() > 0.85


def test_joint_branches_learn_too(tmp_path):
    _, batch, _ = learn("ObsActionReward", tmp_path, 60, model={"flatten_branches": True})
    assert (batch["observation"].squeeze(-1) * chosen(batch)).mean() > 0.9


@pytest.mark.parametrize("shared", [True, False])
def test_credit_goes_to_the_member_that_earned_it(tmp_path, shared):
    _, batch, _ = learn("Credit", tmp_path, 60, model={"share_parameters": shared})
    assert chosen(batch)[..., 0].mean() > 0.9


@pytest.mark.parametrize(
    "kind",
    [k if k is CriticKind.central else pytest.param(k, marks=pytest.mark.slow) for k in CriticKind],
)
def test_only_critics_that_see_the_team_know_what_a_mate_knows(tmp_path, kind):
    setup, batch, _ = learn("MateKnows", tmp_path, 80, model={"critic": kind})
    sign = batch["observation"][..., 0, 0]
    error = (values(setup, batch)[..., 1] - sign).abs().mean().item()
    if kind is CriticKind.local:
        assert error == pytest.approx(1.0, abs=0.1)
    else:
        assert error < 0.1


@pytest.mark.parametrize(
    ("kind", "low", "high"), [(CriticKind.central, 0.7, 1.3), (CriticKind.poca, 0.0, 0.1)]
)
def test_the_baseline_of_poca_takes_out_what_the_mates_did(tmp_path, kind, low, high):
    # only the first's choice earns: the second's advantage is noise, unless its mate's action is known
    ppo = {"lr": 1e-12, "critic_lr": 1e-2, "normalize_advantages": False}
    setup, *batch = learn("Credit", tmp_path, 30, model={"critic": kind}, ppo=ppo, rounds=16)
    buffer, _ = setup.learners["Probe"].prepare(*batch)
    assert low <= buffer[:]["advantage"][:, 1].var().item() <= high


def test_a_member_that_ends_early_learns_from_what_its_team_earns_later(tmp_path):
    _, batch, _ = learn("EarlyDeath", tmp_path, 80, ppo={"death_masking": True, "lr": 1e-2}, rounds=12)
    first = batch["acting"][..., 0, 0]
    assert chosen(batch)[..., 0][first].mean() > 0.9


@pytest.mark.slow
def test_without_death_masking_it_learns_nothing(tmp_path):
    _, batch, _ = learn("EarlyDeath", tmp_path, 80, ppo={"death_masking": False, "lr": 1e-2}, rounds=12)
    first = batch["acting"][..., 0, 0]
    assert chosen(batch)[..., 0][first].mean() < 0.9


def test_an_agent_that_is_asked_every_other_round(tmp_path):
    _, batch, _ = learn("Staggered", tmp_path, 60)
    acting = batch["acting"].squeeze(-1)
    assert not acting.all()
    assert chosen(batch)[acting].mean() > 0.9


def test_an_agent_whose_id_changes(tmp_path):
    setup, batch, _ = learn("NewIds", tmp_path, 60)
    assert (batch["observation"].squeeze(-1) * chosen(batch)).mean() > 0.9
    assert min(setup.env.behaviors["Probe?team=0"].slots.agent_id) > 16


@pytest.mark.parametrize(
    ("probe", "expected"),
    [
        pytest.param("TimeLimit", 1 / (1 - GAMMA), marks=pytest.mark.slow),
        ("RealEnd", np.mean([sum(GAMMA**k for k in range(n)) for n in range(1, 6)])),
    ],
)
def test_time_limits_bootstrap_and_real_ends_do_not(tmp_path, probe, expected):
    setup, batch, _ = learn(probe, tmp_path, 150, rounds=10)
    assert values(setup, batch).mean().item() == pytest.approx(expected, rel=0.06)


def test_every_probe_is_tested():
    files = (
        Path(__file__).with_name(f"test_{name}.py") for name in ("probes", "memory", "rewards", "lessons")
    )
    text = "".join(file.read_text() for file in files)
    assert all(f'"{name}"' in text for name in PROBES)
