"""Memories: whose they are, when they are frozen and dropped, what is learnt from, exact resume, export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mappo_unity import keys
from mappo_unity.cli import eval_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import (
    Backend,
    CollectConfig,
    Config,
    CriticKind,
    EnvConfig,
    LogConfig,
    MemoryKind,
    ModelConfig,
    PPOConfig,
    Schedule,
)
from mappo_unity.errors import ConfigError
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.networks.recurrent import Memory
from mappo_unity.learning.sequences import cut_sequences
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.training.setup import set_up

KINDS = [MemoryKind.lstm, MemoryKind.gru]


def options(probe: str, rounds: int = 12, ppo: dict[str, Any] | None = None, **model: Any) -> Config:
    """Return the options of a run on a probe with a small memory."""
    settings = {"lr": 3e-3, "lr_schedule": Schedule.constant, "gamma": 0.99, "minibatch_size": 128}
    settings |= {"sequence_length": 8}
    return Config(
        env=EnvConfig(name="custom", backend=Backend.custom, factory="probes:make", params={"probe": probe}),
        model=ModelConfig(
            **({"hidden": [16], "normalize_obs": False, "memory": MemoryKind.lstm, "memory_size": 16} | model)
        ),
        ppo=PPOConfig(**(settings | (ppo or {}))),
        collect=CollectConfig(rounds=rounds),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )


# --- the module


@pytest.mark.parametrize("kind", KINDS)
def test_a_sequence_is_its_decisions_one_by_one(kind: MemoryKind) -> None:
    memory = Memory(3, kind, 8)
    features, state = torch.randn(5, 7, 3), torch.randn(5, 8)
    whole = memory.unroll(features, state)
    for step in range(7):
        out, state = memory(features[:, step], state)
        assert torch.allclose(out, whole[:, step], atol=1e-6)
    assert memory.size == (4 if kind is MemoryKind.lstm else 8)


def test_an_lstm_forgets_little_at_first() -> None:
    memory = Memory(3, MemoryKind.lstm, 8)
    bias = memory.layer.bias_ih_l0 + memory.layer.bias_hh_l0
    assert bias.tolist() == [0.0] * 4 + [2.0] * 4 + [0.0] * 8  # ML-Agents puts 1 into both vectors


# --- sequences


def test_sequences_by_hand() -> None:
    # slot 0 acts in rounds 0, 1, 3, 4 and ends in round 3; slot 1 acts in every round
    valued = np.array([[1, 1], [1, 1], [0, 1], [1, 1], [1, 1]], bool)
    ended = np.zeros((5, 2), bool)
    ended[3, 0] = True
    first = np.zeros((5, 2), bool)
    first[4, 0] = True
    view = DecisionView.of(valued, np.array([True, True]), ended)
    found = cut_sequences(view, first, valued, 3)
    assert found.slots.tolist() == [0, 0, 1, 1]
    assert found.rounds.tolist() == [[0, 1, 3], [4, 4, 4], [0, 1, 2], [3, 4, 4]]
    assert found.valid.tolist() == [[True] * 3, [True, False, False], [True] * 3, [True, True, False]]
    used = valued.copy()
    used[:, 0] = False
    assert cut_sequences(view, first, used, 3).slots.tolist() == [1, 1]


# --- collecting


@pytest.mark.parametrize("kind", [MemoryKind.lstm, MemoryKind.traces])
@pytest.mark.parametrize("probe", ["Staggered", "EarlyDeath", "TimeLimit", "RealEnd"])
def test_a_memory_is_zero_at_first_frozen_while_nobody_asks_and_carried_over(
    probe: str, kind: MemoryKind, tmp_path: Path
) -> None:
    with set_up(options(probe, memory=kind), tmp_path) as setup, setup.collecting() as batches:
        actor: Any = setup.learners["Probe"].actor
        parts = [next(batches).of("Probe")[0] for _ in range(3)]
        rounds = torch.cat([part.exclude("next") for part in parts], 0)
        done = torch.cat([part["next", "done"] for part in parts], 0)

        first, acting = rounds[keys.FIRST], rounds[keys.ACTING]
        assert first.any() and not (first & ~acting).any()
        assert (rounds[keys.MEMORY][first.expand_as(rounds[keys.MEMORY])] == 0).all()

        after = actor.draw(rounds).memory
        expected = torch.where(acting, after, rounds[keys.MEMORY])[:-1]
        goes_on = acting[1:] & ~first[1:]
        assert goes_on.any()
        difference = (rounds[keys.MEMORY][1:] - expected).abs() * goes_on
        assert difference.max() < 1e-6
        # a decision after an end is a first one
        assert (first[1:] | ~acting[1:])[done[:-1]].all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("critic", list(CriticKind))
@pytest.mark.parametrize("probe", ["Staggered", "EarlyDeath", "MateKnows", "TimeLimit"])
def test_the_first_minibatch_has_ratio_one_and_its_old_values(
    probe: str, critic: CriticKind, kind: MemoryKind, tmp_path: Path
) -> None:
    cfg = options(probe, memory=kind, critic=critic, ppo={"minibatch_size": 10**6, "epochs": 1, "lr": 1e-12})
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        learner = setup.learners["Probe"]
        for _ in range(3):
            buffer, _ = learner.prepare(*next(batches).of("Probe"))
            assert buffer is not None
            carried = learner.carried.rounds
            if carried is not None:  # who is not pending does not begin an episode there
                assert not (carried[keys.FIRST] & ~carried["valued"]).any()
            minibatch = learner.rows.take(buffer[:])
            learner.loss(minibatch)
            assert learner.loss.log_ratio.abs().max() < 1e-5

            # the critic's sequences give the values that were read round by round
            with torch.no_grad():
                value, baseline = learner.loss._values(minibatch)
            mask = minibatch["critic_learns"]
            assert mask.any()
            # each value that is known is learnt once, also those of members that have departed
            assert int(mask.sum()) == int(learner.rows._rounds["critic_learns"].sum())
            assert (value - minibatch[keys.VALUE])[mask].abs().max() < 1e-4
            if baseline is not None:
                assert (baseline - minibatch["baseline"])[minibatch["actor_learns"]].abs().max() < 1e-4


# --- learning


def learn(cfg: Config, tmp_path: Path, iterations: int) -> Any:
    """Train on a probe; return its last batch's entries."""
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        for _ in range(iterations):
            setup.learn(next(batches), 0.0)
        return next(batches).of("Probe")[0]


def learns(cfg: Config, tmp_path: Path, most: int) -> bool:
    """Train on a probe; return whether nearly all answers of three batches in a row are right in time.

    When a run finds out is luck, also of the processor's last digits: `most` iterations leave room for that.
    """
    streak = 0
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        for _ in range(most):
            batch = next(batches)
            streak = streak + 1 if share_right(batch.of("Probe")[0]) > 0.95 else 0
            if streak == 3:
                return True
            setup.learn(batch, 0.0)
    return False


def share_right(batch: Any) -> float:
    """Return how many of the answers were right, of the first members of the teams."""
    due = (batch["observation"][..., 0, 1] == 1) & batch[keys.ACTING][..., 0, 0]
    earned = batch["next", "reward"] + batch["next", "group_reward"]
    return float((earned[..., 0, 0][due] > 0).float().mean())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("probe", "rounds", "most", "model"),
    [
        ("Recall", 44, 200, {"memory": MemoryKind.lstm}),
        ("Recall", 44, 200, {"memory": MemoryKind.gru}),
        ("LongRecall", 122, 600, {"memory": MemoryKind.lstm}),
        ("LongRecall", 122, 600, {"memory": MemoryKind.gru}),
        ("StaggeredRecall", 124, 200, {"memory": MemoryKind.lstm}),
        ("TeamRecall", 44, 200, {"memory": MemoryKind.lstm, "critic": CriticKind.central}),
        ("TeamRecall", 44, 200, {"memory": MemoryKind.lstm, "critic": CriticKind.poca}),
        ("Recall", 44, 200, {"memory": MemoryKind.traces}),
        (
            "LongRecall",
            122,
            600,
            {"memory": MemoryKind.traces, "memory_traces": [0.98], "normalize_obs": True},
        ),
        ("StaggeredRecall", 124, 200, {"memory": MemoryKind.traces}),
        ("TeamRecall", 44, 200, {"memory": MemoryKind.traces, "critic": CriticKind.central}),
        ("TeamRecall", 44, 200, {"memory": MemoryKind.traces, "critic": CriticKind.poca}),
    ],
)
def test_what_was_seen_long_ago_is_known(
    probe: str, rounds: int, most: int, model: dict[str, Any], tmp_path: Path
) -> None:
    cfg = options(probe, rounds, {"sequence_length": 64, "minibatch_size": 256, "lr": 5e-3}, **model)
    assert learns(cfg, tmp_path, most)


@pytest.mark.slow
@pytest.mark.parametrize("probe", ["Recall", "TeamRecall"])
def test_without_a_memory_it_is_not(probe: str, tmp_path: Path) -> None:
    cfg = options(probe, 440, memory=MemoryKind.none)
    # 640 answers at chance: 4 standard errors of a half are 0.08
    assert share_right(learn(cfg, tmp_path, 10)) < 0.6


# --- runs

SMALL = ["env=Hallway", "env.num_areas=4", "model.hidden=[16]", "model.memory_size=8", "log.progress=false"]
SMALL += ["collect.batch_size=256", "ppo.minibatch_size=128", "ppo.sequence_length=16", "log.loggers=[]"]


@pytest.mark.parametrize("kind", ["lstm", "gru", "traces"])
def test_a_run_is_resumed_to_the_bit_and_its_export_plays_alike(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [*SMALL, f"model.memory={kind}", "ppo.lr_schedule=constant", "ppo.entropy_schedule=constant"]
    assert train_main([*lines, "max_steps=1024", "hydra.run.dir=whole"]) == 0
    assert train_main([*lines, "max_steps=512", "hydra.run.dir=parts"]) == 0
    assert train_main(["resume=parts", "max_steps=1024"]) == 0
    newest = (sorted(Path(name, "checkpoints").glob("step_*.pt"))[-1] for name in ("whole", "parts"))
    one, two = map(checkpoint.load, newest)
    for part in ("actor", "critic"):
        saved = one["learners"]["Hallway"][part], two["learners"]["Hallway"][part]
        assert all(torch.equal(saved[0][name], saved[1][name]) for name in saved[0])
    assert torch.equal(one["memories"]["Hallway"], two["memories"]["Hallway"])

    # the export was compared with the actor when it was written, its memory too
    assert Path("whole/checkpoints/final.onnx").is_file()
    assert eval_main(["run=whole/checkpoints/final.onnx", "env=Hallway", "episodes=2"]) == 0
    assert eval_main(["run=whole", "episodes=2", "deterministic=true"]) == 0
    assert "no ONNX file" not in capsys.readouterr().out


def test_a_policy_remembers_each_agent_until_its_episode_ends(tmp_path: Path) -> None:
    from mappo_unity.scenes import make_scene

    assert train_main([*SMALL, "model.memory=lstm", "max_steps=256", f"hydra.run.dir={tmp_path}/run"]) == 0
    (path,) = Path(tmp_path, "run", "checkpoints").glob("step_*.pt")
    policy = CheckpointPolicy(path, deterministic=True)
    scene = make_scene("Hallway", seed=0, num_areas=2)
    scene.reset()
    (name,) = scene.behavior_specs
    steps, _ = scene.get_steps(name)
    policy.act(name, steps, scene.behavior_specs[name])
    remembered = policy._memories[name]
    assert sorted(remembered) == sorted(steps.agent_id.tolist())
    agent = int(steps.agent_id[0])
    policy.forget(name, [agent])
    assert agent not in remembered and len(remembered) == 1


# --- options


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["model.memory=rnn"], "model.memory=rnn"),
        (["model.memory=lstm", "model.memory_size=7"], "must be even with model.memory=lstm"),
        (["model.memory=gru", "model.share_parameters=false"], "needs model.share_parameters=true"),
        (["model.memory=traces", "model.share_parameters=false"], "needs model.share_parameters=true"),
        (["model.memory=traces", "model.memory_traces=[]"], "leaves nothing to model.memory=traces"),
        (["model.memory_traces=[1]"], "model.memory_traces=1.0 is out of range"),
        (["model.memory_traced=[3]"], r"model.memory_traced=\[3\] must hold runs of columns"),
        (["ppo.sequence_length=0"], "ppo.sequence_length=0 is out of range"),
        (["model.critic=poca", "model.share_parameters=false"], "model.critic=poca needs"),
        (["ppo.value_norm_update=minibatch"], "does not go with ppo.normalize_values=popart"),
    ],
)
def test_options_that_do_not_fit_are_refused(lines: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        compose_config(lines)
