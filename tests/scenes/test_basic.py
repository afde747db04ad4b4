"""Basic against numbers worked out by hand from its sheet."""

from __future__ import annotations

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.basic.scene import Basic
from mappo_unity.scenes.contract.check import check_env

NAME = "Basic?team=0"
STAY, LEFT, RIGHT = 0, 1, 2


def act(env: Basic, *moves: int) -> None:
    env.set_actions(NAME, ActionTuple(discrete=np.array(moves, np.int32)[:, None]))
    env.step()


def started(num_areas: int = 1) -> Basic:
    env = Basic(num_areas=num_areas)
    env.reset()
    return env


def test_spec_ids_and_start() -> None:
    env = started()
    spec = env.behavior_specs[NAME]
    assert list(env.behavior_specs) == [NAME] and env.num_areas == 1
    assert [(o.name, o.shape) for o in spec.observation_specs] == [("Basic", (20,))]
    assert spec.action_spec.continuous_size == 0 and spec.action_spec.discrete_branches == (3,)
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == [0] and decisions.group_id.tolist() == [0]
    assert decisions.obs[0].nonzero()[1].tolist() == [10] and decisions.obs[0].sum() == 1
    assert not decisions.action_mask[0].any() and len(terminals) == 0 and decisions.reward[0] == 0


@pytest.mark.parametrize(("move", "goal", "best"), [(RIGHT, 17, 0.93), (LEFT, 7, 0.07)])
def test_return_of_the_straight_way(move: int, goal: int, best: float) -> None:
    env = started()
    total = 0.0
    for _ in range(abs(goal - 10)):
        assert len(env.get_steps(NAME)[1]) == 0
        act(env, move)
        total += env.get_steps(NAME)[0].reward.sum()
    decisions, terminals = env.get_steps(NAME)
    assert terminals.agent_id.tolist() == [0] and terminals.interrupted.tolist() == [False]
    assert terminals.obs[0].nonzero()[1].tolist() == [goal]
    assert decisions.agent_id.tolist() == [1] and decisions.reward.tolist() == [0]
    assert decisions.obs[0].nonzero()[1].tolist() == [10]
    assert total + terminals.reward[0] == pytest.approx(best)


def test_new_ids_are_global_and_rows_follow_them() -> None:
    env = started(3)
    for _ in range(3):
        act(env, RIGHT, LEFT, STAY)
    decisions, terminals = env.get_steps(NAME)
    assert terminals.agent_id.tolist() == [1] and terminals.reward.tolist() == pytest.approx([0.09])
    assert decisions.agent_id.tolist() == [0, 2, 3]
    assert decisions.obs[0].nonzero()[1].tolist() == [13, 10, 10]
    act(env, STAY, LEFT, RIGHT)  # rows: area 0, area 2, area 1
    assert env.position.tolist() == [13, 11, 9]
    assert env.get_steps(NAME)[0].reward.tolist() == pytest.approx([-0.01] * 3)


def test_reset_moves_nobody_and_costs_one_idle_action() -> None:
    env = started(2)
    act(env, LEFT, RIGHT)
    act(env, LEFT, RIGHT)
    env.reset()
    decisions, terminals = env.get_steps(NAME)
    assert decisions.obs[0].nonzero()[1].tolist() == [8, 12] and decisions.agent_id.tolist() == [0, 1]
    assert decisions.reward.tolist() == pytest.approx([-0.01] * 2) and len(terminals) == 0


def test_contract() -> None:
    report = check_env(
        make_scene("Basic", num_areas=5), 300, remake=lambda: make_scene("Basic", seed=3, num_areas=5)
    )
    assert report.terminals > 20 and report.interrupted == 0 and report.terminal_only_steps == 0
