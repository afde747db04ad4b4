"""Pyramids against numbers worked out by hand from its sheet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.pyramids.bodies import contact_point
from mappo_unity.scenes.pyramids.bricks import ABSENT, ASLEEP, AWAKE, CALM_SUBSTEPS, FALLING, SUBSTEPS
from mappo_unity.scenes.pyramids.layout import ZONES
from mappo_unity.scenes.pyramids.scene import Pyramids

NAME = "Pyramids?team=0"
NONE, FORWARD, BACKWARD, RIGHT, LEFT = range(5)
BLOCK_TAG, WALL_TAG, GOAL_TAG, SWITCH_OFF_TAG, SWITCH_ON_TAG, STONE_TAG = range(6)
MISS, DISTANCE = 6, 7
AREA = np.array([0])
CORNERS = [(-30, -30), (0, -30), (30, -30), (-30, 30), (0, 30), (30, 30)]


def pyramids(num_areas: int = 1, seed: int = 0) -> Pyramids:
    env = make_scene("Pyramids", num_areas=num_areas, seed=seed)
    assert isinstance(env, Pyramids)
    env.reset()
    return env


def place(env: Pyramids, x: float, z: float, yaw: float, switch: tuple[float, float] = (30.0, 0.0)) -> None:
    """Put the agent at rest on the floor, six stone pyramids in the corner rooms, the switch on the floor."""
    spots = np.array([[(x, z), switch, *CORNERS]], float)
    env.bodies.place(AREA, spots, np.radians([yaw]))
    env.bricks.surround(AREA, spots[:, 2:])
    env.bodies.age[:] = 100
    env.bodies.position[0, 1] = 0.5
    env.bodies.switch_position[0, 1] = 2.0


def play(env: Pyramids, action: int = NONE, rounds: int = 1) -> tuple[DecisionSteps, TerminalSteps]:
    """Take one action for some decisions; stop at a terminal step."""
    for _ in range(rounds):
        count = len(env.get_steps(NAME)[0])
        env.set_actions(NAME, ActionTuple(discrete=np.full((count, 1), action, np.int32)))
        env.step()
        if len(env.get_steps(NAME)[1]):
            break
    return env.get_steps(NAME)


def frame(env: Pyramids, sensor: int = 0) -> np.ndarray:
    """Return the rays of a sensor, [7, 8]."""
    return env.observe(0, AREA)[sensor].reshape(7, 8)


def test_spec() -> None:
    env = make_scene("Pyramids")
    env.reset()
    spec = env.behavior_specs[NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [
        ("RayPerceptionSensor", (56,)),
        ("RayPerceptionSensor1", (56,)),
        ("RayPerceptionSensor2", (56,)),
        ("VectorSensor_size4", (4,)),
    ]
    assert spec.action_spec.discrete_branches == (5,) and spec.action_spec.continuous_size == 0
    decisions, _ = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(16)) and not decisions.group_id.any()


def test_there_are_no_parameters() -> None:
    with pytest.raises(ConfigError, match="choices: none"):
        make_scene("Pyramids", gravity=3.0)


def test_resets_use_nine_zones_once_each() -> None:
    env = pyramids(300, seed=4)
    env.bodies.switch_spin[:] = 1.0
    env.begin_episode(np.arange(300))
    bodies = env.bodies
    spots = np.concatenate(
        [
            bodies.position[:, None, ::2],
            bodies.switch_position[:, None, ::2],
            env.brick_spot[:, None],
            bodies.stone_root,
        ],
        axis=1,
    )
    away = np.abs(spots[:, :, None] - ZONES)
    zone = away.max(axis=3).argmin(axis=2)
    assert (np.sort(zone, axis=1) == np.arange(9)).all()
    offset = away.max(axis=3).min(axis=2)
    assert 11.8 < offset.max() <= 11.905
    assert len({tuple(row) for row in zone[:, :3].tolist()}) > 150  # all kinds of orders
    assert (bodies.position[:, 1] == 2.0).all() and (bodies.switch_position[:, 1] == 4.0).all()
    degrees = np.degrees(bodies.yaw)
    np.testing.assert_allclose(degrees, np.round(degrees), atol=1e-9)
    assert degrees.min() >= 0 and 300 < degrees.max() < 360
    assert (bodies.switch_spin == 1.0).all() and not bodies.switch_yaw.any()
    assert not env.switch_on.any() and (env.bricks.mode == ABSENT).all()
    assert not bodies.velocity.any()


def test_price_of_a_decision_and_time_limit() -> None:
    env = pyramids()
    place(env, 0.0, 0.0, 0.0)
    decisions, _ = play(env)
    assert decisions.reward[0] == pytest.approx(-0.001)
    env.agents.step_count[0] = 4998
    decisions, terminals = play(env)
    assert terminals.interrupted.tolist() == [True] and terminals.agent_id.tolist() == [0]
    assert terminals.reward[0] == pytest.approx(-3 / 5000) and not len(decisions)


def test_speed_on_the_ground() -> None:
    """Each tick: v <- (v + 2) * 0.96, then 1.2 * 9.81 * 0.02 * 0.96 is lost to the floor; at most 42.4."""
    env = pyramids()
    place(env, -40.0, 0.0, 90.0)
    speed = 0.0
    for _ in range(10):
        speed = (speed + 2.0) * 0.96 - 0.2260224
    decisions, _ = play(env, FORWARD, 2)
    np.testing.assert_allclose(decisions.obs[3][0], [0.0, 0.0, 0.0, speed], atol=1e-5)
    np.testing.assert_allclose(env.bodies.velocity[0], [speed, 0.0, 0.0], atol=1e-6)
    env.bodies.velocity[0, 0] = (1.92 - 0.2260224) / 0.04
    env.bodies.position[0, 0] = -40.0
    decisions, _ = play(env, FORWARD)
    assert decisions.obs[3][0, 3] == pytest.approx(42.35, abs=0.01)


def test_turning_and_the_velocity_in_the_agents_frame() -> None:
    env = pyramids()
    place(env, 0.0, 0.0, 0.0)
    env.bodies.velocity[0] = (3.0, 0.0, 0.0)
    play(env, RIGHT)
    assert np.degrees(env.bodies.yaw[0]) == pytest.approx(20.0)
    env.bodies.yaw[0] = np.radians(90.0)
    env.bodies.velocity[0] = (0.0, 0.0, 5.0)  # to its left
    np.testing.assert_allclose(env.observe(0, AREA)[3][0], [0.0, -5.0, 0.0, 0.0], atol=1e-6)


def test_agents_fall_from_two_metres() -> None:
    env = pyramids()
    height = []
    for _ in range(7):
        play(env)
        height.append(env.bodies.position[0, 1])
    speed, fallen = 0.0, 0.0
    for _ in range(5):
        speed = (speed + 0.1962) * 0.96
        fallen += 0.02 * speed
    assert height[0] == pytest.approx(2.0 - fallen)
    assert height[-1] == pytest.approx(0.5, abs=0.01) and height[4] > 0.6


@pytest.mark.parametrize(
    ("yaw", "axis", "face"), [(0, 2, 49.1), (90, 0, 49.5), (180, 2, -49.6), (270, 0, -49.5)]
)
def test_outer_walls_stop_agents(yaw: float, axis: int, face: float) -> None:
    env = pyramids()
    place(env, 0.0, 0.0, yaw)
    env.bodies.position[0, axis] = 0.8 * face
    play(env, FORWARD, 12)
    assert env.bodies.position[0, axis] == pytest.approx(face - np.sign(face) * 0.5, abs=0.02)
    assert frame(env)[0, MISS] == 1.0  # what the eyes touch is not seen


def test_inner_walls_and_stones_stop_agents() -> None:
    env = pyramids()
    place(env, -16.55, 0.0, 0.0)
    play(env, FORWARD, 8)
    assert env.bodies.position[0, 2] == pytest.approx(16.56 - 7.5 - 0.5, abs=0.02)
    place(env, 0.0, 10.0, 0.0)
    play(env, FORWARD, 12)
    assert env.bodies.position[0, 2] == pytest.approx(30 - 1.06 - 0.5 - 0.5, abs=0.02)


def test_ray_order_walls_and_pitch() -> None:
    env = pyramids()
    place(env, -40.0, 0.0, 270.0)  # 9.5 m from the wall at -49.5
    level, up, higher = (frame(env, sensor) for sensor in range(3))
    assert level[0, WALL_TAG] == up[0, WALL_TAG] == higher[0, WALL_TAG] == 1.0
    assert level[0, DISTANCE] == pytest.approx(9.0 / 35)
    pitch = np.arctan2(5, 35)
    radius = 0.5 / np.cos(pitch)  # scaled with the ray's length
    assert up[0, DISTANCE] * 35.355339 == pytest.approx((9.5 - radius) / np.cos(pitch), abs=1e-4)
    assert level[1, WALL_TAG] == level[2, WALL_TAG] == 1.0
    assert level[1, DISTANCE] == pytest.approx(9.0 / np.cos(np.radians(70 / 3)) / 35)
    place(env, -26.0, 0.0, 270.0)  # 23.5 m away: the steepest ray passes 2 m above the wall's 5 m
    assert frame(env, 0)[0, WALL_TAG] == 1.0 and frame(env, 2)[0, MISS] == 1.0
    place(env, 40.0, 0.0, 0.0)
    rays = frame(env)  # to the right: the outer wall; to the left the inside of the arena
    assert rays[5, DISTANCE] == pytest.approx(9.0 / np.sin(np.radians(70)) / 35)
    assert rays[6, DISTANCE] > 2 * rays[5, DISTANCE]


def test_stones_fall_and_are_seen_by_layers() -> None:
    env = pyramids()
    place(env, 0.43, 10.0, 0.0)
    level, up, higher = (frame(env, sensor) for sensor in range(3))
    assert level[0, STONE_TAG] == 1.0
    assert level[0, DISTANCE] == pytest.approx((30 - 1.06 - 0.5 - 0.5 - 10) / 35)
    assert up[0, STONE_TAG] == 1.0 and up[0, DISTANCE] > level[0, DISTANCE]  # a layer that stands back
    assert higher[0, MISS] == 1.0
    env.bodies.age[:] = 0
    assert frame(env)[0, STONE_TAG] == 0.0  # the lowest layer is still above 1.6 m
    np.testing.assert_allclose(env.bodies.stone_heights(AREA)[0], [2.151, 3.25, 4.38, 5.52])
    env.bodies.age[:] = 40
    np.testing.assert_allclose(env.bodies.stone_heights(AREA)[0], [0.5, 1.5, 2.5, 3.5])


def test_pressing_the_switch_brings_the_brick_pyramid() -> None:
    env = pyramids()
    place(env, 24.0, 0.0, 90.0)
    env.brick_spot[0] = (0.0, 0.0)
    rays = frame(env)
    assert rays[0, SWITCH_OFF_TAG] == 1.0 and rays[0, DISTANCE] == pytest.approx((6 - 2 - 0.5) / 35)
    while not env.switch_on[0]:
        decisions, terminals = play(env, FORWARD)
    assert not len(terminals) and decisions.obs[3][0, 0] == 1.0
    assert env.bricks.mode.tolist() == [FALLING]
    assert frame(env)[0, SWITCH_OFF_TAG] == 0.0
    env.bodies.position[0, 0] = 20.0
    env.bodies.yaw[0] = np.radians(90.0)
    assert frame(env)[0, SWITCH_ON_TAG] == 1.0
    for _ in range(40):
        play(env)
    assert env.bricks.mode.tolist() == [ASLEEP]
    assert env.bricks.bodies[0, -1, 1] == pytest.approx(5.0, abs=0.05)  # the goal on four layers
    layers = np.sort(env.bricks.bodies[0, :25, 1])
    np.testing.assert_allclose(layers, np.repeat([0.5, 1.5, 2.5, 3.5], [12, 8, 4, 1]), atol=0.1)
    env.bodies.position[0] = (0.0, 0.5, -10.0)
    env.bodies.yaw[0] = 0.0
    level, up = frame(env, 0), frame(env, 1)
    assert level[0, BLOCK_TAG] == 1.0 and level[0, DISTANCE] * 35 == pytest.approx(10 - 1.06 - 1.0, abs=0.2)
    assert up[0, BLOCK_TAG] == 1.0
    env.bodies.position[0] = (0.45, 0.5, -15.5)  # the steepest ray is 5 m high there, above the top brick
    assert frame(env, 2)[0, GOAL_TAG] == 1.0


def test_a_pushed_switch_turns_and_comes_to_rest() -> None:
    """A push on its right half turns it clockwise; 7 rad/s at most; the floor stops it again."""
    env = pyramids()
    place(env, 31.0, -10.0, 0.0)
    play(env, FORWARD, 6)
    assert env.switch_on[0]
    spin = env.bodies.switch_spin[0]
    assert env.bodies.switch_yaw[0] < -0.1 and -7.5 < spin  # pushed along +z at x > 0: counterclockwise
    env.bodies.position[0] = (0.0, 0.5, 0.0)
    env.bodies.velocity[:] = 0
    env.bodies.switch_spin[0] = 5.0
    env.simulate()
    loss = 1.2 * 9.81 * np.sqrt(8) / (32 / 12) * 0.02
    assert env.bodies.switch_spin[0] == pytest.approx(5.0 * 0.999 - loss)
    for _ in range(40):
        env.simulate()
    assert env.bodies.switch_spin[0] == 0.0


def test_contact_points() -> None:
    """Flush faces touch in the middle of what they share, an edge where it is."""
    offset = np.array([[1.8, 0.0, 2.5], [0.0, 0.0, 2.0 + np.sqrt(0.5)]])
    point = contact_point(offset, np.radians([0.0, 45.0]), np.zeros(2), np.array([[0.0, 0, 1]] * 2))
    np.testing.assert_allclose(point, [[(1.3 + 2.0) / 2, 2.0], [0.0, 2.0]], atol=1e-9)


def test_the_goal_ends_the_episode_and_replaces_the_reward() -> None:
    env = pyramids()
    place(env, 0.45, -8.0, 0.0)
    env.switch_on[0] = True
    env.bricks.appear(AREA, np.zeros((1, 2)))
    for _ in range(30):
        play(env)
    env.bricks.bodies[0, -1, :3] = (0.45, 1.0, -5.0)  # as if it had rolled down
    env.bricks.bodies[0, -1, 3:] = (1, 0, 0, 0)
    assert frame(env)[0, GOAL_TAG] == 1.0
    assert frame(env)[0, DISTANCE] == pytest.approx((3 - 1 - 0.5) / 35)
    decisions, terminals = play(env, FORWARD, 6)
    assert terminals.reward.tolist() == [2.0] and terminals.interrupted.tolist() == [False]
    assert env.bricks.mode.tolist() == [ABSENT] and not env.switch_on.any()


@pytest.mark.parametrize("gap", [0.05, 0.3, 0.55])
def test_a_goal_that_is_thrown_clear_within_the_tick_has_been_touched(gap: float) -> None:
    env = pyramids()
    place(env, 0.0, -10.0, 0.0)
    env.switch_on[0] = True
    env.bricks.appear(AREA, np.zeros((1, 2)))
    play(env, NONE, 40)
    env.bricks.bodies[0, -1] = (0.0, 1.0, -10.0 + 1.5 + gap, 1, 0, 0, 0)
    env.bodies.velocity[0, 2] = 35.0  # 0.66 m in the tick after drag: the goal is hit and flies ahead
    env.simulate()
    assert env.bricks.mode.tolist() == [ABSENT] and not env.switch_on.any()
    assert env.agents.done.tolist() == [True]


def test_an_agent_falls_on_beside_an_awake_pile() -> None:
    env = pyramids()
    place(env, 0.0, -6.0, 0.0)
    env.bodies.position[0, 1] = 2.0
    env.bricks.appear(AREA, np.array([[18.1, 18.1]]))
    heights = []
    for _ in range(35):
        env.simulate()
        heights.append(env.bodies.position[0, 1])
    assert env.bricks.mode.tolist() == [AWAKE]
    assert (
        heights[0] < 2.0 and np.all(np.diff(heights[:20]) < 0) and heights[-1] == pytest.approx(0.5, abs=0.01)
    )


def test_ramming_topples_the_pile_and_slows_the_agent() -> None:
    env = pyramids()
    place(env, 0.0, -6.0, 0.0)
    env.bricks.appear(AREA, np.zeros((1, 2)))
    play(env, NONE, 40)
    assert env.bricks.mode.tolist() == [ASLEEP]
    before = env.bricks.bodies[0].copy()
    env.bodies.velocity[0, 2] = 30.0
    play(env, NONE, 2)
    assert env.bricks.mode.tolist() == [AWAKE]
    assert env.bodies.velocity[0, 2] < 16.0  # 18 without the bricks
    play(env, NONE, 60)
    moved = np.abs(env.bricks.bodies[0, :, :3] - before[:, :3]).max(axis=1)
    assert (moved > 0.5).sum() >= 5
    assert np.abs(env.bricks.bodies[0, :, [0, 2]]).max() < 49.7 and env.bricks.bodies[0, :, 1].min() > 0.4
    env.bodies.position[0] = (-40.0, 0.5, 0.0)
    play(env, NONE, 60)
    assert env.bricks.mode.tolist() == [ASLEEP]


@pytest.mark.parametrize(
    "brick, agent, where, steps",
    [
        (15.9, 0.0, 0.0, [CALM_SUBSTEPS]),
        (16.1, 0.0, 0.0, [SUBSTEPS]),  # a fast brick
        (0.0, 15.9, 0.0, [CALM_SUBSTEPS]),
        (0.0, 16.1, 0.0, [SUBSTEPS]),  # a fast agent in the pile
        (0.0, 40.0, 20.0, [CALM_SUBSTEPS]),  # one that is far from it
    ],
)
def test_a_calm_pile_takes_longer_steps(
    brick: float, agent: float, where: float, steps: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    env = pyramids()
    env.bricks.appear(AREA, np.zeros((1, 2)))
    env.bricks.mode[:] = AWAKE
    env.bricks.bodies[0, :, 1] += 10.0  # in the air, where they do not touch the agent
    env.bricks._speeds[0, 0, 0] = brick
    position = np.array([[where, 12.0 if where == 0.0 else 0.5, 0.0]])

    taken = []
    step = env.bricks._physics.step
    monkeypatch.setattr(
        env.bricks._physics,
        "step",
        lambda count, areas, dt: taken.append((count, dt)) or step(count, areas, dt),
    )
    switch = np.zeros((1, 3)), np.zeros(1)
    env.bricks.step(position, np.array([[agent, 0.0, 0.0]]), np.zeros(1), switch)
    assert taken == [(count, pytest.approx(0.02 / count)) for count in steps]


def test_sleeping_piles_do_not_move_and_a_pile_in_a_wall_is_not_replayed() -> None:
    env = pyramids()
    env.bricks.appear(AREA, np.array([[18.1, 18.1]]))
    assert env.bricks.mode.tolist() == [AWAKE]
    env.bricks.appear(AREA, np.array([[20.0, 20.0]]))
    assert env.bricks.mode.tolist() == [FALLING]


def played(env: Pyramids, rounds: int) -> list[Any]:
    rng = np.random.default_rng(5)
    seen: list[Any] = []
    for _ in range(rounds):
        decisions, terminals = env.get_steps(NAME)
        seen += [*(obs.copy() for obs in decisions.obs), decisions.reward, terminals.agent_id]
        actions = rng.integers(0, 5, (len(decisions), 1)).astype(np.int32)
        env.set_actions(NAME, ActionTuple(discrete=actions))
        env.step()
    return [*seen, env.bricks.bodies.copy()]


def test_state_is_exact_with_awake_falling_and_sleeping_piles() -> None:
    env = pyramids(3, seed=2)
    env.bricks.appear(np.arange(2), env.brick_spot[:2])
    played(env, 25)
    env.bricks.appear(np.array([2]), env.brick_spot[2:])
    env.bodies.position[0, ::2] = env.brick_spot[0] + (0.0, -2.5)
    env.bodies.velocity[0, 2] = 10.0
    played(env, 4)
    assert env.bricks.mode.tolist() == [AWAKE, FALLING, FALLING]
    state = env.get_state()
    first = played(env, 12)
    other = pyramids(3, seed=9)
    other.set_state(state)
    second = played(other, 12)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_contract() -> None:
    check_env(make_scene("Pyramids", num_areas=4), steps=150)
