"""The VMAS bench's environment: the contract, VMAS' own numbers, ends, snapshots, training."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from mappo_unity.config.compose import compose_config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.training.trainer import train

pytest.importorskip("vmas", reason="needs the package vmas (extra 'bench')")

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
sys.path.insert(0, str(SCRIPTS))

import bench_vmas  # noqa: E402
import vmas  # noqa: E402
import vmas_env  # noqa: E402
from gym.spaces import Box  # noqa: E402
from mlagents_envs.base_env import ActionTuple  # noqa: E402
from vmas.simulator.environment import Environment  # noqa: E402

AGENTS = {name: task.agents for name, task in bench_vmas.TASKS.items()}


def make(scenario, num_envs=5, max_steps=7, seed=3, **params):
    return vmas_env.make(seed, scenario, num_envs, max_steps, n_agents=AGENTS[scenario], **params)


def behavior(env):
    (name,) = env.behavior_specs
    return name


def draw(env, rng):
    spec = env.behavior_specs[behavior(env)].action_spec
    count = len(env.get_steps(behavior(env))[0])
    return rng.uniform(-1, 1, (count, spec.continuous_size)).astype(np.float32)


def play(env, actions):
    """Set the same actions and step; return the records."""
    env.set_actions(behavior(env), ActionTuple(actions))
    env.step()
    return env.get_steps(behavior(env))


@pytest.mark.parametrize("scenario", AGENTS)
def test_it_keeps_the_contract_and_its_snapshots_repeat(scenario):
    report = check_env(make(scenario), steps=40, remake=lambda: make(scenario))
    assert report.interrupted > 0
    assert {"get_state/set_state", "seed"} <= set(report.checks)


def test_ids_and_groups_count_environments():
    env = make("navigation", num_envs=2)
    decisions, terminals = env.get_steps(behavior(env))
    assert behavior(env) == "navigation?team=0"
    assert decisions.agent_id.tolist() == [0, 1, 2, 3, 4, 5]
    assert decisions.group_id.tolist() == [1, 1, 1, 2, 2, 2]
    assert len(terminals) == 0


@pytest.mark.parametrize("scenario", AGENTS)
def test_observations_and_rewards_are_those_of_vmas(scenario):
    """VMAS played by its own interface, from the same start, with the same actions."""
    env = make(scenario, num_envs=4, max_steps=100)
    with env._own_rng():
        own = vmas.make_env(scenario, 4, seed=0, n_agents=AGENTS[scenario])
    own.step([torch.zeros(4, 2) for _ in own.agents])
    for mine, theirs in zip(env.vmas.world.entities, own.world.entities):
        for name in ("pos", "vel", "rot", "ang_vel"):
            setattr(theirs.state, name, getattr(mine.state, name).clone())
    for mine, theirs in zip(env.vmas.agents, own.agents):  # the last distances, which rewards count from
        if hasattr(mine, "pos_shaping"):
            theirs.pos_shaping = mine.pos_shaping.clone()
    if hasattr(env.vmas.scenario, "global_shaping"):
        own.scenario.global_shaping = env.vmas.scenario.global_shaping.clone()
    rng = np.random.default_rng(0)
    for _ in range(10):
        actions = draw(env, rng)
        per_agent = torch.from_numpy(actions).view(4, -1, 2).unbind(1)
        obs, rewards, done, _ = own.step([a.clone() for a in per_agent])
        decisions, terminals = play(env, actions)
        assert not len(terminals) and not done.any()
        expected = torch.stack(obs, 1).flatten(0, 1).numpy()
        np.testing.assert_array_equal(decisions.obs[0], expected)
        np.testing.assert_array_equal(decisions.reward, torch.stack(rewards, 1).flatten().numpy())
        assert not decisions.group_reward.any()


def test_the_time_limit_interrupts_whole_teams_and_the_next_episode_comes_with_it():
    env = make("simple_spread", num_envs=3, max_steps=4)
    rng = np.random.default_rng(0)
    for round_ in range(1, 9):
        decisions, terminals = play(env, draw(env, rng))
        assert decisions.agent_id.tolist() == list(range(9))
        assert terminals.agent_id.tolist() == (list(range(9)) if round_ % 4 == 0 else [])
        assert terminals.interrupted.all()
        if round_ % 4 == 0:
            assert (terminals.reward < 0).all()  # minus distances: the last step's, paid with the end
            assert (decisions.reward == 0).all()
            assert not np.isclose(decisions.obs[0][:, :2], terminals.obs[0][:, :2]).any(1).all()
            assert (decisions.obs[0][:, 2:4] == 0).all()  # new agents stand still


def test_what_the_scenario_ends_is_no_interruption():
    """A package on its goal ends balance for good, there alone."""
    env = make("balance", num_envs=3, max_steps=50)
    goal = env.vmas.scenario.package.goal
    goal.state.pos[1] = env.vmas.scenario.package.state.pos[1]
    _, terminals = play(env, np.zeros((12, 2), np.float32))
    assert terminals.agent_id.tolist() == [4, 5, 6, 7]
    assert not terminals.interrupted.any()


@pytest.mark.parametrize("scenario", AGENTS)
def test_new_episodes_leave_the_other_environments_as_they_were(scenario):
    """VMAS' own `reset_at` of the same environments is the judge."""
    over, rng = torch.tensor([False, True, False, True, False]), np.random.default_rng(1)
    env, own = make(scenario, max_steps=100), make(scenario, max_steps=100)
    for _ in range(5):
        actions = draw(env, rng)
        play(env, actions), play(own, actions)
    env._renew(over)
    for index in (1, 3):
        own.vmas.reset_at(index, return_observations=False)
    renewed = np.repeat(over.numpy(), AGENTS[scenario])
    assert not (env._rows(env._observe())[renewed] == own._rows(own._observe())[renewed]).all()
    for _ in range(5):
        actions = draw(env, rng)
        (mine, _), (theirs, _) = play(env, actions), play(own, actions)
        np.testing.assert_array_equal(mine.obs[0][~renewed], theirs.obs[0][~renewed])
        np.testing.assert_array_equal(mine.reward[~renewed], theirs.reward[~renewed])


@pytest.mark.parametrize("scenario", AGENTS)
def test_a_snapshot_goes_on_the_same_in_another_environment(scenario):
    rng = np.random.default_rng(2)
    env, other = make(scenario), make(scenario, seed=9)
    for _ in range(10):
        play(env, draw(env, rng))
    other.set_state(env.get_state())
    for _ in range(10):  # over the next ends, so the random numbers go on too
        actions = draw(env, rng)
        for mine, theirs in zip(play(env, actions), play(other, actions)):
            np.testing.assert_array_equal(mine.obs[0], theirs.obs[0])
            np.testing.assert_array_equal(mine.reward, theirs.reward)
            np.testing.assert_array_equal(mine.agent_id, theirs.agent_id)


def test_environments_do_not_share_random_numbers():
    """VMAS keeps one stream for all environments of a process; each of ours has its own."""
    alone, beside = make("simple_spread"), make("simple_spread")
    other = make("simple_spread", seed=8)
    for _ in range(2):
        other.reset()
        alone.reset()
    for _ in range(2):
        beside.reset()
    np.testing.assert_array_equal(alone._records[0].obs[0], beside._records[0].obs[0])


def test_actions_are_scaled_to_the_scenarios_range(monkeypatch):
    spaces = [Box(np.float32([-0.5, 0]), np.float32([0.5, 1])) for _ in range(3)]
    monkeypatch.setattr(Environment, "get_action_space", lambda self: spaces)
    env = make("simple_spread")
    given = []
    monkeypatch.setattr(env.vmas, "step", lambda actions: given.extend(actions) or real(actions))
    real = type(env.vmas).step.__get__(env.vmas)
    play(env, np.tile(np.float32([1, -1]), (15, 1)))
    assert torch.stack(given).flatten(0, 1).unique(dim=0).tolist() == [[0.5, 0.0]]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"scenario": "navigatoin"}, "navigation"),
        ({"scenario": "navigation", "num_envs": 0}, "num_envs=0 .* must be >= 1"),
        ({"scenario": "navigation", "max_steps": -1}, "max_steps=-1 .* must be >= 1"),
        ({"scenario": "simple_speaker_listener"}, "its agents differ"),
    ],
)
def test_mistakes_are_refused(params, message):
    with pytest.raises(ConfigError, match=message):
        vmas_env.make(0, **params)


def test_the_bench_composes_every_task_and_the_options_reach_the_environment():
    for name, task in bench_vmas.TASKS.items():
        cfg = compose_config(bench_vmas.options(name, 1, 600)).config
        assert cfg.max_steps == 600 * task.agents
        assert make_env_function(cfg.env)(0).num_agents == task.agents


def test_training_runs_and_resumes_to_the_bit(tmp_path):
    options = [*bench_vmas.options("navigation", 1, 600), "collect.rounds=5", "ppo.epochs=1"]
    options += ["env.params.num_envs=8", "env.params.max_steps=6", "ppo.minibatch_size=60"]

    def run(steps, folder, resume_from=None):
        cfg = compose_config([*options, f"max_steps={steps}", "ppo.lr_schedule=constant"]).config
        folder.mkdir(exist_ok=True)
        outcome = train(cfg, folder, resume_from)
        return outcome.last_checkpoint

    run(480, tmp_path / "whole")
    half = run(240, tmp_path / "halves")
    run(480, tmp_path / "halves", half)
    tables = []
    for folder in ("whole", "halves"):
        with open(tmp_path / folder / "metrics.csv") as file:
            tables.append(list(csv.DictReader(file)))
    whole, halves = tables
    assert [row["agent_steps"] for row in whole] == [row["agent_steps"] for row in halves]
    for column in ("return_mean", "policy_loss", "value_loss", "kl"):
        assert [row[column] for row in whole] == [row[column] for row in halves], column


@pytest.mark.slow
def test_navigation_is_learned_within_60000_frames():
    """As BenchMARL does it; its figure and the exact goal stand in docs/benchmarks/vmas.md."""
    run = bench_vmas.Run("navigation", 0, 60_000, [])
    run.train()
    assert max(value for _, value in run.curve) >= 0.95
