"""The rules of SoccerTwos and StrikersVsGoalie, against the sheets and against Unity's own policy.

Tick t is the t-th of a run, from 0; decisions fall on ticks 0, 5, 10 ... After n steps without a terminal the
next tick to act is 5 n.
"""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.soccer.scene import SoccerScene

PURPLE, BLUE = "SoccerTwos?team=1", "SoccerTwos?team=0"
STRIKER, GOALIE = "Striker?team=0", "Goalie?team=1"
CHECKOUT = Path(__file__).resolve().parents[2]
POLICY = Path(os.environ.get("MAPPO_SHARED", CHECKOUT.parent / "shared")) / "oracle" / "SoccerTwos.onnx"
Steps = tuple[DecisionSteps, TerminalSteps]


def scene(
    name: str = "SoccerTwos", num_areas: int = 2, ball_touch: float = 0.0, gravity: float = 9.81
) -> SoccerScene:
    env = make_scene(name, num_areas=num_areas, ball_touch=ball_touch, gravity=gravity)
    assert isinstance(env, SoccerScene)
    env.reset()
    return env


def calm(env: SoccerScene) -> SoccerScene:
    """Put everybody at rest away from the ball, which lies in the middle."""
    every = np.arange(env.num_areas)
    env.physics.place(0, every, 0, 0)
    for agent, role in enumerate(env.ROLES):
        env.physics.place(1 + agent, every, -6 if role.team == 0 else 6, 4 if agent < 2 else -4)
    return env


def shoot(env: SoccerScene, field: int, ticks: int, side: int = 1) -> None:
    """Let the ball of `field` begin contact with a goal's floor in the `ticks`-th tick from now."""
    way = sum(10 * 0.98**n * 0.02 - 0.0347681 for n in range(1, ticks + 1))
    env.physics.place(0, np.array([field]), side * (15.094 + 0.01 - way), 0)
    env.physics.velocity[0, 0, field] = side * 10


def results(env: SoccerScene, *names: str) -> list[Steps]:
    return [env.get_steps(name) for name in names]


def play(env: SoccerScene, name: str, action: tuple[int, int, int]) -> None:
    """Set one action for all of a behavior that ask, zeros for the others, and step."""
    count = len(env.get_steps(name)[0])
    env.set_actions(name, ActionTuple(discrete=np.tile(np.array([action], np.int32), (count, 1))))
    env.step()


def test_soccer_twos_specs_ids_and_groups() -> None:
    env = make_scene("SoccerTwos")
    env.reset()
    assert list(env.behavior_specs) == [PURPLE, BLUE]
    for name, colour, first, group in ((PURPLE, "Purple", 0, 2), (BLUE, "Blue", 1, 1)):
        spec = env.behavior_specs[name]
        assert [(o.name, o.shape) for o in spec.observation_specs] == [
            (f"StackingSensor_size3_{colour}RayPerceptionSensor", (264,)),
            (f"StackingSensor_size3_{colour}RayPerceptionSensorReverse", (72,)),
        ]
        assert spec.action_spec.discrete_branches == (3, 3, 3) and spec.action_spec.continuous_size == 0
        decisions, _ = env.get_steps(name)
        assert decisions.agent_id.tolist() == list(range(first, 32, 2))
        assert decisions.group_id.tolist() == [group + 2 * (n // 2) for n in range(16)]
        assert not np.concatenate(decisions.action_mask, axis=1).any()


def test_strikers_vs_goalie_specs_ids_and_groups() -> None:
    env = make_scene("StrikersVsGoalie")
    env.reset()
    assert list(env.behavior_specs) == [STRIKER, GOALIE]
    assert [(o.name, o.shape) for o in env.behavior_specs[STRIKER].observation_specs] == [
        ("StackingSensor_size3_BlueRayPerceptionSensor", (231,)),
        ("StackingSensor_size3_BlueRayPerceptionSensorReverse", (63,)),
    ]
    assert [(o.name, o.shape) for o in env.behavior_specs[GOALIE].observation_specs] == [
        ("StackingSensor_size3_PurpleGoalieRayPerceptionSensor", (738,)),
    ]
    strikers, goalies = (env.get_steps(name)[0] for name in (STRIKER, GOALIE))
    assert strikers.agent_id.tolist() == [0, 2, 3, 5, 6, 8, 9, 11, 12, 14, 15, 17, 18, 20, 21, 23]
    assert strikers.group_id.tolist() == [2 * (n // 2) + 1 for n in range(16)]
    assert goalies.agent_id.tolist() == [1, 4, 7, 10, 13, 16, 19, 22]
    assert goalies.group_id.tolist() == [2, 4, 6, 8, 10, 12, 14, 16]


@pytest.mark.parametrize(("name", "goalie"), [("SoccerTwos", None), ("StrikersVsGoalie", 1)])
def test_reset_ranges(name: str, goalie: int | None) -> None:
    env = scene(name, num_areas=2000)
    position = env.physics.position
    for agent, role in enumerate(env.ROLES):
        middle, z = (
            (9.0, 0.0)
            if agent == goalie
            else (8.19 * (1 if role.team else -1), (1.2, 1.2, -1.2, -1.2)[agent])
        )
        if name == "StrikersVsGoalie" and agent != goalie:
            z = (1.2, 0.0, -1.2)[agent]
        away = position[0, 1 + agent] - middle
        assert away.min() < -4.95 and away.max() > 4.95 and np.abs(away).max() <= 5
        assert (position[1, 1 + agent] == z).all()
        degrees = np.degrees(env.yaw[agent]) * (-1 if role.team else 1)
        assert 80 <= degrees.min() < 80.5 and 99.5 < degrees.max() <= 100
    ball = position[:, 0]
    assert np.abs(ball).max() <= 2.5 and ball.min() < -2.45 and ball.max() > 2.45
    assert not env.physics.velocity.any()


def test_goal_in_a_window_ends_one_field_with_its_rewards() -> None:
    env = calm(scene(num_areas=3))
    for _ in range(4):
        env.step()
    shoot(env, field=1, ticks=3)
    env.step()  # tick 23, where the goal of tick 22 is sent; the timer stood at 23 then
    for (decisions, terminals), ids, group, reward in zip(
        results(env, PURPLE, BLUE), ([4, 6], [5, 7]), (4, 3), (-1, 1 - 23 / 5000), strict=True
    ):
        assert len(decisions) == 0 and terminals.agent_id.tolist() == ids
        assert terminals.group_id.tolist() == [group] * 2
        assert terminals.group_reward == pytest.approx([reward] * 2)
        assert terminals.reward.tolist() == [0, 0] and terminals.interrupted.tolist() == [False] * 2
        newest = terminals.obs[0][:, -88:].reshape(2, 11, 8)
        assert newest[:, :, 6].min() < 1  # a frame was taken at the end
    assert env.timer.tolist() == [23, 0, 23]
    assert (env.physics.position[0, [2, 4], 1] < -3.19).all() and np.abs(
        env.physics.position[:, 0, 1]
    ).max() <= 2.5
    env.step()  # tick 25: all decide; the ended agents' stacks hold their one new frame
    decisions, terminals = env.get_steps(BLUE)
    assert len(decisions) == 6 and len(terminals) == 0 and not decisions.group_reward.any()
    frames = decisions.obs[0].reshape(6, 3, -1)
    assert not frames[2:4, :2].any() and frames[[0, 1, 4, 5], :2].any(axis=(1, 2)).all()


def test_goal_in_the_last_tick_of_a_window_comes_with_decisions() -> None:
    env = calm(scene(num_areas=1))
    shoot(env, field=0, ticks=5, side=-1)
    env.step()
    (purple, purple_end), (blue, blue_end) = results(env, PURPLE, BLUE)
    assert len(purple) == len(blue) == 2 and purple.agent_id.tolist() == purple_end.agent_id.tolist() == [
        0,
        2,
    ]
    assert purple_end.group_reward == pytest.approx([1 - 5 / 5000] * 2)
    assert blue_end.group_reward.tolist() == [-1, -1]


def test_two_parts_of_a_goal_at_once_score_twice() -> None:
    env = calm(scene(num_areas=1))
    env.physics.place(0, np.zeros(1, np.int64), 15.095, 3.63)
    env.step()
    env.step()
    (purple, _), (blue, _) = results(env, PURPLE, BLUE)
    assert purple.group_reward.tolist() == [-1, -1] and blue.group_reward.tolist() == [1, 1]


def test_time_is_up() -> None:
    env = calm(scene(num_areas=2))
    env.timer[1] = 4998
    env.step()  # tick 1 ends it, tick 2 sends it
    for decisions, terminals in results(env, PURPLE, BLUE):
        assert len(decisions) == 0 and len(terminals) == 2
        assert terminals.interrupted.all() and not terminals.group_reward.any() and not terminals.reward.any()
    assert env.timer.tolist() == [2, 0] and env.get_steps(BLUE)[1].agent_id.tolist() == [5, 7]


def test_ball_touch_is_read_when_an_episode_begins() -> None:
    for touch, late, expected in ((0.5, None, 0.1), (0.0, 0.5, 0.0)):
        env = calm(scene(num_areas=1, ball_touch=touch))
        if late is not None:
            env.set_parameter("ball_touch", late)
        env.physics.place(2, np.zeros(1, np.int64), -1.13, 0)  # agent 1, blue, touches the ball
        env.step()
        assert env.get_steps(BLUE)[0].reward == pytest.approx([expected, 0])
        assert not env.get_steps(PURPLE)[0].reward.any()


def test_parameters() -> None:
    env = scene(gravity=20.0)
    env.set_parameter("gravity", 5.0)
    with pytest.raises(ConfigError, match="ball_touch"):
        make_scene("SoccerTwos", ball_scale=7.5)


@pytest.mark.parametrize(
    ("action", "velocity", "turn", "kick"),
    [
        ((0, 0, 0), (0, 0), 0, 0),
        ((1, 0, 0), (0, 2), 0, 1),
        ((2, 0, 0), (0, -2), 0, 0),
        ((0, 1, 0), (0.6, 0), 0, 0),
        ((0, 2, 0), (-0.6, 0), 0, 0),
        ((1, 1, 1), (0.6, 0), -2, 1),  # the side replaces the way ahead, not the kick
        ((0, 0, 2), (0, 0), 2, 0),
    ],
)
def test_actions(action: tuple[int, int, int], velocity: tuple[float, float], turn: int, kick: int) -> None:
    env = calm(scene(num_areas=1))
    env.yaw[:] = 0
    env.agents.discrete[:] = action
    env.act(env.agents.order)
    assert env._drive[:, 1, 0] == pytest.approx(velocity) and env._kick_power[1, 0] == kick
    assert np.degrees(env.yaw[1, 0]) == pytest.approx(turn)


def test_heading_is_that_before_the_turn_and_actions_last_five_ticks() -> None:
    env = calm(scene(num_areas=1))
    env.yaw[:] = np.radians(90)
    play(env, BLUE, (1, 0, 2))
    assert np.degrees(env.yaw[1, 0]) == pytest.approx(100) and np.degrees(env.yaw[0, 0]) == pytest.approx(90)
    velocity = np.zeros(2)
    for number in range(5):
        heading = np.radians(90 + 2 * number)
        velocity = (velocity + 2 * np.array([np.sin(heading), np.cos(heading)])) * 0.94
    assert env.physics.velocity[:, 2, 0] == pytest.approx(velocity)


def test_roles_of_strikers_and_goalie() -> None:
    env = calm(scene("StrikersVsGoalie", num_areas=1))
    env.yaw[:] = 0
    env.agents.discrete[:] = (1, 0, 0)
    env.act(env.agents.order)
    assert env._drive[1, :, 0] == pytest.approx([2.6, 2.0, 2.6]) and env._kick_power[:, 0].tolist() == [
        1,
        1,
        1,
    ]
    env.agents.discrete[:] = (0, 1, 0)
    env.act(env.agents.order)
    assert env._drive[0, :, 0] == pytest.approx([0.6, 2.0, 0.6]) and env._kick_power[:, 0].tolist() == [
        0,
        1,
        0,
    ]


def test_time_costs_strikers_and_pays_the_goalie() -> None:
    env = calm(scene("StrikersVsGoalie", num_areas=2))
    env.step()
    assert env.get_steps(STRIKER)[0].reward == pytest.approx([-0.001] * 4, rel=1e-5)
    assert env.get_steps(GOALIE)[0].reward == pytest.approx([0.001] * 2, rel=1e-5)
    shoot(env, field=0, ticks=3)
    env.step()  # a window of three ticks
    strikers, goalies = (env.get_steps(name)[1] for name in (STRIKER, GOALIE))
    assert strikers.reward == pytest.approx([-0.0006] * 2, rel=1e-5) and goalies.reward == pytest.approx(
        [0.0006], rel=1e-5
    )
    assert strikers.group_reward == pytest.approx([1 - 8 / 5000] * 2) and goalies.group_reward.tolist() == [
        -1
    ]
    env.step()  # the two ticks after the reset count towards the next record
    assert env.get_steps(STRIKER)[0].reward == pytest.approx([-0.0004, -0.0004, -0.001, -0.001], rel=1e-5)


def test_a_full_episode_costs_strikers_one() -> None:
    env = calm(scene("StrikersVsGoalie", num_areas=1))
    total, terminals = 0.0, env.get_steps(STRIKER)[1]
    while not len(terminals):
        env.step()
        decisions, terminals = env.get_steps(STRIKER)
        if len(decisions) and not len(terminals):
            total += float(decisions.reward[0])
    assert terminals.interrupted.all() and total + terminals.reward[0] == pytest.approx(-1, abs=1e-3)


def test_no_goal_at_the_closed_end() -> None:
    env = calm(scene("StrikersVsGoalie", num_areas=1))
    shoot(env, field=0, ticks=3, side=-1)
    for _ in range(3):
        env.step()
        assert not len(env.get_steps(STRIKER)[1])


def test_env_reset_leaves_the_fields_as_they_are() -> None:
    env = calm(scene(num_areas=1))
    env.step()
    env.set_parameter("ball_touch", 0.5)
    before, timer = env.physics.position.copy(), env.timer.copy()
    env.reset()
    assert np.array_equal(env.physics.position, before) and env.timer == timer + 1
    assert env.touch_reward == pytest.approx([0.1] * 4)
    assert not len(env.get_steps(BLUE)[1])


@pytest.mark.parametrize("name", ["SoccerTwos", "StrikersVsGoalie"])
def test_contract_with_goals_and_time_limits(name: str) -> None:
    def make() -> SoccerScene:
        env = make_scene(name, num_areas=4, seed=3, ball_touch=0.3)
        assert isinstance(env, SoccerScene)
        env.timer[:] = [0, 4000, 4700, 4900]
        reset = env._reset_fields

        def kept(fields: np.ndarray) -> None:  # the first reset must not restart the clocks set above
            timer = env.timer.copy()
            reset(fields)
            if not env.started:
                env.timer[:] = timer
            env.physics.velocity[0, 0, fields[fields < 2]] = 20.0  # a ball on its way to a goal or a wall

        env._reset_fields = kept  # type: ignore[method-assign]
        return env

    report = check_env(make(), steps=250, remake=make)
    assert report.terminals > 10 and 0 < report.interrupted < report.terminals
    assert {"get_state/set_state", "seed"} <= set(report.checks)


def match_script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("check_soccer", CHECKOUT / "scripts" / "check_soccer.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not POLICY.is_file(), reason="Unity's policy is not beside the checkout")
@pytest.mark.parametrize("side", ["blue", "purple"])
def test_unitys_policy_beats_a_random_side(side: str) -> None:
    pytest.importorskip("onnxruntime")
    script = match_script()
    official, chance = script.official_policy(POLICY, 0), script.random_policy(1)
    score = script.play(*((official, chance) if side == "blue" else (chance, official)), episodes=80, seed=0)
    won, lost = (score.blue, score.purple) if side == "blue" else (score.purple, score.blue)
    assert won + lost >= 79 and won >= 0.9 * (won + lost)  # 98% in long runs
    assert 20 < score.decisions < 60  # 36 in long runs
