"""GridFoodCollector against numbers worked out by hand from its sheet."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DimensionProperty

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.grid_food_collector.scene import (
    AGENT,
    BAD_FOOD,
    FOOD,
    FROZEN,
    FROZEN_TICKS,
    WALLS,
    GridFoodCollector,
)

NAME = "GridFoodCollector?team=0"
CORNERS = np.array([[-40.0, -40, 40, 40, 0], [-40, 40, -40, 40, -44]])  # x and z, out of the way


def placed(num_areas: int = 1, **options: Any) -> GridFoodCollector:
    """Return a started scene: agents at rest on the floor in CORNERS, yaw 0, all food in a far row."""
    env = GridFoodCollector(num_areas=num_areas, **options)
    env.reset()
    physics = env.physics
    physics.agent_position[1] = physics.agent_half
    physics.agent_position[::2] = CORNERS[:, None]
    physics.agent_velocity[...] = 0
    env.yaw_degrees[:] = 0
    physics.agent_yaw[...] = 0
    physics.ball_position[0] = np.linspace(-45, 45, 50)
    physics.ball_position[1] = 0.75
    physics.ball_position[2] = 48.0
    return env


def put(env: GridFoodCollector, agent: int, x: float, z: float, yaw: int = 0) -> None:
    env.physics.agent_position[:, 0, agent] = x, env.physics.agent_half[0, agent], z
    env.yaw_degrees[0, agent] = yaw
    env.physics.agent_yaw[0, agent] = np.radians(yaw)


def grid(env: GridFoodCollector, agent: int) -> np.ndarray:
    return env.observe(0, np.array([agent]))[0][0]


def cells(channel: np.ndarray) -> set[tuple[int, int]]:
    return {(int(h), int(w)) for h, w in np.argwhere(channel)}


def act(env: GridFoodCollector, agent: int, *continuous: float, shoot: bool = False) -> None:
    """Play one decision (five ticks): `agent` acts, the others do nothing."""
    action = ActionTuple(np.zeros((5, 3), np.float32), np.zeros((5, 1), np.int32))
    action.continuous[agent] = continuous
    action.discrete[agent] = shoot
    env.set_actions(NAME, action)
    env.step()


def test_spec_ids_and_groups() -> None:
    env = make_scene("GridFoodCollector")
    env.reset()
    assert list(env.behavior_specs) == [NAME]
    spec = env.behavior_specs[NAME]
    (sensor,) = spec.observation_specs
    assert (sensor.name, sensor.shape) == ("GridSensor-OneHot", (5, 40, 40))
    flat = DimensionProperty.TRANSLATIONAL_EQUIVARIANCE
    assert tuple(sensor.dimension_property) == (DimensionProperty.NONE, flat, flat)
    assert spec.action_spec.continuous_size == 3 and spec.action_spec.discrete_branches == (2,)
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(20)) and not decisions.group_id.any()
    assert not decisions.action_mask[0].any() and len(terminals) == 0


def test_reset_ranges() -> None:
    env = GridFoodCollector(num_areas=200)
    env.reset()
    agents, food = env.physics.agent_position, env.physics.ball_position
    for places in (agents[::2], food[::2]):
        assert 44.5 < np.abs(places).max() <= 45 and abs(places.mean()) < 1.5
    assert (agents[1] == 1.5).all() and (food[1] == 0.75).all() and not env.physics.agent_velocity.any()
    assert env.yaw_degrees.min() == 0 and env.yaw_degrees.max() == 359


def test_agents_keep_the_food_at_their_end_and_env_reset_renews_it() -> None:
    env = placed()
    env.physics.ball_spin[...] = 0
    env.agents.step_count[:] = 4997
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert terminals.agent_id.tolist() == [0, 1, 2, 3, 4] and terminals.interrupted.all()
    assert len(decisions) == 0  # it ended in the third tick, sent in the fourth
    assert (env.physics.ball_position[2] == 48.0).all()
    assert np.abs(env.physics.agent_position[::2, 0] - CORNERS).max() > 1
    env.reset()
    assert np.abs(env.physics.ball_position[2]).max() <= 45


# Grid: h grows to the left, w forwards; the agent sits between cells 19 and 20. Food shows as a disc of
# radius sqrt(0.75^2 - 0.24^2) = 0.7106 m (its centre is 0.25 m above the agent's, a cell 0.01 m thick).
@pytest.mark.parametrize(
    ("yaw", "x", "z", "middle"),
    [
        (0, 0.5, 10.5, (19, 30)),
        (0, 10.5, 0.5, (9, 20)),
        (90, 10.5, -0.5, (19, 30)),
        (180, -0.5, -10.5, (19, 30)),
        (270, 0.5, 10.5, (9, 19)),
    ],
)
def test_grid_axes(yaw: int, x: float, z: float, middle: tuple[int, int]) -> None:
    env = placed()
    put(env, 0, 3.0, -2.0, yaw)
    env.physics.ball_position[:, 0, 0] = 3.0 + x, 0.75, -2.0 + z
    h, w = middle
    cross = {(h, w), (h - 1, w), (h + 1, w), (h, w - 1), (h, w + 1)}
    diagonal = {(h + i, w + j) for i in (-1, 1) for j in (-1, 1)}
    assert cells(grid(env, 0)[FOOD]) == cross | diagonal  # nearest point of a diagonal cell: 0.7071 m


def test_food_shows_as_a_disc_and_not_before_it_has_fallen() -> None:
    env = placed()
    put(env, 0, 0, 0)
    env.physics.ball_position[:, 0, 30] = 0.52, 0.75, 10.5  # 0.2 to the right of the cell's middle: 0.721 m
    assert cells(grid(env, 0)[BAD_FOOD]) == {
        (18, 30),
        (19, 30),
        (20, 30),
        (19, 29),
        (19, 31),
        (18, 29),
        (18, 31),
    }
    env.physics.ball_position[1, 0, 30] = 1.27
    assert not grid(env, 0)[BAD_FOOD].any()
    env.physics.ball_position[:, 0, 30] = 0.5, 1.25, 10.5  # a disc of 0.12 m
    assert cells(grid(env, 0)[BAD_FOOD]) == {(19, 30)}


def test_agents_show_as_turned_squares_without_oneself() -> None:
    env = placed()
    put(env, 0, 0, 0)
    put(env, 1, 0.5, 10.5)  # exactly on a cell: its neighbours touch too
    put(env, 2, -10.0, 0.5, yaw=45)  # a diamond of half-diagonal 0.7071 on the corner of cells 29 and 30
    env.frozen[0, 2] = True
    one = grid(env, 0)
    assert {(19, 30)} <= cells(one[AGENT]) <= {(h, w) for h in (18, 19, 20) for w in (29, 30, 31)}
    # cells 1 m wide whose middles are 0.5 m left and right, and 1 m above and below
    assert cells(one[FROZEN]) == {(29, 20), (30, 20), (29, 19), (30, 19), (29, 21), (30, 21)}
    env.physics.agent_position[0, 0, 1] += 0.25
    assert cells(grid(env, 0)[AGENT]) <= {(h, w) for h in (18, 19) for w in (29, 30, 31)}


def test_walls_show_as_their_inner_and_outer_faces() -> None:
    env = placed()
    put(env, 0, 0, 40.25)  # faces at 9.75 and 10.75 ahead: cells 29 (9..10) and 30 (10..11)
    assert cells(grid(env, 0)[WALLS]) == {(h, w) for h in range(40) for w in (29, 30)}
    put(env, 0, 0, 40.25, yaw=90)  # now to the left: right = -9.75 and -10.75
    assert cells(grid(env, 0)[WALLS]) == {(h, w) for w in range(40) for h in (29, 30)}
    put(env, 0, 45.25, -45.25)  # corner at right 4.75, 5.75 and behind -4.75, -5.75
    inner = {(15, w) for w in range(15, 40)} | {(h, 15) for h in range(15, 40)}
    outer = {(14, w) for w in range(14, 40)} | {(h, 14) for h in range(14, 40)}
    assert cells(grid(env, 0)[WALLS]) == inner | outer
    put(env, 0, 20, 0)
    assert not grid(env, 0)[WALLS].any()


def test_turned_walls_cover_every_cell_that_a_face_crosses() -> None:
    env = placed()
    put(env, 0, 41.3, 43.7, yaw=33)
    env.physics.ball_position[2] = -48.0
    points = np.linspace(-51, 51, 40_001)
    wanted = set()
    for face in (50.0, 51.0):
        line = points[np.abs(points) <= face]
        side = np.full_like(line, face)
        for x, z in ((side, line), (line, side)):
            dx, dz = x - 41.3, z - 43.7
            right = dx * np.cos(np.radians(33)) - dz * np.sin(np.radians(33))
            ahead = dx * np.sin(np.radians(33)) + dz * np.cos(np.radians(33))
            h, w = np.floor(20 - right), np.floor(20 + ahead)
            seen = (h >= 0) & (h < 40) & (w >= 0) & (w < 40)
            wanted |= set(zip(h[seen].astype(int).tolist(), w[seen].astype(int).tolist(), strict=True))
    found = cells(grid(env, 0)[WALLS])
    assert wanted <= found and len(found - wanted) <= 2  # corners cut by less than the sampling


def test_nearest_thing_wins_a_cell() -> None:
    env = placed()
    put(env, 0, 0, 0)
    env.physics.ball_position[:, 0, 0] = 0.5, 0.75, 11.6
    env.physics.ball_position[:, 0, 30] = 0.5, 0.75, 10.0
    one = grid(env, 0)
    assert one[:, 19, 30].tolist() == [0, 0, 0, 1, 0] and one[:, 19, 31].tolist() == [1, 0, 0, 0, 0]
    assert one.sum(axis=0).max() == 1


def test_scale_stretches_the_grid_and_the_body() -> None:
    env = placed(agent_scale=2.0)
    assert (env.physics.agent_half == 1.0).all()
    put(env, 0, 0, 0)
    env.physics.ball_position[:, 0, 0] = 1.0, 0.75, 21.0  # right 1 = 19.5 - 19 cells of 2 m
    assert cells(grid(env, 0)[FOOD]) == {(19, 30)}


def test_top_speed_turning_and_shooting_speed() -> None:
    env = placed()
    put(env, 4, 0, -44)
    speeds = []
    for _ in range(24):
        act(env, 4, 1, 0, 0)
        env.physics.agent_position[2, 0, 4] = -20
        speeds.append(env.physics.agent_velocity[2, 0, 4])
    assert speeds[-1] == pytest.approx(29.36, abs=0.05)  # ((0.95 v + 2) 0.99 - 1.2 g dt 0.99 = v)
    for _ in range(12):
        act(env, 4, 1, 0, 0, shoot=True)
        env.physics.agent_position[2, 0, 4] = -20
    assert env.physics.agent_velocity[2, 0, 4] == pytest.approx(2.94, abs=0.01)
    env.physics.agent_velocity[...] = 0
    act(env, 4, 0, 0, 0.01)
    assert env.yaw_degrees[0, 4] == 330  # five ticks of 6 degrees to the left
    act(env, 4, 0, 0, -1)
    assert env.yaw_degrees[0, 4] == 0
    act(env, 4, 0, 0, 0)
    assert env.yaw_degrees[0, 4] == 0


def test_a_single_tick_of_drive() -> None:
    env = placed()
    env.agents.continuous[4] = 1, 0.5, 0
    env.act(env.agents.order)
    env.simulate()
    speed = np.hypot(2, 1) * 0.99 - 1.2 * 9.81 * 0.02 * 0.99  # the floor takes the damped fall of a tick
    want = np.array([1, 2]) / np.hypot(2, 1) * speed
    assert env.physics.agent_velocity[::2, 0, 4] == pytest.approx(want, rel=1e-9)


def test_eaten_food_rewards_and_falls_in_again_with_the_push() -> None:
    env = placed()
    put(env, 4, 0, 0)
    env.physics.ball_position[:, 0, 3] = 0, 0.75, 1.26  # 0.01 m before the agent's face
    env.physics.agent_velocity[2, 0, 4] = 3.0
    act(env, 4, 0, 0, 0)
    decisions, _ = env.get_steps(NAME)
    assert decisions.reward.tolist() == [0, 0, 0, 0, 1]
    pushed = env.physics.ball_velocity[2, 0, 3]
    # 2.97 m/s after drag; 0.5 m/s of approach may remain (gap of 0.01 m): the ball gets two thirds of 2.47
    # and loses 0.6 g dt on the floor; the agent keeps 2.97 - 0.8233 and slides on
    assert pushed == pytest.approx(2 / 3 * 2.47 - 0.6 * 9.81 * 0.02, abs=1e-4)
    slid = 2.97 - 2.47 / 3
    for tick in range(5):
        slid = (slid * 0.99 if tick else slid) - 1.2 * 9.81 * 0.02 * 0.99
    assert env.physics.agent_velocity[2, 0, 4] == pytest.approx(slid, abs=1e-4)
    assert env.physics.ball_position[1, 0, 3] > 2.3 and env.physics.ball_velocity[1, 0, 3] < -0.5
    env.physics.ball_position[:, 0, 40] = 0.9, 0.75, env.physics.agent_position[2, 0, 4]
    act(env, 4, 0, 0, 0)  # bad food, pushed into its side
    assert env.get_steps(NAME)[0].reward.tolist() == [0, 0, 0, 0, -1]


def test_rolling_is_capped_by_the_spin_limit() -> None:
    env = placed()
    env.physics.ball_position[2, 0, 0] = -45
    env.physics.ball_position[0, 0, 0] = 20
    env.physics.ball_velocity[2, 0, 0] = 12.0
    for _ in range(4):
        act(env, 0, 0, 0, 0)
    assert env.physics.ball_velocity[2, 0, 0] == pytest.approx(12 - 0.6 * 9.81 * 0.4, abs=0.01)
    for _ in range(12):
        act(env, 0, 0, 0, 0)
    assert 5.1 < env.physics.ball_velocity[2, 0, 0] < 5.3
    assert env.physics.ball_spin[0, 0, 0] == pytest.approx(7.0, abs=0.1)


def test_bodies_stay_within_the_walls_and_apart() -> None:
    env = placed()
    put(env, 0, 48.0, 20.0, yaw=45)
    env.physics.agent_velocity[0, 0, 0] = 25.0
    put(env, 1, 10, 0)
    put(env, 2, 12, 0.2)
    env.physics.agent_velocity[0, 0, 1] = 10.0
    for _ in range(10):
        act(env, 0, 0, 1, 0)
        assert env.physics.agent_position[0, 0, 0] < 50 - 0.7071 + 0.35
    assert env.physics.agent_position[0, 0, 0] == pytest.approx(50 - 0.7071, abs=0.05)
    assert env.physics.agent_position[0, 0, 2] - env.physics.agent_position[0, 0, 1] > 0.98
    assert env.physics.agent_position[0, 0, 2] > 12.1  # pushed on


def test_laser_freezes_the_first_agent_for_four_seconds() -> None:
    env = placed()
    put(env, 0, 0, 0)
    put(env, 1, 2.4, 12)  # the ray is 2 m thick, the box 0.5 m
    put(env, 2, 0, 20)
    act(env, 0, 0, 0, 0, shoot=True)
    assert env.frozen[0].tolist() == [False, True, False, False, False]
    start = env.frozen_tick[0, 1]
    assert start == 0  # the tick of the decision itself
    act(env, 1, 1, 1, 1, shoot=True)  # no motion, no turn, no shot
    assert not env.physics.agent_velocity[::2, 0, 1].any() and env.yaw_degrees[0, 1] == 0
    assert cells(grid(env, 0)[FROZEN]) and not env.laser_on.any()
    while env.frozen[0, 1]:
        act(env, 0, 0, 0, 0)
    assert FROZEN_TICKS == 201 and env.tick == 205  # thawed within this decision: tick 201


def test_food_walls_and_nearness_stop_the_laser() -> None:
    env = placed()
    put(env, 0, 0, 0)
    put(env, 1, 2.6, 12)  # passed by
    act(env, 0, 0, 0, 0, shoot=True)
    assert not env.frozen.any()
    put(env, 1, 0, 12)
    env.physics.ball_position[:, 0, 0] = 0, 0.75, 6  # in between
    act(env, 0, 0, 0, 0, shoot=True)
    assert not env.frozen.any()
    env.physics.ball_position[:, 0, 0] = 0, 0.75, 2.5  # within the sphere at its start: not seen
    act(env, 0, 0, 0, 0, shoot=True)
    assert env.frozen[0, 1]
    env.frozen[:] = False
    put(env, 1, 0, 2.4)  # an agent that close is not seen either
    act(env, 0, 0, 0, 0, shoot=True)
    assert not env.frozen.any()
    put(env, 1, 0, 27.6)  # its face is 27.1 - 2 = 25.1 m away
    act(env, 0, 0, 0, 0, shoot=True)
    assert not env.frozen.any()


def test_shots_in_turn_an_agent_frozen_by_an_earlier_one_does_not_shoot_back() -> None:
    env = placed()
    put(env, 0, 0, 0, yaw=0)
    put(env, 1, 0, 12, yaw=180)
    action = ActionTuple(np.zeros((5, 3), np.float32), np.ones((5, 1), np.int32))
    env.set_actions(NAME, action)
    env.step()
    assert env.frozen[0, :2].tolist() == [False, True]


def test_snapshot_repeats_to_the_bit() -> None:
    def trace(env: GridFoodCollector) -> list[np.ndarray]:
        rng, records = np.random.default_rng(4), []
        for _ in range(40):
            action = ActionTuple(
                rng.uniform(-1, 1, (10, 3)).astype(np.float32), rng.integers(0, 2, (10, 1)).astype(np.int32)
            )
            env.set_actions(NAME, action)
            env.step()
            records += [env.get_steps(NAME)[0].obs[0], env.get_steps(NAME)[0].reward]
        return [*records, *env.physics.get_state().values()]

    env = GridFoodCollector(num_areas=2, seed=5)
    env.reset()
    trace(env)
    state = env.get_state()
    other = GridFoodCollector(num_areas=2)
    other.set_state(state)
    for mine, his in zip(trace(env), trace(other), strict=True):
        np.testing.assert_array_equal(mine, his)


def test_contract() -> None:
    report = check_env(
        make_scene("GridFoodCollector", num_areas=2),
        60,
        remake=lambda: make_scene("GridFoodCollector", seed=3, num_areas=2),
    )
    assert report.decisions == 66 * 10
