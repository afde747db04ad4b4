"""The example that makes VMAS a parallel environment: VMAS' own numbers, teams, ends, training."""

from __future__ import annotations

import csv
import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("vmas", reason="needs the package vmas (extra 'bench')")
pytest.importorskip("pettingzoo", reason="needs the package pettingzoo (extra 'farama')")

import vmas
from pettingzoo.test import parallel_api_test, parallel_seed_test

from mappo_unity.cli import train_main
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.pettingzoo.opening import open_copies

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    yield importlib.import_module("vmas_parallel")
    sys.modules.pop("vmas_parallel", None)


def test_what_agents_see_and_earn_is_what_vmas_says(example: Any) -> None:
    env = example.make(0, num_envs=2, n_agents=3, shared_rew=False)
    own = vmas.make_env("navigation", 2, seed=0, n_agents=3, shared_rew=False)

    seen, _ = env.reset(seed=7)
    expected = own.reset(seed=7)
    assert env.agents == [f"agent_{number}" for number in (0, 1, 2, 100, 101, 102)]
    np.testing.assert_array_equal(seen["agent_102"], expected[2][1])

    rng = np.random.default_rng(0)
    for _ in range(5):
        actions = {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}
        seen, rewards, *_ = env.step(actions)
        rows = [[actions[f"agent_{100 * copy + place}"] for copy in range(2)] for place in range(3)]
        expected, earned, _, _ = own.step([torch.from_numpy(np.stack(row)) for row in rows])
        for copy in range(2):
            for place in range(3):
                name = f"agent_{100 * copy + place}"
                np.testing.assert_array_equal(seen[name], expected[place][copy])
                assert rewards[name] == earned[place][copy].item()


def test_a_copy_that_ends_leaves_and_the_rest_play_on_to_the_limit(example: Any) -> None:
    env = example.make(0, scenario="balance", num_envs=2, max_steps=3, n_agents=3)
    env.reset(seed=0)
    scenario = env.vmas.scenario
    scenario.package.goal.state.pos[1] = scenario.package.state.pos[1]  # on its goal: ended for good

    zeros = {agent: np.zeros(2, np.float32) for agent in env.agents}
    _, _, terminated, truncated, _ = env.step(zeros)
    assert {agent for agent, over in terminated.items() if over} == {"agent_100", "agent_101", "agent_102"}
    assert not any(truncated.values())
    assert env.agents == ["agent_0", "agent_1", "agent_2"]

    for _ in range(2):
        _, _, terminated, truncated, _ = env.step({agent: zeros[agent] for agent in env.agents})
    assert truncated == dict.fromkeys(["agent_0", "agent_1", "agent_2"], True)
    assert not any(terminated.values()) and env.agents == []


def test_it_is_a_parallel_environment_and_each_copy_a_team(example: Any) -> None:
    parallel_api_test(example.make(0, num_envs=2, max_steps=10), num_cycles=30)
    parallel_seed_test(lambda: example.make(0, num_envs=2, max_steps=10), num_cycles=12)

    params = {"num_envs": 3, "max_steps": 6, "n_agents": 2}
    env = open_copies(example.make, "vmas", 0, params, 1, "vmas_parallel:copy_of")
    env.reset()
    decisions, _ = env.get_steps("agent")
    assert decisions.group_id.tolist() == [1, 1, 2, 2, 3, 3]
    assert check_env(env, steps=20).interrupted > 0


def test_mistakes_are_refused(example: Any, capsys: pytest.CaptureFixture[str]) -> None:
    lines = ["env=pettingzoo", "env.factory=vmas_parallel:make"]
    assert train_main([*lines, "env.params.scenario=navigatoin"]) == 2
    assert "navigatoin" in capsys.readouterr().err
    with pytest.raises(ValueError, match="101 agents; at most 100"):
        example.make(0, num_envs=1, n_agents=101, agent_radius=0.001)


def test_it_trains(example: Any, tmp_path: Path) -> None:
    lines = ["env=pettingzoo", "env.factory=vmas_parallel:make", "env.teams=vmas_parallel:copy_of"]
    lines += ["env.params.num_envs=4", "env.params.max_steps=5", "env.params.n_agents=2", "collect.rounds=10"]
    lines += ["max_steps=160", "model.hidden=[8]", "ppo.epochs=1", "export_onnx=false", "log.loggers=[]"]
    assert train_main([*lines, f"hydra.run.dir={tmp_path}"]) == 0

    with open(tmp_path / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    # 4 copies of 2 agents: 80 decisions in 10 rounds, in which every copy ends twice
    assert [int(row["agent_steps"]) for row in rows] == [80, 160]
    assert [int(row["episodes"]) for row in rows] == [16, 32]
