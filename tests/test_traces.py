"""Traces of critics and actors: whose they are, what they average, what is learnt, exact resume, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.cli import train_main
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
from mappo_unity.learning.networks.actor_critic import make_actor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout, running_norms
from mappo_unity.learning.networks.traces import ObservationTraces, TracingActor, runs_of
from mappo_unity.runs import checkpoint
from mappo_unity.training.setup import set_up

DECAYS = [0.5, 0.9]


def options(probe: str, rounds: int = 12, ppo: dict[str, Any] | None = None, **model: Any) -> Config:
    """Return the options of a run on a probe whose critic has traces."""
    settings = {"lr": 3e-3, "lr_schedule": Schedule.constant, "minibatch_size": 10**6, "sequence_length": 8}
    return Config(
        env=EnvConfig(name="custom", backend=Backend.custom, factory="probes:make", params={"probe": probe}),
        model=ModelConfig(**({"hidden": [16], "normalize_obs": False, "critic_traces": DECAYS} | model)),
        ppo=PPOConfig(**(settings | (ppo or {}))),
        collect=CollectConfig(rounds=rounds),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )


# --- the module


def test_traces_by_hand() -> None:
    # columns 2 and 0 of three, one agent that does not decide in the second row and begins anew in the last
    net = ObservationTraces([0.5], [2, 0])
    obs = torch.tensor([[8.0, 0.0, 4.0], [9.0, 9.0, 9.0], [0.0, 1.0, 2.0], [16.0, 5.0, 32.0]])
    first = torch.tensor([[True], [False], [False], [True]])
    acting = torch.tensor([[True], [False], [True], [True]])
    rows = net.walk(torch.full((3,), 7.0), obs, first, acting)
    assert rows.tolist() == [[2.0, 4.0, 0.5], [2.0, 4.0, 0.5], [2.0, 2.0, 0.75], [16.0, 8.0, 0.5]]
    assert net.size == 3
    assert not list(net.parameters()) and not net.state_dict()


def test_an_encoder_reads_the_traces_of_normalised_observations() -> None:
    torch.manual_seed(0)
    encoder = Encoder(ObsLayout(5, traces=(0.5, 0.9), traced=(1, 4)), normalize=True)
    (norm,) = running_norms(encoder)
    rows = torch.randn(50, 5) * torch.tensor([1.0, 2.0, 3.0, 0.1, 5.0]) + 1
    norm.update(rows)
    net = encoder.traces
    assert net is not None and encoder.size == 5 + net.size == 11

    flags = torch.ones(8, 1, dtype=torch.bool)
    start = torch.zeros(net.size)
    of_plain = net.walk(start, rows[:8], ~flags, flags)
    of_normalised = net.walk(start, norm(rows[:8]), ~flags, flags)
    assert torch.allclose(
        encoder(rows[:8], of_plain), torch.cat([norm(rows[:8]), of_normalised], -1), atol=1e-5
    )


# --- batches


def walked(state: Tensor, entries: TensorDictBase, decays: list[float]) -> Tensor:
    """Return the traces of all columns after one row, slot by slot and column by column."""
    out = state.clone()
    flat, obs = out.view(-1, out.shape[-1]), entries[keys.OBS].flatten(0, -2)
    for slot in range(len(flat)):
        if entries[keys.FIRST].flatten()[slot]:
            flat[slot] = 0.0
        if entries[keys.ACTING].flatten()[slot]:
            seen = [*obs[slot].tolist(), 1.0]
            for place, value in enumerate(flat[slot].tolist()):
                decay = decays[place // len(seen)]
                flat[slot, place] = decay * value + (1 - decay) * seen[place % len(seen)]
    return out


@pytest.mark.parametrize("probe", ["Staggered", "EarlyDeath", "TimeLimit", "RealEnd", "MateKnows"])
def test_traces_go_on_from_batch_to_batch(probe: str, tmp_path: Path) -> None:
    with set_up(options(probe, rounds=7), tmp_path) as setup, setup.collecting() as batches:
        reader = setup.learners["Probe"].reader
        state = None
        for _ in range(3):
            batch, following = next(batches).of("Probe")
            traced, after = reader.traced(batch, following)
            assert keys.TRACES not in batch.keys()  # the caller's entries stay as they are
            assert keys.TRACES not in following[keys.FINAL].keys()

            rows = traced[keys.TRACES]
            if state is None:
                state = torch.zeros(rows.shape[1:])
            for row in range(len(rows)):
                state = walked(state, batch[row], DECAYS)
                assert torch.allclose(rows[row], state, atol=1e-6)

            final = after[keys.FINAL]
            assert torch.allclose(final[keys.TRACES], walked(state, following[keys.FINAL], DECAYS), atol=1e-6)

            # what was seen at a cut is one more decision of everybody
            cut_off, at = after[keys.CUT_OFF], following[keys.CUT_OFF_AT]
            before = rows.flatten(0, -3)[at]
            assert torch.equal(cut_off[keys.TRACES], reader.traces.after(before, cut_off[keys.OBS]))
            assert len(at) or probe != "TimeLimit"


@pytest.mark.parametrize("memory", [MemoryKind.none, MemoryKind.gru, MemoryKind.traces])
@pytest.mark.parametrize("critic", list(CriticKind))
@pytest.mark.parametrize("probe", ["Staggered", "EarlyDeath", "TimeLimit"])
def test_the_first_minibatch_has_ratio_one_and_its_old_values(
    probe: str, critic: CriticKind, memory: MemoryKind, tmp_path: Path
) -> None:
    cfg = options(probe, critic=critic, memory=memory, ppo={"epochs": 1, "lr": 1e-12})
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        learner = setup.learners["Probe"]
        assert learner.actor.has_memory == (memory is not MemoryKind.none)
        assert keys.TRACES not in learner.actor.obs_keys
        for _ in range(3):
            buffer, _ = learner.prepare(*next(batches).of("Probe"))
            assert buffer is not None
            minibatch = learner.rows.take(buffer[:])
            learner.loss(minibatch)
            assert learner.loss.log_ratio.abs().max() < 1e-5

            with torch.no_grad():
                value, _ = learner.loss._values(minibatch)
            mask = minibatch.get("critic_learns", torch.ones_like(value, dtype=torch.bool))
            assert mask.any()
            assert (value - minibatch[keys.VALUE])[mask].abs().max() < 1e-4


# --- learning


@pytest.mark.parametrize("extra", [{}, {"share_parameters": False}])
def test_a_critic_with_traces_knows_how_long_an_episode_has_lasted(
    extra: dict[str, Any], tmp_path: Path
) -> None:
    # nothing is observed, and each episode ends with the fifth decision
    cfg = options("RealEnd", 20, {"lr": 1e-2, "minibatch_size": 128, "gamma": 0.99}, **extra)
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        learner = setup.learners["Probe"]
        for _ in range(60):
            setup.learn(next(batches), 0.0)
        batch, _ = learner.reader.traced(*next(batches).of("Probe"))
        with torch.no_grad():
            value = learner.reader.values_of(batch)

    first, last = batch[keys.FIRST], batch["next", keys.TERMINATED]
    assert first.any() and last.any()
    assert value[first].mean().item() == pytest.approx(sum(0.99**k for k in range(5)), abs=0.3)
    assert value[last].mean().item() == pytest.approx(1.0, abs=0.3)


# --- runs


SMALL = ["env=DungeonEscape", "env.num_areas=4", "model.hidden=[16]", "log.progress=false", "log.loggers=[]"]
SMALL += ["model.critic_traces=[0.8,0.95]", "model.critic_traced=[0,10,370,1]"]
SMALL += ["collect.batch_size=256", "ppo.minibatch_size=128", "ppo.lr_schedule=constant"]
SMALL += ["ppo.entropy_schedule=constant", "ppo.gamma_schedule=constant"]


@pytest.mark.parametrize("learners", [1, 2])
def test_a_run_is_resumed_to_the_bit(learners: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [*SMALL, f"learners={learners}"]
    assert train_main([*lines, "max_steps=1024", "hydra.run.dir=whole"]) == 0
    assert train_main([*lines, "max_steps=512", "hydra.run.dir=parts"]) == 0
    assert train_main(["resume=parts", "max_steps=1024"]) == 0

    last = [max(Path(run, "checkpoints").glob("step_*.pt")) for run in ("whole", "parts")]
    assert last[0].name == last[1].name
    states = [checkpoint.load(path) for path in last]
    one, two = (state["learners"]["DungeonEscape"] for state in states)
    for part in ("actor", "critic", "critic_states"):
        assert one[part].keys() == two[part].keys()
        assert all(torch.equal(one[part][name], two[part][name]) for name in one[part])
    assert one["critic_states"][keys.TRACES].shape == (4, 3, 2 * 12)
    assert one["critic_states"][keys.TRACES].any()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["model.critic_traces=[1.0]"], "model.critic_traces=1.0 is out of range"),
        (["model.critic_traces=[0.9]", "model.critic_traced=[3]"], "must hold runs of columns"),
        (["model.critic_traces=[0.9]", "model.critic_traced=[-1,2]"], "must hold runs of columns"),
        (["model.critic_traces=[0.9]", "model.critic_traced=[0,0]"], "must hold runs of columns"),
    ],
)
def test_what_does_not_go_is_refused(lines: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose_config(["env=DungeonEscape", *lines])


def test_columns_that_are_not_there_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [*SMALL, "model.critic_traced=[365,7]", f"hydra.run.dir={tmp_path / 'run'}"]
    assert train_main(lines) == 2
    error = capsys.readouterr().err
    assert "names column 371; there are 371 columns of vector observations" in error
    assert "model.critic_traces=[] does without (DungeonEscape)" in error


def test_a_game_of_images_alone_has_nothing_to_trace() -> None:
    with pytest.raises(ConfigError, match="of which there are none"):
        ModelConfig(critic_traces=[0.9]).traces_of_critic(0)


def test_without_columns_all_are_traced() -> None:
    cfg = ModelConfig(critic_traces=[0.9])
    assert cfg.traces_of_critic(3) == ([0.9], [0, 1, 2])
    assert replace(cfg, critic_traced=[2, 1, 0, 1]).traces_of_critic(3)[1] == [2, 0]
    assert cfg.traces_of_actor(3) == ([], [])


def test_the_critic_remembers_what_the_actor_does_unless_it_is_told_otherwise() -> None:
    cfg = ModelConfig(memory=MemoryKind.traces, memory_traces=[0.5], memory_traced=[1, 2])
    assert cfg.traces_of_actor(4) == cfg.traces_of_critic(4) == ([0.5], [1, 2])
    own = replace(cfg, critic_traces=[0.9])
    assert own.traces_of_actor(4) == ([0.5], [1, 2]) and own.traces_of_critic(4) == ([0.9], [0, 1, 2, 3])
    with pytest.raises(ConfigError, match="names column 2; there are 2 columns .* model.memory=none does"):
        cfg.traces_of_actor(2)


@pytest.mark.parametrize("columns", [[], [3], [0, 1, 2], [0, 1, 7, 8, 9, 5], [2, 1, 0]])
def test_columns_as_runs(columns: list[int]) -> None:
    runs = runs_of(columns)
    pairs = zip(runs[::2], runs[1::2])
    assert [column for first, length in pairs for column in range(first, first + length)] == columns
    assert runs_of([0, 1, 2, 7]) == [0, 3, 7, 1]


# --- the actor


def tracing_actor() -> TracingActor:
    torch.manual_seed(0)
    cfg = ModelConfig(hidden=[8], memory=MemoryKind.traces, memory_traces=DECAYS)
    net: Any = make_actor(ObsLayout(3), ActionLayout(1, (2,)), 1, cfg)[0].module
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.normal_()
    return net


def test_an_actor_s_sequence_is_its_decisions_one_by_one() -> None:
    net = tracing_actor()
    obs, state = torch.randn(5, 7, 3), torch.randn(5, net.state_size)
    whole = net.unroll(obs, state)
    for place in range(7):
        params, state = net(obs[:, place], state)
        assert torch.allclose(params, whole[:, place], atol=1e-6)


def test_an_actor_hands_on_its_traces_and_acts_by_those_after_the_observation() -> None:
    net = tracing_actor()
    obs, state = torch.randn(5, 3), torch.randn(5, net.state_size)
    params, after = net(obs, state)
    assert torch.equal(after, net.traces.after(state, obs))
    assert torch.equal(params, net.actor(obs, after))
    assert not torch.allclose(params, net(obs, torch.zeros_like(state))[0])
    assert net.state_size == 8  # two decays, three columns and the 1
