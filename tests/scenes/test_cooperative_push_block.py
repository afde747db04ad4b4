"""CooperativePushBlock against numbers worked out by hand from its facts."""

from __future__ import annotations

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.cooperative_push_block.scene import TIME_LIMIT, CooperativePushBlock

NAME = "PushBlockCollab?team=0"
NONE, FORWARD = 0, 1
WALL, AGENT, GOAL, SMALL, LARGE, VERY_LARGE = range(6)
FIRST_SMALL, FIRST_LARGE, FIRST_VERY_LARGE = 3, 5, 7  # bodies of an area


def cooperative(num_areas: int = 1, seed: int = 0) -> CooperativePushBlock:
    env = make_scene("CooperativePushBlock", num_areas=num_areas, seed=seed)
    assert isinstance(env, CooperativePushBlock)
    env.reset()
    return env


def place(env: CooperativePushBlock, **where: tuple[float, float]) -> None:
    """Put everything at rest along the wall ahead, heading ahead; then the named bodies elsewhere."""
    boxes = env.boxes
    parked = [-11.0, -9.0, -7.0, -5.0, -3.0, -0.5, 2.5, 6.0, 10.0]
    boxes.place[:] = np.stack([parked, np.full(9, 10.5)], axis=1)
    boxes.height[:] = boxes.rest
    boxes.yaw[:] = 0.0
    boxes.motion[:] = 0.0
    boxes.fall[:] = 0.0
    boxes.present[:] = True
    for name, spot in where.items():
        boxes.place[:, int(name.removeprefix("body_"))] = spot


def play(env: CooperativePushBlock, *actions: int) -> tuple[DecisionSteps, TerminalSteps]:
    """Set actions for the three agents of every area, and go on to the next report."""
    count = len(env.get_steps(NAME)[0])
    if count:
        action = np.tile(np.array(actions, np.int32), count // 3)[:, None]
        env.set_actions(NAME, ActionTuple(discrete=action))
    env.step()
    return env.get_steps(NAME)


def cells(env: CooperativePushBlock, agent: int = 0) -> dict[int, set[tuple[int, int]]]:
    """Return the cells (h, w) of each tag that an agent of area 0 sees."""
    grid = env.observe(0, np.array([agent]))[0][0]
    assert grid.shape == (6, 20, 20) and (grid.sum(axis=0) <= 1).all()
    return {tag: set(map(tuple, np.argwhere(grid[tag] > 0).tolist())) for tag in range(6)}


def test_spec_ids_and_groups() -> None:
    env = make_scene("CooperativePushBlock")
    env.reset()
    assert list(env.behavior_specs) == [NAME]
    spec = env.behavior_specs[NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [
        ("GridSensor-OneHot", (6, 20, 20)),
        ("RBSensor", (10,)),
    ]
    assert spec.action_spec.discrete_branches == (7,) and spec.action_spec.continuous_size == 0
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(12))
    assert decisions.group_id.tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]
    assert len(terminals) == 0 and not decisions.reward.any()


def test_contract_and_snapshots() -> None:
    def make() -> CooperativePushBlock:
        return CooperativePushBlock(num_areas=2, seed=3)

    report = check_env(make(), steps=1050, remake=make)  # past the time limit of 1000 decisions
    assert report.interrupted >= 3 and report.decisions > 6000


def test_reset_ranges() -> None:
    env = cooperative(400)
    spots, boxes = env.boxes.place, env.boxes
    assert 6.2 < np.abs(spots).max() <= 6.25
    assert (boxes.height == 1.0).all() and not boxes.motion.any() and boxes.present.all()
    assert boxes.yaw.min() >= 0 and 6.2 < boxes.yaw.max() <= 2 * np.pi
    # Nearest to the square of 3 m around a spot is a turned body at its corner: (1.5 * 1.414 + 0.5) / 1.414.
    for body in range(1, 9):
        beside = np.abs(spots[:, body, None] - spots[:, :body]).max(axis=2)
        assert (beside >= 1.853).all() and beside.min() < 2.1
    # The first tick pushes apart what lies corner over corner.
    env.simulate()
    assert boxes.deepest().max() < 0.05


def test_a_tick_costs_the_group() -> None:
    env = cooperative()
    place(env)
    decisions, _ = play(env, NONE, NONE, NONE)
    np.testing.assert_allclose(decisions.group_reward, 5 * -0.0001, rtol=1e-5)
    assert not decisions.reward.any()


@pytest.mark.parametrize(("body", "half", "reward"), [(3, 0.5, 1.0), (5, 1.0, 2.0), (8, 1.5, 3.0)])
def test_a_block_in_the_goal_pays_its_group(body: int, half: float, reward: float) -> None:
    env = cooperative(2)
    place(env)
    env.boxes.place[1, body] = 0.0, -8.34 + half  # its edge is 1 cm before the goal
    decisions, _ = play(env, NONE, NONE, NONE)
    assert env.boxes.present[1, body] and decisions.group_reward[3] < 0
    env.boxes.place[1, body, 1] -= 0.02
    decisions, terminals = play(env, NONE, NONE, NONE)
    assert not len(terminals) and not env.boxes.present[1, body] and env.boxes.present.sum() == 17
    np.testing.assert_allclose(decisions.group_reward[3:], reward - 5 * 0.0001, rtol=1e-5)
    np.testing.assert_allclose(decisions.group_reward[:3], -5 * 0.0001, rtol=1e-5)
    assert not decisions.reward.any()
    # It is gone: neither met nor paid for again.
    assert (play(env, NONE, NONE, NONE)[0].group_reward < 0).all()


def test_the_last_block_ends_the_episode() -> None:
    env = cooperative(2)
    place(env)
    env.boxes.present[0, 4:] = False
    env.boxes.place[0, 3] = 0.0, -8.0
    _, ended = play(env, NONE, NONE, NONE)
    assert ended.agent_id.tolist() == [0, 1, 2] and ended.interrupted.tolist() == [False] * 3
    np.testing.assert_allclose(ended.group_reward, 1.0 - 0.0001, rtol=1e-5)
    assert env.boxes.present.all() and env.timer[0] == 0 and env.timer[1] > 0
    assert np.abs(env.boxes.place[0]).max() <= 6.3


def test_time_limit_interrupts_the_group() -> None:
    env = cooperative()
    place(env)
    env.timer[:] = TIME_LIMIT - 2
    _, ended = play(env, NONE, NONE, NONE)
    assert ended.agent_id.tolist() == [0, 1, 2] and ended.interrupted.all()
    # The charge for the last tick falls into the new episode, as in Unity's script.
    np.testing.assert_allclose(ended.group_reward, -0.0001, rtol=1e-5)
    assert env.timer[0] == 0


def test_a_later_reset_leaves_the_areas_alone() -> None:
    env = cooperative()
    place(env)
    env.boxes.present[0, 3] = False
    before = env.boxes.place.copy()
    env.reset()
    np.testing.assert_allclose(env.boxes.place, before)
    assert not env.boxes.present[0, 3]


@pytest.mark.parametrize(
    ("body", "half", "agents", "moves"),
    [(3, 0.5, 1, True), (5, 1.0, 1, False), (5, 1.0, 2, True), (7, 1.5, 2, False), (7, 1.5, 3, True)],
)
def test_how_many_agents_move_a_block(body: int, half: float, agents: int, moves: bool) -> None:
    """Ten decisions of pushing side by side towards the goal, which is 3 m away: it gets there, or stays."""
    env = cooperative()
    place(env)
    env.boxes.place[0, body] = 0.0, -8.35 + half + 3.0
    start = env.boxes.place[0, body].copy()
    for agent in range(agents):
        env.boxes.place[0, agent] = (agent - (agents - 1) / 2) * 1.02, start[1] + half + 0.51
        env.boxes.yaw[0, agent] = np.pi
    for _ in range(30):
        play(env, *[FORWARD if agent < agents else NONE for agent in range(3)])
        assert env.boxes.deepest()[0] < 0.05
    if moves:
        assert not env.boxes.present[0, body]
    else:
        np.testing.assert_allclose(env.boxes.place[0, body], start, atol=0.02)


def test_body_sensor_shows_the_velocity_in_the_agents_frame() -> None:
    env = cooperative()
    place(env)
    env.boxes.yaw[0, 0] = np.pi / 2  # ahead is +x, right is -z
    env.boxes.motion[0, 0] = 3.0, -2.0, 0.0
    env.boxes.fall[0, 0] = -1.0
    body = env.observe(0, np.array([0]))[1][0]
    np.testing.assert_allclose(body, [2.0, -1.0, 3.0, 0, 0, 0, 0, 0, 0, 1], atol=1e-6)


def test_grid_shows_blocks_ahead_by_their_size() -> None:
    """Cell (h, w) has its middle at right = 9.5 - h, ahead = w + 0.5, and sides of 1 m."""
    env = cooperative()
    place(env, body_0=(0.0, -7.0), body_3=(2.5, -3.5), body_5=(-3.0, -1.0), body_7=(0.1, 4.6))
    seen = cells(env)
    assert (7, 3) in seen[SMALL]  # right 2.5, ahead 3.5; its edges touch its neighbours
    near = {(h, w) for h, w in seen[SMALL] if w < 15}  # beyond are those that are parked
    assert near <= {(h, w) for h in (6, 7, 8) for w in (2, 3, 4)}
    assert {(12, 5), (13, 5), (12, 6), (13, 6)} <= seen[LARGE]  # right -4 to -2, ahead 5 to 7
    # Right -1.4 to 1.6, ahead 10.1 to 13.1.
    very_large = {(h, w) for h, w in seen[VERY_LARGE] if w < 15}
    assert very_large == {(h, w) for h in (8, 9, 10, 11) for w in (10, 11, 12, 13)}


def test_grid_turns_with_the_agent() -> None:
    """A block to the east is ahead of an agent that looks east, to the right of one that looks north."""
    env = cooperative()
    place(env, body_0=(0.1, 0.1), body_3=(5.6, 0.6))
    env.boxes.yaw[0, 0] = np.pi / 2
    assert (10, 5) in cells(env)[SMALL]  # right -0.5, ahead 5.5
    env.boxes.yaw[0, 0] = 0.0
    assert (4, 0) in cells(env)[SMALL]  # right 5.5, ahead 0.5
    env.boxes.yaw[0, 0] = np.pi
    assert not cells(env)[SMALL] & {(h, w) for h in range(20) for w in range(3)} - {
        (h, w) for h in (14, 15, 16) for w in (0,)
    }


def test_grid_shows_walls_goal_and_agents_but_not_oneself() -> None:
    env = cooperative()
    place(env, body_0=(0.0, 5.0), body_1=(2.5, 1.5))
    env.boxes.yaw[0, 0] = np.pi  # towards the goal, which begins 13.35 m ahead
    seen = cells(env)
    # A body's own middle is 0.5 m behind the first cells; the other agent is 2.5 m to the left, 3.5 ahead.
    assert seen[AGENT] and all(abs(h - 12) <= 1 and abs(w - 3) <= 1 for h, w in seen[AGENT])
    assert {(h, w) for h in range(20) for w in range(14, 17)} <= seen[GOAL]
    assert not {w for _, w in seen[GOAL]} & set(range(13))
    # The wall behind the goal lies from 17.5 to 18 m ahead; beyond its outer face is nothing.
    assert {(h, 17) for h in range(20)} <= seen[WALL] | seen[GOAL]
    assert seen[WALL] and not {w for _, w in seen[WALL]} & {19}


def test_the_thing_nearest_to_the_grids_centre_wins_a_cell() -> None:
    """Two small blocks in one cell, 2 m ahead: the one farther ahead is nearer to the centre at 10 m."""
    env = cooperative()
    place(env, body_0=(0.0, -5.0), body_3=(0.5, -3.1), body_5=(0.5, -1.6))
    seen = cells(env)
    # Cell ahead 2 to 3 m: the small block reaches to 2.4, the large one begins at 2.4.
    assert (9, 2) in seen[LARGE] and (9, 2) not in seen[SMALL]
    assert (9, 1) in seen[SMALL]


def test_gravity_acts_at_once() -> None:
    env = cooperative()
    env.set_parameter("gravity", 5.0)
    env.boxes.height[:, 0], env.boxes.fall[:] = 1.0, 0.0
    env.simulate()
    assert env.boxes.fall[0, 0] == pytest.approx(-5.0 * 0.02 * 0.92)
