"""Batches that hold what was asked for, decisions that are carried over, minibatches of even numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fakes import Record, ScriptedEnv

from mappo_unity import keys
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
    ValueNormKind,
)
from mappo_unity.envs.following import followed
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.minibatches import EvenSampler, minibatch_count
from mappo_unity.training.collection.batches import BatchCollector
from mappo_unity.training.collection.worker import make_collector
from mappo_unity.training.learners import make_learners
from mappo_unity.training.setup import set_up


def slow_agents(seed: int, every: int = 5, agents: int = 10) -> Any:
    """Return a BaseEnv of agents that are asked in every n-th step; one more asks always."""
    script = []
    for step in range(400):
        asked = [Record(agent, reward=1.0) for agent in range(agents)] if step % every == 0 else []
        script.append([*asked, Record(agents, reward=0.0)])
    return ScriptedEnv(script)


def options(env: Any, **collect: Any) -> Config:
    """Return the options of a training run on a function of this module."""
    return Config(
        env=EnvConfig(name="custom", backend=Backend.custom, factory=f"test_batches:{env.__name__}"),
        model=ModelConfig(hidden=[8], normalize_obs=False),
        ppo=PPOConfig(lr_schedule=Schedule.constant, normalize_values=ValueNormKind.none, gamma=1.0),
        collect=CollectConfig(**collect),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )


def decisions_learnt(learner: Any, batch: tuple[Any, Any]) -> int:
    """Return how many decisions an update of a batch would learn from."""
    buffer, _ = learner.prepare(*batch)
    if buffer is None:
        return 0
    rows = buffer[:]
    mask = rows.get("actor_learns", None)
    return rows.numel() if mask is None else int(mask.sum())


def test_a_batch_holds_what_was_asked_for_and_every_decision_is_learnt_once(tmp_path: Path) -> None:
    with set_up(options(slow_agents, batch_size=100), tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        collected, learnt = [], []
        for _ in range(4):
            batch = next(batches)
            collected.append(batch.count_decisions("Fake"))
            learnt.append(decisions_learnt(learner, batch.of("Fake")))

        # 10 agents in every fifth round and one in each: 15 decisions in five rounds
        assert all(100 <= count <= 111 for count in collected)
        pending = learner.carried.rounds
        waiting = 0 if pending is None else int(pending[keys.ACTING].sum())
        assert sum(learnt) == sum(collected) - waiting
        assert waiting <= 10


def dying_agents(seed: int, agents: int = 20) -> Any:
    """Return a BaseEnv of agents that end one by one, and come back together when the last has ended."""
    script: list[list[Record]] = []
    for step in range(2000):
        dead = step % agents
        ended = dead - 1 if dead else agents - 1
        last = [Record(ended, ends="terminated")] if step else []
        script.append([*last, *[Record(agent) for agent in range(dead, agents)]])
    return ScriptedEnv(script)


def test_a_batch_that_begins_with_few_agents_becomes_no_large_one(tmp_path: Path) -> None:
    with set_up(options(dying_agents, batch_size=1000), tmp_path) as setup, setup.collecting() as batches:
        # 210 decisions in 20 rounds; one that begins with the last agent may not take it for all there are
        counts = [next(batches).count_decisions("Fake") for _ in range(12)]
    assert min(counts) >= 1000 and max(counts) < 1000 + 210


def waiting_agent(seed: int) -> Any:
    """Return a BaseEnv in which agent 0 decides once, waits while agent 1 plays, and ends with reward 5."""
    script = [[Record(0), Record(1)], *([[Record(1, reward=1.0)]] * 5)]
    script.append([Record(0, ends="terminated", reward=5.0), Record(1), Record(0)])
    return ScriptedEnv(script + [[Record(0), Record(1)]] * 40)


def test_the_reward_of_a_decision_that_was_pending_is_not_lost(tmp_path: Path) -> None:
    with set_up(options(waiting_agent, rounds=3), tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()

        first, following = next(batches).of("Fake")
        learner.prepare(first, following)
        carried = learner.carried.rounds
        assert carried is not None and carried.shape[0] == 1
        assert carried[keys.ACTING].flatten().tolist() == [True, False]
        log_prob = first[keys.LOG_PROB][0, 0, 0]

        # its end comes with the last result of the next batch
        buffer, _ = learner.prepare(*next(batches).of("Fake"))
        assert buffer is not None
        rows = buffer[:]
        old = rows[keys.LOG_PROB].flatten() == log_prob
        assert old.any()
        assert rows[keys.VALUE_TARGET].flatten()[old].tolist() == pytest.approx([5.0])
        assert learner.carried.rounds is None


def test_what_is_pending_of_a_crashed_episode_is_forgotten(tmp_path: Path) -> None:
    with set_up(options(waiting_agent, rounds=3), tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        learner.prepare(*next(batches).of("Fake"))
        assert learner.carried.void(torch.tensor([[[True]], [[False]]])) == 1
        assert not learner.carried.rounds[keys.ACTING].any()


def test_episodes_travel_in_the_batch(tmp_path: Path) -> None:
    env = UnityEnv(waiting_agent, 0)
    cfg = options(waiting_agent, rounds=8)
    (learner,) = make_learners(cfg, env, 8, print).values()
    from mappo_unity.learning.networks.joint_policy import JointPolicy

    policy = JointPolicy({"Fake": learner.actor})
    batches = BatchCollector(make_collector(followed(env), policy), env, cfg.collect)
    (episode,) = next(batches).episodes["Fake?team=0"]
    assert episode.individual_return == 5.0 and not env.pop_episodes()["Fake?team=0"]


# --- minibatches


@pytest.mark.parametrize("count", [1, 3, 8])
def test_minibatches_hold_even_numbers_of_decisions(count: int) -> None:
    torch.manual_seed(0)
    decisions = torch.from_numpy(np.random.default_rng(0).integers(1, 5, 400))
    sampler = EvenSampler(decisions, count)
    parts = []
    while not sampler.ran_out:
        parts.append(sampler.sample(None, 0)[0])
    assert sorted(torch.cat(parts).tolist()) == list(range(400))
    sizes = [int(decisions[part].sum()) for part in parts]
    assert len(sizes) == count and max(sizes) - min(sizes) <= 8


def test_a_rest_gets_no_step_of_its_own() -> None:
    cfg = PPOConfig(minibatch_size=1024)
    assert [minibatch_count(cfg, n, n) for n in (4096, 4100, 4700, 100)] == [4, 4, 5, 1]
    assert minibatch_count(PPOConfig(num_minibatches=8), 100, 5) == 5


def staggered_team(seed: int) -> Any:
    """Return a BaseEnv of a team: agent 0 decides once and waits, its mate earns 1 in each round."""
    script = [[Record(0, group=1), Record(1, group=1)], *([[Record(1, group=1, reward=1.0)]] * 5)]
    ends = [Record(n, group=1, ends="terminated", reward=float(n)) for n in (0, 1)]
    script.append([*ends, Record(0, group=1), Record(1, group=1)])
    return ScriptedEnv(script + [[Record(0, group=1), Record(1, group=1)]] * 40)


def test_with_poca_a_pending_decision_earns_what_its_mates_earn(tmp_path: Path) -> None:
    cfg = options(staggered_team, rounds=3)
    cfg.model.critic = CriticKind.poca
    with set_up(cfg, tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        first, following = next(batches).of("Fake")
        learner.prepare(first, following)
        log_prob = first[keys.LOG_PROB][0, 0, 0]
        buffer, _ = learner.prepare(*next(batches).of("Fake"))
        rows = buffer[:]
        old = rows[keys.LOG_PROB] == log_prob
        assert rows[keys.VALUE_TARGET].squeeze(-1)[old].tolist() == pytest.approx([6.0])
