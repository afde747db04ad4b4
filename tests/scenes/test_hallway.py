"""Hallway against numbers worked out by hand from its sheet, and against Unity's own policy."""

from __future__ import annotations

import importlib.util
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.hallway.scene import Hallway

NAME = "Hallway?team=0"
NONE, FORWARD, BACKWARD, RIGHT, LEFT = range(5)


def hallway(num_areas: int = 1, seed: int = 0) -> Hallway:
    env = make_scene("Hallway", num_areas=num_areas, seed=seed)
    assert isinstance(env, Hallway)
    env.reset()
    return env


def place(env: Hallway, x: float, z: float, yaw_deg: float = 0.0, symbol_z: float = -4.0) -> None:
    """Put every agent at rest on the floor, the O block at (0, symbol_z), the O goal on the right."""
    env.position[:] = (x, 1.0, z)
    env.velocity[:] = 0
    env.yaw[:] = np.radians(yaw_deg)
    env.symbol[:] = (0.0, 2.5, symbol_z)
    env.shows_x[:] = False
    env.o_side[:] = 1.0


def play(env: Hallway, action: int) -> tuple[DecisionSteps, TerminalSteps]:
    """Set one action for all who asked, and go on to the next report."""
    count = len(env.get_steps(NAME)[0])
    env.set_actions(NAME, ActionTuple(discrete=np.full((count, 1), action, np.int32)))
    env.step()
    return env.get_steps(NAME)


def rays(env: Hallway) -> np.ndarray:
    """Return one frame [5 rays, 7] of area 0: one-hot of the five tags, miss, distance."""
    return env.observe(0, np.array([0]))[0].reshape(5, 7)


def test_spec_ids_and_groups() -> None:
    env = make_scene("Hallway")
    env.reset()
    assert list(env.behavior_specs) == [NAME]
    spec = env.behavior_specs[NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [
        ("StackingSensor_size3_RayPerceptionSensor", (105,)),
        ("StackingSensor_size3_VectorSensor_size1", (3,)),
    ]
    assert spec.action_spec.discrete_branches == (5,) and spec.action_spec.continuous_size == 0
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(16)) and not decisions.group_id.any()
    assert len(terminals) == 0 and not decisions.reward.any()


def test_contract_and_snapshots() -> None:
    def make() -> Hallway:
        return Hallway(num_areas=3, seed=4)

    report = check_env(make(), steps=700, remake=make)  # past the time limit of 500 decisions
    assert report.interrupted >= 1 and report.decisions > 1500


def test_reset_ranges() -> None:
    env = hallway(4000)
    x, y, z = env.position.T
    assert 2.9 < np.abs(x).max() <= 3 and (y == 1.5).all()
    assert -20 <= z.min() < -19.9 and -10.1 < z.max() <= -10
    assert not env.velocity.any() and env.yaw.min() >= 0 and 6.2 < env.yaw.max() <= 2 * math.pi
    assert abs(env.shows_x.mean() - 0.5) < 0.05 and abs(env.o_side.mean()) < 0.1
    assert set(env.o_side.tolist()) == {-1.0, 1.0}
    assert not env.symbol[env.shows_x, 0].any()  # the X block stands in the middle
    assert 2.9 < np.abs(env.symbol[~env.shows_x, 0]).max() <= 3
    assert (env.symbol[:, 1] == 2.5).all() and 4.9 < np.abs(env.symbol[:, 2]).max() <= 5


def test_stacks_and_the_clock() -> None:
    env = hallway()
    np.testing.assert_allclose(env.get_steps(NAME)[0].obs[1], [[0, 0, 1 / 3000]])
    assert not env.get_steps(NAME)[0].obs[0][0, :70].any()  # unseen frames: the miss flags are 0, too
    decisions, _ = play(env, NONE)
    np.testing.assert_allclose(decisions.obs[1], [[0, 1 / 3000, 7 / 3000]], rtol=1e-6)
    assert decisions.reward[0] == pytest.approx(-0.002)


def test_time_limit_interrupts() -> None:
    env = hallway()
    total, decisions = 0.0, 0
    while True:
        place(env, 0.0, -10.0)  # far from everything that ends
        asked, ended = play(env, NONE)
        decisions += 1
        if len(ended):
            break
        total += float(asked.reward[0])
    assert decisions == 500 and ended.interrupted.tolist() == [True]
    assert total + ended.reward[0] == pytest.approx(-1.0, abs=1e-4)
    assert ended.obs[1][0, 2] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("side", "shows_x", "o_side"), list(itertools.product((1, -1), (False, True), (1, -1)))
)
def test_goals(side: int, shows_x: bool, o_side: int) -> None:
    """A touched goal replaces the window's reward: +1 if it is of the symbol shown, else -0.1."""
    env = hallway()
    place(env, 7.0 * side, 19.0)
    env.shows_x[:], env.o_side[:] = shows_x, o_side
    ended = play(env, FORWARD)[1]
    while not len(ended):
        ended = play(env, FORWARD)[1]
    touched_x = side != o_side
    assert ended.reward.tolist() == [1.0 if touched_x == shows_x else np.float32(-0.1)]
    assert ended.interrupted.tolist() == [False]
    assert -20 <= env.position[0, 2] <= -10  # and a new episode has begun


def test_a_goal_is_touched_at_its_edge() -> None:
    """The plate begins at z 20.29, so the agent's centre comes to 19.79; contacts begin 0.02 before."""
    env = hallway(2)
    place(env, 7.0, 19.76)
    env.position[1, 2] = 19.78
    assert play(env, NONE)[1].agent_id.tolist() == [1]


def test_drive_and_turn() -> None:
    """Sheet: 5.4 m/s and 0.39 m after one decision from rest; 18 degrees a turning decision."""
    env = hallway(5)
    place(env, 0.0, -15.0)
    env.yaw[:] = np.radians([0, 90, 0, 0, 0])
    actions = np.array([[FORWARD], [FORWARD], [BACKWARD], [RIGHT], [LEFT]], np.int32)
    env.set_actions(NAME, ActionTuple(discrete=actions))
    env.step()
    assert env.velocity[0, 2] == pytest.approx(5.4, abs=0.05)
    way = env.position - (0.0, 1.0, -15.0)
    np.testing.assert_allclose(way[:, 2], [0.39, 0, -0.39, 0, 0], atol=0.005)
    np.testing.assert_allclose(way[:, 0], [0, 0.39, 0, 0, 0], atol=0.005)
    np.testing.assert_allclose(np.degrees(env.yaw[3:]), [18, -18])
    for expected in (0.95, 1.38, 1.73, 2.00):
        before = env.position[0, 2]
        env.set_actions(NAME, ActionTuple(discrete=actions))
        env.step()
        assert env.position[0, 2] - before == pytest.approx(expected, abs=0.01)


def test_spawn_falls_without_friction() -> None:
    env = hallway()
    place(env, 0.0, -15.0)
    env.position[:, 1] = 1.5
    env.velocity[:, 2] = 3.0
    play(env, NONE)
    assert env.velocity[0, 2] == pytest.approx(3.0 * 0.96**6) and env.position[0, 1] < 1.5
    for _ in range(2):
        play(env, NONE)
    assert env.position[0, 1] == pytest.approx(1.0) and env.velocity[0, 2] == 0


@pytest.mark.parametrize("yaw", [0.0, 30.0, 90.0, 225.0])
def test_walls_hold_at_full_speed(yaw: float) -> None:
    env = hallway(4)
    place(env, 6.0, -15.0, yaw)
    env.symbol[:, 2] = 5.0
    env.velocity[:] = [[24, 0, 0], [-24, 0, 0], [17, 0, -17], [-17, 0, -17]]
    reach = 0.5 * (abs(math.sin(math.radians(yaw))) + abs(math.cos(math.radians(yaw))))
    for _ in range(200):
        env.simulate()
        assert (np.abs(env.position[:, 0]) <= 9.5 - reach + 1e-9).all()
        assert (np.abs(env.position[:, 2]) <= 24.75 - reach + 1e-9).all()
    assert not env.velocity[:, [0, 2]].any()
    assert env.position[0, 0] == pytest.approx(9.5 - reach)


@pytest.mark.parametrize(("x", "z", "way"), [(0.0, -6.3, 1), (1.9, -6.3, 1), (0.5, 6.2, -1)])
def test_symbol_blocks_are_solid(x: float, z: float, way: int) -> None:
    """At 24 m/s the agent stops at the face that it came to: 0.5 + 0.5 before the block's middle."""
    env = hallway()
    place(env, x, z, symbol_z=0.0)
    for _ in range(40):
        env.velocity[:, 2] = 24.0 * way
        env.simulate()
        assert env.position[0, 2] * way <= -1 + 1e-9
    assert env.position[0, 2] == pytest.approx(-1.0 * way) and env.position[0, 0] == pytest.approx(x)


def test_ray_to_the_symbol() -> None:
    """The block's face is 3.5 m before the agent's centre; the sphere's centre travels 3.0 m of 12."""
    env = hallway()
    place(env, 0.0, -8.0)
    np.testing.assert_allclose(rays(env)[0], [0, 0, 1, 0, 0, 0, 3 / 12], rtol=1e-6)
    env.shows_x[:] = True
    np.testing.assert_allclose(rays(env)[0], [0, 0, 0, 1, 0, 0, 3 / 12], rtol=1e-6)


def test_rays_go_right_first() -> None:
    """At x = 5 the right wall is met by rays 1 (35 degrees) and 3 (70), the left one by none."""
    env = hallway()
    place(env, 5.0, 5.0, symbol_z=-4.0)
    frame = rays(env)
    for ray, degrees in ((1, 35), (3, 70)):
        way = 4 / math.sin(math.radians(degrees)) / 12  # to x = 9.5 - 0.5
        np.testing.assert_allclose(frame[ray], [0, 0, 0, 0, 1, 0, way], rtol=1e-6)
    for ray in (0, 2, 4):
        np.testing.assert_array_equal(frame[ray], [0, 0, 0, 0, 0, 1, 1])


@pytest.mark.parametrize("side", [1, -1])
def test_rays_see_the_thin_plates(side: int) -> None:
    """The sphere of radius 0.5 meets the plate's top edge, 0.45 below its centre, 0.218 m before it."""
    env = hallway()
    place(env, 7.0 * side, 15.0)
    way = (20.29 - 15 - math.sqrt(0.5**2 - 0.45**2)) / 12
    expected = np.zeros(7)
    expected[0 if side == 1 else 1], expected[6] = 1, way
    np.testing.assert_allclose(rays(env)[0], expected, rtol=1e-6)


def test_a_touched_wall_is_skipped() -> None:
    """Pressed at the right wall, facing it: no ray reports it; those along the hall reach the end wall."""
    env = hallway()
    place(env, 9.0, -20.0, yaw_deg=100.0)
    frame = rays(env)
    np.testing.assert_array_equal(frame[0], [0, 0, 0, 0, 0, 1, 1])
    way = 4.25 / math.cos(math.radians(10)) / 12  # 70 degrees to the right, nearly -z: to z = -24.75 + 0.5
    np.testing.assert_allclose(frame[3], [0, 0, 0, 0, 1, 0, way], rtol=1e-6)


def test_gravity_acts_at_once() -> None:
    env = hallway()
    place(env, 0.0, -15.0)
    env.position[:, 1] = 1.5
    env.set_parameter("gravity", 5.0)
    env.simulate()
    assert env.velocity[0, 1] == pytest.approx(-5.0 * 0.02 * 0.96)


def test_unitys_policy_remembers(shared: Path) -> None:
    """Sheet: 0.94; 0.7 would be reached even with the friction of half that size."""
    pytest.importorskip("onnxruntime")
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    assert spec is not None and spec.loader is not None
    run_policy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run_policy)
    policy = run_policy.OfficialPolicy(
        str(shared / "oracle" / "Hallway.onnx"), np.random.default_rng(0), False
    )
    done = run_policy.play(make_scene("Hallway", num_areas=32), {"Hallway": policy}, 200, 2000)
    returns = np.array([row[0] for row in done[NAME]])
    assert len(returns) >= 200 and returns.mean() > 0.9
