"""Batches hold every observation once: what `next` held besides, values read from it are as they were."""

from __future__ import annotations

import copy
import random
from pathlib import Path
from typing import Any

import pytest
import torch
from fakes import Record, ScriptedEnv, behavior_spec
from masked import whole
from tensordict import TensorDictBase

from mappo_unity import keys
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
)
from mappo_unity.envs.following import FollowedEnv
from mappo_unity.envs.transforms import make_transforms
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.training.collection.batches import BatchCollector
from mappo_unity.training.collection.worker import make_collector
from mappo_unity.training.setup import set_up

NAMES = ("One?team=0", "Soccer?team=0", "Soccer?team=1")
MODELS: list[dict[str, Any]] = [
    {},
    {"critic": CriticKind.mean},
    {"critic": CriticKind.poca},
    {"share_parameters": False},
    {"memory": MemoryKind.lstm},
    {"memory": MemoryKind.gru, "critic": CriticKind.poca},
    {"memory": MemoryKind.traces},
]


def restless(seed: int) -> Any:
    """Return a BaseEnv of agents that end, are cut off and are asked at random: one policy and two sides."""
    rng = random.Random(seed)
    script = []
    for step in range(400):
        rows = []
        for agent in range(9):
            place = {"behavior": NAMES[agent % 3], "group": agent // 6 + 1}
            end = rng.choice([None] * 8 + ["interrupted", "terminated"]) if step else None
            if end is not None:
                rows.append(Record(agent, obs=rng.random(), reward=rng.random(), ends=end, **place))
            if end is not None or not step or rng.random() < 0.7 or agent == 0:
                rows.append(Record(agent, obs=rng.random(), reward=rng.random(), **place))
        script.append(rows)
    return ScriptedEnv(script, {name: behavior_spec(2) for name in NAMES})


def options(model: dict[str, Any]) -> Config:
    """Return the options of a training run on `restless`."""
    return Config(
        env=EnvConfig(name="custom", backend=Backend.custom, factory="test_following:restless"),
        model=ModelConfig(hidden=[8], memory_size=8, **model),
        ppo=PPOConfig(minibatch_size=16),
        collect=CollectConfig(batch_size=90),
        log=LogConfig(loggers=[], progress=False),
        max_steps=10**9,
    )


class Unreduced(FollowedEnv):
    """A `FollowedEnv` that keeps ``next`` as it was."""

    full: list[TensorDictBase]

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        out = super().step_and_maybe_reset(tensordict)
        self.full.append(self._last)
        return out


def values_of(learner: PolicyLearner, *batch: TensorDictBase) -> tuple[Any, dict[str, float]]:
    """Return what the critic says of a batch, and the metrics of preparing it."""
    seen, read = [], learner.reader.read
    learner.reader.read = lambda *inputs: seen.append(read(*inputs)) or seen[0]  # type: ignore[func-returns-value]
    _, metrics = learner.prepare(*batch)
    learner.reader.read = read
    return seen[0], metrics


@pytest.mark.parametrize("model", MODELS, ids=str)
def test_values_are_those_of_a_batch_whose_next_is_whole(model: dict[str, Any], tmp_path: Path) -> None:
    cfg = options(model)
    with set_up(cfg, tmp_path) as setup:
        env = Unreduced(setup.env, make_transforms(setup.env), cache_specs=True)
        env.full = []
        batches = BatchCollector(make_collector(env, setup.policy), setup.env, cfg.collect)
        twins = {name: copy.deepcopy(learner) for name, learner in setup.learners.items()}
        cut_off = 0

        for _ in range(3):
            batch = next(batches)
            full, env.full[:] = torch.stack(env.full), []
            for name, learner in setup.learners.items():
                rounds, following = batch.of(name)
                kept = {keys.REWARD, keys.GROUP_REWARD, keys.DONE, keys.TERMINATED, keys.TRUNCATED}
                assert set(rounds.get("next").keys()) == kept

                reference = rounds.copy()
                reference.set("next", full.get(name))
                (own, metrics), (theirs, expected) = (
                    values_of(learner, rounds, following),
                    values_of(twins[name], *whole(reference)),
                )
                truncated = torch.zeros_like(own.end, dtype=torch.bool)
                truncated[len(truncated) - len(rounds) :] = rounds.get(("next", keys.TRUNCATED))
                cut_off += int(truncated.sum())
                assert torch.equal(own.value, theirs.value) and torch.equal(own.final, theirs.final)
                torch.testing.assert_close(own.end[truncated], theirs.end[truncated])
                assert metrics == pytest.approx(expected, abs=1e-4)

        assert cut_off > 10
        assert any(learner.carried.rounds is not None for learner in setup.learners.values())
