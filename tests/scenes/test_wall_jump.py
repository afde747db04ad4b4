"""WallJump's rules against numbers worked out by hand from its sheet, and against Unity's own policies."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.wall_jump.scene import NOTHING_PENDING, WallJump

SMALL, BIG = "SmallWallJump?team=0", "BigWallJump?team=0"
FORWARD, LEFT_TURN, RIGHT_TURN, LEFT, RIGHT, JUMP = (1, 0), (1, 1), (2, 1), (1, 2), (2, 2), (1, 3)


def wall_jump(num_areas: int = 1, seed: int = 0) -> WallJump:
    """Return a scene past its start-up: at its second decision, no behavior switch waiting."""
    env = make_scene("WallJump", num_areas=num_areas, seed=seed)
    assert isinstance(env, WallJump)
    env.reset()
    play(env)
    if not asked(env):
        play(env)
    assert len(asked(env)) == num_areas and (env.configuration == NOTHING_PENDING).all()
    return env


def asked(env: WallJump) -> list[int]:
    return sorted(i for name in (SMALL, BIG) for i in env.get_steps(name)[0].agent_id.tolist())


def play(env: WallJump, *choices: tuple[int, int]) -> dict[int, tuple[str, TerminalSteps]]:
    """Set the same choices (value, branch) for all who asked and step; return who ended, under what name."""
    action = np.zeros(4, np.int32)
    for value, branch in choices:
        action[branch] = value
    for name in (SMALL, BIG):
        count = len(env.get_steps(name)[0])
        if count:
            env.set_actions(name, ActionTuple(discrete=np.tile(action, (count, 1))))
    env.step()
    ended = {name: env.get_steps(name)[1] for name in (SMALL, BIG)}
    return {int(i): (name, steps) for name, steps in ended.items() for i in steps.agent_id}


def place(env: WallJump, x: float, y: float, z: float, yaw_deg: float = 0.0, wall: float = 0.0) -> None:
    """Put every agent at rest, the block out of the way at the left, and walls of that height."""
    bodies = env.bodies
    bodies.position[:] = (x, y, z)
    bodies.velocity[:] = bodies.block_velocity[:] = 0
    bodies.yaw[:] = np.radians(yaw_deg)
    bodies.block[:] = (-8.0, 1.5, -9.0)
    bodies.wall_height[:] = wall
    env.jump_left_s[:] = 0


def frames(env: WallJump) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return area 0's frame of the upward rays [7, 5], the level rays [7, 5] and the vector [4]."""
    env._frames = None  # look at the bodies as they were placed
    upward, level, vector = env.observe(0, np.array([0]))
    return upward.reshape(7, 5), level.reshape(7, 5), vector[0]


def reward_of(ended: dict[int, tuple[str, TerminalSteps]], agent: int) -> tuple[float, bool]:
    steps = ended[agent][1][agent]
    return float(steps.reward), bool(steps.interrupted)


def test_spec() -> None:
    env = make_scene("WallJump")
    assert list(env.behavior_specs) == [SMALL, BIG]
    for spec in env.behavior_specs.values():
        assert [(o.name, o.shape) for o in spec.observation_specs] == [
            ("StackingSensor_size6_OffsetRayPerceptionSensor", (210,)),
            ("StackingSensor_size6_RayPerceptionSensor", (210,)),
            ("StackingSensor_size6_VectorSensor_size4", (24,)),
        ]
        assert spec.action_spec.discrete_branches == (3, 3, 3, 2)


def test_contract_and_snapshots() -> None:
    def make() -> WallJump:
        return WallJump(num_areas=4, seed=3)

    report = check_env(make(), steps=600, remake=make)
    assert report.terminals > 20 and report.terminal_only_steps > 5


def test_start_up_terminals() -> None:
    """All 24 send a terminal as Small; those whose second configuration differs send another a tick later."""
    env = make_scene("WallJump", seed=1)
    assert isinstance(env, WallJump)
    env.reset()
    decisions = {name: env.get_steps(name)[0] for name in (SMALL, BIG)}
    terminals = env.get_steps(SMALL)[1]
    assert terminals.agent_id.tolist() == list(range(24)) and not terminals.interrupted.any()
    assert len(env.get_steps(BIG)[1]) == 0 and asked(env) == list(range(24))
    assert len(decisions[SMALL]) and len(decisions[BIG])  # 40 % and 60 % of 24
    drawn = np.where(env.configuration >= 2, BIG, SMALL)
    ended = play(env)
    first = {int(i): name for name, steps in decisions.items() for i in steps.agent_id}
    assert asked(env) == [] and set(ended) == {i for i, name in first.items() if name != drawn[i]}
    assert all(name == first[i] for i, (name, _) in ended.items())
    assert not any(reward_of(ended, i)[1] for i in ended)
    play(env)
    assert asked(env) == list(range(24))
    assert env.get_steps(BIG)[0].agent_id.tolist() == np.flatnonzero(drawn == BIG).tolist()


def test_configurations_and_heights() -> None:
    env = wall_jump(3000)
    height, behavior = env.bodies.wall_height, env.agents.behavior
    shares = [(height == h).mean() for h in (0, 4, 8)]
    np.testing.assert_allclose(shares, [0.2, 0.2, 0.6], atol=0.03)
    assert ((behavior == 1) == (height == 8)).all()


def test_heights_are_parameters() -> None:
    env = make_scene("WallJump", num_areas=50, no_wall_height=1.0, small_wall_height=1.5)
    assert isinstance(env, WallJump)
    env.set_parameter("big_wall_height", 5.0)
    env.reset()
    assert set(env.bodies.wall_height.tolist()) == {1.0, 1.5, 5.0}


def test_reset_ranges_and_what_stays() -> None:
    env = wall_jump(3000)
    env.bodies.yaw[:] = 1.0
    env.jump_left_s[:] = 0.1
    env.end_episode(np.arange(3000))
    bodies = env.bodies
    x, y, z = bodies.position.T
    assert 8.95 < np.abs(x).max() <= 9 and (y == 1).all() and (z == -12).all()
    assert (bodies.yaw == 1.0).all() and (env.jump_left_s == np.float32(0.1)).all()
    bx, by, bz = bodies.block.T
    assert 8.05 < np.abs(bx).max() <= 8.1 and (by == 1.5).all()
    assert 3.45 < np.abs(bz + 6.27).max() <= 3.5
    assert not bodies.velocity.any() and not bodies.block_velocity.any()
    assert set(env.configuration.tolist()) == set(range(5))


def test_first_heading_is_away_from_the_wall() -> None:
    env = make_scene("WallJump")
    assert isinstance(env, WallJump)
    assert np.allclose(env.bodies.yaw, np.pi)


def test_reward_of_a_decision_and_time_limit() -> None:
    env = wall_jump()
    decisions, total = 1, float(env.get_steps(SMALL)[0].reward.sum() + env.get_steps(BIG)[0].reward.sum())
    assert total == pytest.approx(-0.0025)
    ended = play(env)
    while not ended:
        decisions += 1
        ended = play(env)
    reward, interrupted = reward_of(ended, 0)
    assert decisions + 1 == 400 and interrupted
    assert reward == pytest.approx(-0.0025)


def test_goal_replaces_the_reward() -> None:
    """One agent stands in the goal, one hangs in it too high above the ground, one is beside it."""
    env = wall_jump(3)
    place(env, 6.37, 0.95, 2.93)
    env.bodies.position[1, 1] = 3.5
    env.bodies.position[2, 0] = 6.37 - 2.0 - 0.5 - 0.01
    ended = play(env)
    assert set(ended) == {0} and reward_of(ended, 0) == (1.0, False)


@pytest.mark.parametrize(("x", "z"), [(10.6, 0.0), (-10.6, 0.0), (0.0, 6.6), (0.0, -14.6)])
def test_falls_of_agent_and_block(x: float, z: float) -> None:
    env = wall_jump(3)
    place(env, 0.0, 0.95, -12.0)
    env.bodies.position[0] = (x, 0.95, z)
    env.bodies.block[1, ::2] = (x, z)
    ended = play(env)
    assert set(ended) == {0, 1}
    assert reward_of(ended, 0) == reward_of(ended, 1) == (-1.0, False)
    assert (np.abs(env.bodies.block[:, 0]) <= 8.1).all()  # put back


def test_an_agent_over_a_block_beyond_the_edge_has_not_fallen() -> None:
    env = wall_jump()
    place(env, 10.7, 3.0, -9.0)
    env.bodies.block[:, ::2] = (10.4, -9.0)
    assert not env.bodies.fallen().any()
    env.bodies.block[:, ::2] = (8.9, -9.0)
    assert env.bodies.fallen().all()


def test_actions() -> None:
    """Sheet: 2.26 m/s after a tick, 6 degrees a tick; sideways replaces forward at 0.6 of the speed."""
    env = wall_jump(5)
    place(env, 0.0, 0.95, -8.0)
    turn = np.zeros((5, 4), np.int32)
    for row, choices in enumerate([[FORWARD], [FORWARD, RIGHT], [LEFT], [RIGHT_TURN], [LEFT_TURN]]):
        for value, branch in choices:
            turn[row, branch] = value
    env.agents.discrete[:] = turn
    env.act(np.arange(5))
    env.simulate()
    loss = 1.2 * 26.9775 * 0.02 * 0.96
    sideways = 3 * 0.6 * 0.96 - loss
    expected = [[0, 3 * 0.96 - loss], [sideways, 0], [-sideways, 0], [0, 0], [0, 0]]
    np.testing.assert_allclose(env.bodies.velocity[:, ::2], np.array(expected), atol=1e-9)
    np.testing.assert_allclose(np.degrees(env.bodies.yaw), [0, 0, 0, 6, -6])


def test_in_the_air_half_the_drive_and_a_faster_fall() -> None:
    env = wall_jump()
    place(env, 0.0, 3.0, -8.0)
    env.agents.discrete[:] = (1, 0, 0, 1)  # and no jump: there is no ground within reach
    env.act(np.arange(1))
    env.simulate()
    expected = [0, -(26.9775 + 111) * 0.02 * 0.96, 1.5 * 0.96]
    np.testing.assert_allclose(env.bodies.velocity[0], expected, atol=1e-9)


def test_a_standing_jump() -> None:
    """The jump's velocity acts for 11 ticks; the feet rise 2.6 m (2.63 in the calibration's engine)."""
    env = wall_jump()
    place(env, 0.0, 0.95, -8.0)
    env.agents.discrete[:] = (0, 0, 0, 1)
    height, running = [], 0
    for _ in range(40):
        env.act(np.arange(1))
        env.agents.discrete[:] = 0
        running += int(env.jump_left_s[0] > -np.float32(0.02) + 1e-4)
        env.simulate()
        height.append(env.bodies.position[0, 1] - 0.95)
    assert running == 10  # of 11: the last one ends at the limit
    first = 10 * 0.96 - 26.9775 * 0.02 * 0.96  # at most 10 m/s of change a tick, then gravity and drag
    assert height[0] == pytest.approx(first * 0.02)
    assert max(height) == pytest.approx(2.62, abs=0.01) and height.index(max(height)) == 10
    assert height[-1] == pytest.approx(0, abs=1e-4)


def test_a_jump_needs_ground_below_its_middle() -> None:
    """Only with its rim on the block an agent is grounded, but cannot jump."""
    env = wall_jump(2)
    place(env, 0.0, 3.0, -8.0)
    env.bodies.block[:, ::2] = (1.9, -8.0)  # its left face at x 0.4, below the rim only
    env.bodies.block[1, 0] = 1.4
    assert env.bodies.grounded().tolist() == [True, True]
    assert env.bodies.stands_over().tolist() == [False, True]
    env.agents.discrete[:] = (0, 0, 0, 1)
    env.act(np.arange(2))
    assert (env.jump_left_s > 0).tolist() == [False, True]


def test_a_side_touch_is_no_ground() -> None:
    env = wall_jump(2)
    place(env, 0.0, 1.6, -8.0)
    env.bodies.block[0, ::2] = (2.0, -8.0)  # touching
    env.bodies.block[1, ::2] = (1.97, -8.0)  # 0.03 deep: more than the test box is narrower
    assert env.bodies.grounded().tolist() == [False, True]


def test_ends_switch_behaviors_without_a_further_terminal() -> None:
    """The same id asks for its next decision under the other behavior, with empty stacks."""
    env = wall_jump(40)
    before = env.agents.behavior.copy()
    place(env, 6.37, 0.95, 2.93)
    terminals = [play(env), play(env)]
    assert set(terminals[0]) == set(range(40)) and not terminals[1]
    assert all(name == (BIG if before[i] else SMALL) for i, (name, _) in terminals[0].items())
    moved = np.flatnonzero(env.agents.behavior != before)
    assert moved.size and asked(env) == list(range(40))
    now = env.get_steps(SMALL)[0]
    assert set(moved[before[moved] == 1]) <= set(now.agent_id.tolist())
    assert not now.obs[2][:, :20].any() and now.obs[2][:, 20:].any()


def test_a_later_reset_sends_terminals_of_those_who_move() -> None:
    env = wall_jump(40)
    before = env.agents.behavior.copy()
    env.reset()
    moved = np.flatnonzero(env.agents.behavior != before)
    ended = {name: env.get_steps(name)[1] for name in (SMALL, BIG)}
    assert sorted([*ended[SMALL].agent_id, *ended[BIG].agent_id]) == moved.tolist() and moved.size
    assert set(ended[BIG].agent_id.tolist()) == set(moved[before[moved] == 1].tolist())
    assert asked(env) == list(range(40))


def test_vector() -> None:
    env = wall_jump()
    place(env, 2.0, 0.95, -8.0)
    np.testing.assert_allclose(frames(env)[2], [0.1, 0.0475, -0.2, 1], rtol=1e-6)
    place(env, 2.0, 3.0, -8.0)
    assert frames(env)[2][3] == 0


def test_level_rays_see_wall_block_and_goal() -> None:
    """Facing the wall from z = -9: 9 - 2.73 - 0.5 m; without it the goal from x = 6.37."""
    env = wall_jump()
    place(env, 0.0, 0.95, -9.0, wall=8.0)
    _, level, _ = frames(env)
    np.testing.assert_allclose(level[0], [1, 0, 0, 0, (9 - 2.73 - 0.5) / 20], rtol=1e-6)
    # 30 and 60 degrees: the wall too; 90 left: the block, at x -8 + 1.5; 90 right: nothing
    np.testing.assert_allclose(level[1], [1, 0, 0, 0, 5.77 / np.cos(np.pi / 6) / 20], rtol=1e-6)
    np.testing.assert_allclose(level[6], [0, 0, 1, 0, (6.5 - 0.5) / 20], rtol=1e-6)
    np.testing.assert_array_equal(level[5], [0, 0, 0, 1, 1])
    place(env, 6.37, 0.95, -9.0)
    _, level, _ = frames(env)
    np.testing.assert_allclose(level[0], [0, 1, 0, 0, (9 + 0.93 - 0.5) / 20], rtol=1e-6)


def test_upward_rays() -> None:
    """From 2.5 m above the agent, 2.5 m up in 20 m: over a small wall, against a near big one."""
    env = wall_jump()
    place(env, 0.0, 0.95, -6.0, wall=4.0)
    np.testing.assert_array_equal(frames(env)[0][0], [0, 0, 0, 1, 1])
    place(env, 0.0, 0.95, -6.0, wall=8.0)
    length = np.hypot(20, 2.5)
    radius = 0.5 * length / 20
    way = (6 - 2.73 - radius) / (20 / length) / length  # at y 3.45 + 0.34, below the top at 4
    np.testing.assert_allclose(frames(env)[0][0], [1, 0, 0, 0, way], rtol=1e-6)
    place(env, 0.0, 0.95, -14.0, wall=8.0)  # sphere at 3.45 + 1.35 - 0.5 > 4 when it comes to the wall
    np.testing.assert_array_equal(frames(env)[0][0], [0, 0, 0, 1, 1])


def test_upward_rays_of_a_low_agent_see_the_block() -> None:
    """Deep in the floor, at y 0.2, they start 2.7 - 0.5 m high and meet the block below its top at 2.5."""
    env = wall_jump(2)
    place(env, 0.0, 0.95, -11.0)
    env.bodies.block[:, ::2] = (0.0, -8.0)
    assert frames(env)[0][0, 3] == 1
    env.bodies.position[:, 1] = 0.2
    np.testing.assert_array_equal(frames(env)[0][0, :4], [0, 0, 1, 0])


def test_a_touched_block_is_skipped() -> None:
    env = wall_jump()
    place(env, 0.0, 0.95, -8.0, wall=8.0)
    env.bodies.block[:, ::2] = (0.0, -6.0)
    _, level, _ = frames(env)
    np.testing.assert_allclose(level[0], [1, 0, 0, 0, (8 - 2.73 - 0.5) / 20], rtol=1e-6)
    env.bodies.block[:, 2] = -5.9
    np.testing.assert_allclose(frames(env)[1][0], [0, 0, 1, 0, 0.1 / 20], rtol=1e-5)


def test_a_snapshot_repeats_to_the_bit_in_a_new_scene() -> None:
    env = wall_jump(8, seed=5)
    for _ in range(30):
        play(env, FORWARD, RIGHT_TURN, JUMP)
    state, traces = env.get_state(), []
    for scene in (env, WallJump(num_areas=8, seed=99)):
        scene.set_state(state)
        trace = [records(scene)]
        for number in range(60):
            play(scene, FORWARD, (number // 7 % 3, 1), JUMP)
            trace.append(records(scene))
        traces.append(trace)
    assert traces[0] == traces[1]


def records(env: WallJump) -> list[bytes]:
    steps: list[DecisionSteps | TerminalSteps] = [s for name in (SMALL, BIG) for s in env.get_steps(name)]
    return [array.tobytes() for s in steps for array in (*s.obs, s.reward, s.agent_id)]


def test_unitys_policies(shared: Path) -> None:
    """Sheet: 0.956 and 0.864, without the start-up's records of one decision."""
    pytest.importorskip("onnxruntime")
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    assert spec is not None and spec.loader is not None
    run_policy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run_policy)
    policies = {
        name: run_policy.OfficialPolicy(
            str(shared / "oracle" / f"{name}.onnx"), np.random.default_rng(0), False
        )
        for name in ("SmallWallJump", "BigWallJump")
    }
    done = run_policy.play(make_scene("WallJump", num_areas=64), policies, 150, 1000)
    for name, least in ((SMALL, 0.9), (BIG, 0.8)):
        assert np.mean([row[0] for row in done[name] if row[2] > 1]) > least
