"""Soccer's bodies against numbers worked out by hand from the sheet: drag, bounces, kicks, walls, goals."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes.soccer.physics import BALL_RADIUS, SoccerPhysics
from mappo_unity.scenes.soccer.pitch import CORNER_END, CORNER_OFFSET

BALL, AGENT, OTHER = 0, 1, 2
REACH = BALL_RADIUS + 0.5
COS = np.sqrt(0.75)
Steps = tuple[np.ndarray, np.ndarray, np.ndarray]


def pitch(blue_closed: bool = False) -> SoccerPhysics:
    """Return one field of two agents; everything stands apart and at rest."""
    physics = SoccerPhysics(1, 2, blue_closed)
    field = np.zeros(1, np.int64)
    for body, (x, z) in enumerate([(0.0, 0.0), (-5.0, 3.0), (5.0, -3.0)]):
        physics.place(body, field, x, z)
    return physics


def put(physics: SoccerPhysics, body: int, x: float, z: float, speed: tuple[float, float] = (0, 0)) -> None:
    physics.place(body, np.zeros(1, np.int64), x, z)
    physics.velocity[:, body, 0] = speed


def tick(physics: SoccerPhysics, drive: tuple[float, float] = (0, 0), kick: float = 0.0) -> Steps:
    """Advance one tick; agent 1 is driven and kicks, agent 2 does neither."""
    drives = np.zeros((2, 2, 1))
    drives[:, 0, 0] = drive
    return physics.step(drives, np.array([[kick], [0.0]]))


@pytest.mark.parametrize(
    ("speed", "way"), [(2.0, 1.96 * 0.02 * 5 / 7), (10.0, 9.8 * 0.02 - 0.35 * 0.8 * (BALL_RADIUS - 0.5))]
)
def test_ball_loses_speed_to_drag_and_way_to_the_floor(speed: float, way: float) -> None:
    physics = pitch()
    put(physics, BALL, 0, 0, (speed, 0))
    tick(physics)
    assert physics.velocity[:, BALL, 0] == pytest.approx([0.98 * speed, 0])
    assert physics.position[:, BALL, 0] == pytest.approx([way, 0])


def test_agents_approach_their_terminal_speed() -> None:
    physics = pitch()
    for _ in range(200):
        put(physics, AGENT, -5, 3, tuple(physics.velocity[:, AGENT, 0]))
        tick(physics, drive=(2, 0))
    assert physics.velocity[:, AGENT, 0] == pytest.approx([2 * 0.94 / 0.06, 0], rel=1e-3)  # 31.3 m/s
    assert physics.position[0, AGENT, 0] == pytest.approx(-5 + 31.333 * 0.02, rel=1e-3)


@pytest.mark.parametrize("distance", [0.01, 0.15])  # in contact, and met within the tick
def test_ball_bounces_off_a_wall_and_rubs(distance: float) -> None:
    physics = pitch()
    put(physics, BALL, 0, 7.508 - BALL_RADIUS - distance, (5, 10))
    tick(physics)
    assert physics.velocity[1, BALL, 0] == pytest.approx(-0.8 * 9.8)
    assert physics.velocity[0, BALL, 0] == pytest.approx(4.9 * 5 / 7)  # from slip to roll on the wall
    assert physics.spin[0] == pytest.approx(-4.9 * 5 / 7 / BALL_RADIUS)


def test_slow_ball_does_not_bounce() -> None:
    physics = pitch()
    put(physics, BALL, 0, 7.508 - BALL_RADIUS, (0, 2.0))
    tick(physics)
    assert physics.velocity[1, BALL, 0] == pytest.approx(0, abs=1e-12)


def test_spin_decays_and_is_limited() -> None:
    physics = pitch()
    physics.spin[0] = 20
    tick(physics)
    assert physics.spin[0] == 7
    tick(physics)
    assert physics.spin[0] == pytest.approx(7 * 0.98)


def test_fast_ball_is_stopped_at_the_wall_and_bounced() -> None:
    physics = pitch()
    put(physics, BALL, 0, 6.5, (0, 60))
    tick(physics)
    assert physics.position[:, BALL, 0] == pytest.approx([0, 7.508 - BALL_RADIUS])
    assert physics.velocity[:, BALL, 0] == pytest.approx([0, -0.8 * 58.8])


@pytest.mark.parametrize(("sign_x", "sign_z"), [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_ball_bounces_back_off_a_corner_wall(sign_x: int, sign_z: int) -> None:
    physics = pitch()
    middle = np.array([14.46, 6.41]) - (0.4607 / 2 + BALL_RADIUS + 0.3) * np.array([COS, 0.5])
    put(physics, BALL, sign_x * middle[0], sign_z * middle[1], (sign_x * 30 * COS, sign_z * 15))
    tick(physics)
    normal = np.array([sign_x * COS, sign_z * 0.5])
    assert physics.velocity[:, BALL, 0] == pytest.approx(-0.8 * 29.4 * normal)
    assert normal @ physics.position[:, BALL, 0] == pytest.approx(CORNER_OFFSET - BALL_RADIUS)


def test_corner_walls_lie_where_the_sheet_says() -> None:
    for x, z in ((13.56, 7.51), (15.46, 4.216)):
        assert COS * x + 0.5 * z == pytest.approx(CORNER_OFFSET, abs=3e-3)
    assert 0.5 * 15.46 - COS * 4.216 == pytest.approx(CORNER_END, abs=3e-3)


def test_agents_stop_at_walls_and_slide() -> None:
    physics = pitch()
    put(physics, AGENT, -5, 6.8, (3, 30))
    tick(physics)
    assert physics.position[1, AGENT, 0] == pytest.approx(7.008)
    assert physics.velocity[1, AGENT, 0] == pytest.approx(0, abs=1e-12)
    assert physics.velocity[0, AGENT, 0] == 0  # rubbed off: 0.6 of 28.2 is more than 2.82
    tick(physics, drive=(2, 2))
    assert physics.velocity[0, AGENT, 0] == pytest.approx(1.88 - 0.6 * 1.88)
    for _ in range(20):
        tick(physics, drive=(2, 2))
    assert physics.position[1, AGENT, 0] == pytest.approx(7.008)
    assert physics.velocity[0, AGENT, 0] > 7


def test_agents_enter_an_open_goal_and_not_a_closed_one() -> None:
    for closed, end in ((False, -17.373 + 0.5), (True, -15.01 + 0.5)):
        physics = pitch(closed)
        put(physics, AGENT, -14, 0, (-30, 0))
        for _ in range(20):
            tick(physics, drive=(-2, 0))
        assert physics.position[0, AGENT, 0] == pytest.approx(end, abs=1e-6)
        for _ in range(40):
            tick(physics, drive=(0, 2))
        if not closed:
            assert physics.position[1, AGENT, 0] == pytest.approx(4.15 - 0.5, abs=1e-6)


def test_agents_turn_around_a_post() -> None:
    physics = pitch()
    put(physics, AGENT, 14.0, 4.15, (30, 0))
    for _ in range(5):
        tick(physics)
    at = physics.position[:, AGENT, 0]
    assert np.hypot(*(at - (15.47, 4.15))) >= 0.5 - 1e-6 and at[0] < 15.0


def test_agent_hits_the_ball() -> None:
    physics = pitch()
    put(physics, AGENT, -REACH - 0.01, 0, (10, 0))
    begun, _, _ = tick(physics)
    assert begun.tolist() == [[True], [False]]
    speed = 1.8 * 50 / 53 * 9.4  # restitution 0.8, masses 50 and 3
    assert physics.velocity[0, BALL, 0] == pytest.approx(speed)
    assert physics.velocity[0, AGENT, 0] == pytest.approx(9.4 - 3 / 50 * speed)


def test_kick_comes_in_the_next_tick_and_once_a_contact() -> None:
    physics = pitch()
    put(physics, AGENT, -REACH - 0.01, 0)
    tick(physics, kick=1)
    assert physics.velocity[0, BALL, 0] == 0 and physics.kick[:, 0] == pytest.approx([40 / 3, 0])
    begun, _, _ = tick(physics, kick=1)
    assert not begun.any() and not physics.kick.any()
    assert physics.velocity[0, BALL, 0] == pytest.approx(40 / 3 * 0.98)


def test_no_kick_without_power() -> None:
    physics = pitch()
    put(physics, AGENT, -REACH - 0.01, 0)
    begun, _, _ = tick(physics, kick=0)
    assert begun.any() and not physics.kick.any()


def test_kick_goes_from_where_the_agent_has_come_to() -> None:
    """Contact point before the tick, agent's centre after it: a very fast agent kicks backwards."""
    physics = pitch()
    put(physics, AGENT, -REACH, 0, (40, 0))
    tick(physics, kick=1)
    assert physics.kick[0, 0] == pytest.approx(-40 / 3)
    put(physics, BALL, 0, 0)
    put(physics, AGENT, 0, -REACH, (20, 0))  # sideways: the agent leaves to the right, the kick to the left
    physics.touching[:] = False
    tick(physics, kick=1)
    direction = np.array([-physics.position[0, AGENT, 0], 0.5])
    assert physics.kick[:, 0] == pytest.approx(40 / 3 * direction / np.hypot(*direction), rel=1e-6)


def test_agents_push_each_other_without_bounce() -> None:
    physics = pitch()
    put(physics, AGENT, -2, 0, (4, 0))
    put(physics, OTHER, -1, 0)
    put(physics, BALL, 8, 5)
    tick(physics)
    assert physics.velocity[0, 1:, 0] == pytest.approx([0.94 * 2, 0.94 * 2])


def test_penetration_is_pushed_out_without_speed() -> None:
    physics = pitch()
    put(physics, AGENT, -2, 0)
    put(physics, OTHER, -1.1, 0)
    put(physics, BALL, 8, 5)
    tick(physics)
    assert physics.position[0, 1:, 0] == pytest.approx([-2.04, -1.06])  # 0.8 of 0.1 m, shared
    assert not physics.velocity[:, 1:].any()


def test_ball_pressed_against_a_wall_slips_away_on_the_pitch() -> None:
    physics = pitch()
    put(physics, BALL, 0, 7.508 - BALL_RADIUS)
    put(physics, AGENT, -0.2, 7.508 - BALL_RADIUS - REACH)
    for _ in range(50):
        tick(physics, drive=(0, 2), kick=1)
        assert physics.position[1, BALL, 0] <= 7.508 - BALL_RADIUS + 1e-3
    assert physics.position[0, BALL, 0] > 0.5


@pytest.mark.parametrize(
    ("x", "z", "blue", "purple"),
    [
        (15.09, 0.0, 0, 0),
        (15.10, 0.0, 0, 1),
        (-15.09, 0.0, 0, 0),
        (-15.10, -3.0, 1, 0),
        (14.87, 4.0, 0, 1),  # the post, on the way along the corner wall
        (14.82, 4.0, 0, 0),
        (-14.87, 4.0, 0, 0),  # the blue post lies 0.03 m further out
        (-14.89, 3.98, 1, 0),
        (15.095, 3.63, 0, 2),  # the goal's floor and a post at once
    ],
)
def test_goals(x: float, z: float, blue: int, purple: int) -> None:
    physics = pitch()
    put(physics, BALL, x, z)
    _, in_blue, in_purple = tick(physics)
    assert (in_blue.tolist(), in_purple.tolist()) == ([blue], [purple])


def test_fast_ball_is_stopped_in_the_goal_and_closed_goals_do_not_count() -> None:
    physics = pitch()
    put(physics, BALL, 14.9, 2.0, (50, 0))
    _, _, purple = tick(physics)
    line = 15.5 - np.sqrt(BALL_RADIUS**2 - 0.25)  # 15.126
    assert purple.tolist() == [1] and physics.position[:, BALL, 0] == pytest.approx([line, 2.0])
    physics = pitch(blue_closed=True)
    put(physics, BALL, -14.2, 2.0, (-50, 0))
    _, blue, _ = tick(physics)
    assert blue.tolist() == [0] and physics.velocity[0, BALL, 0] == pytest.approx(0.8 * 49)
    assert physics.position[0, BALL, 0] == pytest.approx(-15.01 + BALL_RADIUS)


@pytest.mark.parametrize("blue_closed", [False, True])
def test_nothing_leaves_the_pitch(blue_closed: bool) -> None:
    """Strong random drives, kicks and fast balls: every centre stays a radius away from every wall.

    Where two surfaces meet at a mouth, one tick may leave a body some centimetres deep in one of them.
    """
    rng = np.random.default_rng(0)
    fields = 100
    physics = SoccerPhysics(fields, 4, blue_closed)
    every = np.arange(fields)
    for body in range(5):
        physics.place(body, every, rng.uniform(-10, 10, fields), rng.uniform(-6, 6, fields))
    goals = 0
    for number in range(400):
        if number % 20 == 0:
            drive = rng.uniform(-4, 4, (2, 4, fields))
        _, blue, purple = physics.step(drive, np.ones((4, fields)))
        scored = np.flatnonzero(blue + purple)
        goals += len(scored)
        assert not (blue_closed and blue.any())
        physics.place(0, scored, rng.uniform(-10, 10, len(scored)), rng.uniform(-6, 6, len(scored)))
        x, z = np.abs(physics.position)
        radius = np.array([[BALL_RADIUS], [0.5], [0.5], [0.5], [0.5]])
        assert np.isfinite(physics.velocity).all() and (np.abs(physics.velocity) < 200).all()
        assert (z < 7.508 - radius + 0.01).all() and (x < 17.373 - radius + 0.01).all()
        along = 0.5 * x - COS * z
        assert (COS * x + 0.5 * z < CORNER_OFFSET - radius + 0.1)[along < CORNER_END - 0.1].all()
        assert (z[x > 15.6] < 4.15 - 0.5 + 0.01).all()
        if blue_closed:
            blocked = z < 3.957
            assert (physics.position[0] > -15.01 + radius - 0.1)[blocked].all()
    assert goals > 20


def test_state_is_exact() -> None:
    rng = np.random.default_rng(1)
    physics = SoccerPhysics(20, 4)
    for body in range(5):
        physics.place(body, np.arange(20), rng.uniform(-8, 8, 20), rng.uniform(-6, 6, 20))
    drives = rng.uniform(-4, 4, (60, 2, 4, 20))
    for drive in drives[:30]:
        physics.step(drive, np.ones((4, 20)))
    state = physics.get_state()
    results = []
    for _ in range(2):
        for drive in drives[30:]:
            physics.step(drive, np.ones((4, 20)))
        results.append(physics.get_state())
        physics.set_state(state)
    for name, value in results[0].items():
        assert np.array_equal(value, results[1][name]), name
