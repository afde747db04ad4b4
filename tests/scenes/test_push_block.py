"""PushBlock against numbers worked out by hand from its facts, and against a recording of Unity's scene."""

from __future__ import annotations

import math

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.push_block.scene import AGENT, BLOCK, PushBlock
from mappo_unity.scenes.push_block.spawn import draw_spots

NAME = "PushBlock?team=0"
NONE, FORWARD, BACKWARD, RIGHT_TURN, LEFT_TURN, LEFT, RIGHT = range(7)
FACE = -8.35  # of the goal


def push_block(num_areas: int = 1, seed: int = 0, **parameters: float) -> PushBlock:
    env = make_scene("PushBlock", num_areas=num_areas, seed=seed, **parameters)
    assert isinstance(env, PushBlock)
    env.reset()
    return env


def place(
    env: PushBlock,
    agent: tuple[float, float],
    block: tuple[float, float] = (-9.0, 9.0),
    yaw_deg: float = 0.0,
) -> None:
    """Put agents and blocks (x, z) at rest on the floor."""
    boxes = env.boxes
    boxes.place[:, AGENT], boxes.place[:, BLOCK] = agent, block
    boxes.height[:] = boxes.rest
    boxes.yaw[:, AGENT] = np.radians(yaw_deg)
    boxes.motion[:] = 0.0
    boxes.fall[:] = 0.0


def play(env: PushBlock, action: int) -> tuple[DecisionSteps, TerminalSteps]:
    """Set one action for all who asked, and go on to the next report."""
    count = len(env.get_steps(NAME)[0])
    env.set_actions(NAME, ActionTuple(discrete=np.full((count, 1), action, np.int32)))
    env.step()
    return env.get_steps(NAME)


def rays(env: PushBlock) -> tuple[np.ndarray, np.ndarray]:
    """Return one frame of area 0: offset and level rays [7, 5] each (block, goal, wall, miss, distance)."""
    offset, level = env.observe(0, np.array([0]))
    return offset.reshape(7, 5), level.reshape(7, 5)


def test_spec_ids_and_groups() -> None:
    env = make_scene("PushBlock")
    env.reset()
    assert list(env.behavior_specs) == [NAME]
    spec = env.behavior_specs[NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [
        ("StackingSensor_size3_OffsetRayPerceptionSensor", (105,)),
        ("StackingSensor_size3_RayPerceptionSensor", (105,)),
    ]
    assert spec.action_spec.discrete_branches == (7,) and spec.action_spec.continuous_size == 0
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(32)) and not decisions.group_id.any()
    assert len(terminals) == 0 and not decisions.reward.any()


def test_contract_and_snapshots() -> None:
    def make() -> PushBlock:
        return PushBlock(num_areas=4, seed=3)

    report = check_env(make(), steps=1100, remake=make)  # past the time limit of 1000 decisions
    assert report.interrupted >= 1 and report.decisions > 4000


def test_reset_ranges() -> None:
    env = push_block(2000)
    agent, block = env.boxes.place[:, AGENT], env.boxes.place[:, BLOCK]
    for spots in (agent, block):
        assert 6.2 < np.abs(spots[:, 0]).max() <= 6.25
        # The square of 5 m around a spot is off the goal, which is 1.5 m high.
        assert FACE + 2.5 <= spots[:, 1].min() < -5.8 and 6.2 < spots[:, 1].max() <= 6.25
    beside = np.abs(agent - block).max(axis=1)
    assert 3.5 <= beside.min() < 3.6  # 2.5 of the square, 1 of the block
    assert (env.boxes.height == 1.0).all() and not env.boxes.motion.any()
    assert (env.boxes.yaw[:, AGENT] == math.pi).all()  # a recording's first frame faces the goal


def test_tick_cost_and_time_limit() -> None:
    env = push_block()
    assert play(env, NONE)[0].reward[0] == pytest.approx(-0.001)
    total, decisions = -0.001, 1
    while True:
        asked, ended = play(env, NONE)
        decisions += 1
        if len(ended):
            break
        total += float(asked.reward[0])
    assert decisions == 1000 and ended.interrupted.tolist() == [True]
    assert total + ended.reward[0] == pytest.approx(-1.0, abs=1e-4)


def test_block_at_the_goal_pays_five() -> None:
    """The block's face is 0.35 m before the goal; the agent pushes it there within a second decision."""
    env = push_block()
    place(env, (0.0, -5.49), (0.0, -7.0), yaw_deg=180.0)
    total, decisions, ended = 0.0, 0, env.get_steps(NAME)[1]
    while not len(ended):
        total += float(env.get_steps(NAME)[0].reward[0])
        _, ended = play(env, FORWARD)
        decisions += 1
    assert decisions == 2 and ended.interrupted.tolist() == [False]
    ticks = round((5.0 - total - float(ended.reward[0])) * 5000)
    assert 5 < ticks <= 10 and total + ended.reward[0] == pytest.approx(5.0 - ticks / 5000, abs=1e-5)
    assert env.boxes.place[0, BLOCK, 1] > -5.9  # and a new episode has begun


def test_the_goal_stops_the_agent() -> None:
    env = push_block()
    place(env, (3.0, -6.0), yaw_deg=180.0)
    for _ in range(12):
        _, ended = play(env, FORWARD)
        assert not len(ended)
        assert env.boxes.place[0, AGENT, 1] >= FACE + 0.5 - 1e-9
    assert env.boxes.place[0, AGENT, 1] == pytest.approx(FACE + 0.5)


def test_drive_turn_and_strafe() -> None:
    """Ground friction (0 + 0.6) / 2, twice: v <- (v + 3) * 0.92 - 0.6 * 24.525 * 0.02 * 0.92 a tick.

    From rest: 2.4893, 4.7794, 6.8863, 8.8247, 10.6079 m/s, together 0.6718 m.
    """
    env = push_block(7)
    place(env, (0.0, 0.0))
    action = np.arange(7, dtype=np.int32)[:, None]
    env.set_actions(NAME, ActionTuple(discrete=action))
    env.step()
    boxes = env.boxes
    assert boxes.motion[FORWARD, AGENT, 1] == pytest.approx(10.6079, abs=1e-4)
    # To the side 2.25: 1.7993, 3.4546, 4.9775, 6.3786, 7.6676 m/s, together 0.4855 m.
    np.testing.assert_allclose(boxes.place[:, AGENT, 1], [0, 0.6718, -0.6718, 0, 0, 0, 0], atol=1e-4)
    np.testing.assert_allclose(boxes.place[:, AGENT, 0], [0, 0, 0, 0, 0, -0.4855, 0.4855], atol=1e-4)
    np.testing.assert_allclose(np.degrees(boxes.yaw[:, AGENT]), [0, 0, 0, 20, -20, 0, 0], atol=1e-9)


def test_movement_is_that_of_the_recording_at_its_gravity() -> None:
    """Way in a decision by that in the one before, backwards and free, fitted to ExpertPushBlock.demo.

    0.654 d + 1.134 m (residual 0.006), where Unity's gravity was 9.81: bodies fell for 21 ticks.
    """
    env = push_block(gravity=9.81)
    place(env, (0.0, -7.0), yaw_deg=180.0)
    ways, start = [], -7.0
    for _ in range(7):
        play(env, BACKWARD)
        ways.append(env.boxes.place[0, AGENT, 1] - start)
        start += ways[-1]
    for before, after in zip(ways[:-1], ways[1:]):
        assert after == pytest.approx(0.654 * before + 1.134, abs=0.02)

    env.boxes.height[0, AGENT] = 1.0
    env.boxes.fall[0, AGENT] = 0.0
    ticks = 0
    while env.boxes.height[0, AGENT] > 0.5:
        env.simulate()
        ticks += 1
    assert ticks == 21


def test_agent_and_block_run_as_one() -> None:
    """20 v' = 10 (v + 3) 0.92 + 10 v 0.99 - 0.6 * 24.525 * 0.02 * 10 (0.92 + 0.99), once they touch."""
    env = push_block()
    place(env, (0.0, -6.0), (0.0, -4.49), yaw_deg=0.0)
    play(env, FORWARD)
    for _ in range(3):
        speed = env.boxes.motion[0, :, 1].copy()
        assert speed[AGENT] == pytest.approx(speed[BLOCK], abs=1e-3)
        expected = speed[AGENT]
        for _ in range(5):
            expected = 0.955 * expected + 1.38 - 0.6 * 24.525 * 0.02 * 0.955
        play(env, FORWARD)
        assert env.boxes.motion[0, BLOCK, 1] == pytest.approx(expected, abs=0.02)
    assert env.boxes.yaw[0, BLOCK] == 0.0 and env.boxes.deepest()[0] < 1e-3


@pytest.mark.parametrize("yaw", [0.0, 20.0, 40.0])
@pytest.mark.parametrize("offset", [0.0, 0.9, 1.3])
def test_a_fast_agent_does_not_enter_the_block(yaw: float, offset: float) -> None:
    env = push_block()
    turn = math.radians(yaw)
    place(env, (offset - 6.0 * math.sin(turn), 4.0 - 6.0 * math.cos(turn)), (0.0, 4.0), yaw)
    env.boxes.motion[0, AGENT, :2] = 30.0 * math.sin(turn), 30.0 * math.cos(turn)
    for _ in range(60):
        env.act(np.array([0]))
        env.agents.discrete[:] = FORWARD
        env.simulate()
        assert env.boxes.deepest()[0] < 0.01
    assert env.boxes.place[0, BLOCK, 1] > 4.5


@pytest.mark.parametrize("corner", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0)])
def test_a_block_in_a_corner_stays_there(corner: tuple[float, float]) -> None:
    """Pushed against two walls at once, block and agent stay within 5 mm of the walls and each other."""
    env = push_block()
    z = 11.5 if corner[1] > 0 else -6.0
    x = corner[0] * 11.5
    place(env, (x - corner[0] * 1.8, z - corner[1] * 1.2), (x, z), yaw_deg=math.degrees(math.atan2(*corner)))
    for _ in range(200):
        env.act(np.array([0]))
        env.agents.discrete[:] = FORWARD
        env.simulate()
        assert env.boxes.deepest()[0] < 0.005
        assert abs(env.boxes.place[0, BLOCK, 0]) <= 11.5 + 1e-9
    assert env.boxes.place[0, BLOCK, 0] * corner[0] == pytest.approx(11.5, abs=0.01)


def test_level_rays() -> None:
    """Of 12 m: to the block's face 4 - 1 - 0.5 m, to the right wall 12.5 - 0.5 - 5 m; right first."""
    env = push_block()
    place(env, (5.0, 0.0), (5.0, 4.0))
    _, level = rays(env)
    np.testing.assert_allclose(level[0], [1, 0, 0, 0, 2.5 / 12], rtol=1e-6)
    np.testing.assert_allclose(level[5], [0, 0, 1, 0, 7 / 12], rtol=1e-6)
    np.testing.assert_allclose(level[3], [0, 0, 1, 0, 7 / math.sin(math.radians(60)) / 12], rtol=1e-6)
    np.testing.assert_array_equal(level[6], [0, 0, 0, 1, 1])
    env.boxes.yaw[0, AGENT] = math.pi
    np.testing.assert_allclose(rays(env)[1][0], [0, 1, 0, 0, 7.85 / 12], rtol=1e-6)


def test_offset_rays_see_walls_only_and_only_from_the_floor() -> None:
    """Their sphere just reaches the walls' tops: its centre travels to the face itself, 12.5 - 5 m."""
    env = push_block()
    place(env, (5.0, -5.0), (5.0, -2.0), yaw_deg=180.0)
    offset, level = rays(env)
    np.testing.assert_allclose(offset[0], [0, 0, 1, 0, 7.5 / 12], atol=1e-3)  # the wall behind the goal
    np.testing.assert_allclose(offset[6], [0, 0, 1, 0, 7.5 / 12], atol=1e-3)  # 90 degrees to the left
    assert level[0, 1] == 1 and not offset[:, :2].any()
    env.boxes.height[0, AGENT] = 0.51
    np.testing.assert_array_equal(rays(env)[0][:, 3:], np.ones((7, 2)))


def test_a_pushed_block_is_seen_at_no_distance() -> None:
    env = push_block()
    place(env, (0.0, -6.0), (0.0, -4.49), yaw_deg=0.0)
    for _ in range(4):
        play(env, FORWARD)
        np.testing.assert_allclose(rays(env)[1][0], [1, 0, 0, 0, 0], atol=1e-3)


def test_block_parameters() -> None:
    """Static friction (1 + 0.6) / 2, twice, holds 1.6 * 24.525 * 0.02 * 0.9 m/s; drag 5 keeps 0.9."""
    env = push_block(3, block_scale=4.0, static_friction=1.0, dynamic_friction=0.2, block_drag=5.0)
    assert (env.boxes.half[:, BLOCK] == 2.0).all()
    place(env, (8.0, 8.0), (-3.0, 0.0))
    env.boxes.motion[:, BLOCK, 0] = 0.7, 1.0, 10.0
    env.simulate()
    rub = 0.8 * 24.525 * 0.02 * 0.9
    np.testing.assert_allclose(env.boxes.motion[:, BLOCK, 0], [0.0, 0.9 - rub, 9.0 - rub], atol=1e-9)
    # 4 m wide: seen from 10 m, its face is 10 - 2 - 0.5 m away.
    place(env, (-3.0, 10.0), (-3.0, 0.0), yaw_deg=180.0)
    np.testing.assert_allclose(rays(env)[1][0], [1, 0, 0, 0, 7.5 / 12], rtol=1e-6)


def test_gravity_acts_at_once() -> None:
    env = push_block()
    env.set_parameter("gravity", 5.0)
    env.boxes.height[:, AGENT], env.boxes.fall[:] = 1.0, 0.0
    env.simulate()
    assert env.boxes.fall[0, AGENT] == pytest.approx(-5.0 * 0.02 * 0.92)


def test_a_block_that_leaves_no_spot_is_told() -> None:
    middle, yaw = np.zeros((1, 1, 2)), np.zeros((1, 1))
    there = np.ones((1, 1), bool)
    with pytest.raises(ConfigError, match="is env.params.block_scale too large"):
        draw_spots(np.random.default_rng(0), 0.5, FACE, middle, yaw, np.full((1, 1, 2), 20.0), there)
    spot = draw_spots(np.random.default_rng(0), 0.5, FACE, middle, yaw, np.ones((1, 1, 2)), there)
    assert np.abs(spot).max() > 1
