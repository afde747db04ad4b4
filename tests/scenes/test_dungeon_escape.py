"""DungeonEscape against numbers worked out by hand from its sheet, and against Unity's own policy."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.dungeon_escape.layout import DRAGON, KEY, TOMB
from mappo_unity.scenes.dungeon_escape.scene import DungeonEscape

NAME = "DungeonEscape?team=0"
NONE, FORWARD, BACKWARD, RIGHT, LEFT, STRAFE_LEFT, STRAFE_RIGHT = range(7)
WALL_TAG, AGENT_TAG, DRAGON_TAG, KEY_TAG, LOCK_TAG, PORTAL_TAG = range(6)
MISS, DISTANCE = 6, 7
DOOR_FRONT = 12.6 - 0.535


def dungeon(num_areas: int = 1, seed: int = 0) -> DungeonEscape:
    env = make_scene("DungeonEscape", num_areas=num_areas, seed=seed)
    assert isinstance(env, DungeonEscape)
    env.reset()
    return env


def quiet(
    places: list[tuple[float, float, float]], dragon: tuple[float, float] = (-9.0, -9.0)
) -> DungeonEscape:
    """Return an area with its agents at rest on the floor at (x, z, yaw in degrees), a dragon that stands."""
    env = dungeon()
    room = env.room
    room.velocity[:] = 0
    for slot, (x, z, yaw) in enumerate(places):
        room.position[slot] = (x, 0.5, z)
        room.yaw[slot] = np.radians(yaw)
    place_dragon(env, *dragon)
    return env


def place_dragon(env: DungeonEscape, x: float, z: float, speed: float = 0.0) -> None:
    env.room.thing[0, DRAGON] = (x, 0.75, z)
    env.room.dragon_fall[:] = 0
    env.room.dragon_speed[:] = speed
    env.room.aim_at_portal(np.array([0]))


def play(env: DungeonEscape, actions: list[int] | int = NONE) -> tuple[DecisionSteps, TerminalSteps]:
    """Set actions for those who asked (one for all, or one each), and go on to the next report."""
    count = len(env.get_steps(NAME)[0])
    chosen = np.broadcast_to(np.array(actions, np.int32), (count,))
    env.set_actions(NAME, ActionTuple(discrete=chosen.reshape(-1, 1)))
    env.step()
    return env.get_steps(NAME)


def frame(env: DungeonEscape, slot: int = 0) -> np.ndarray:
    """Return one frame of a slot's rays, [15, 8]."""
    return env.observe(0, np.array([slot]))[1].reshape(15, 8)


FAR = [(0.0, 0.0, 0.0), (-10.0, 0.0, 0.0), (10.0, 0.0, 0.0)]


def test_spec_ids_and_groups() -> None:
    env = make_scene("DungeonEscape")
    env.reset()
    spec = env.behavior_specs[NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [
        ("RBSensor", (10,)),
        ("StackingSensor_size3_RayPerceptionSensor", (360,)),
        ("VectorSensor_size1", (1,)),
    ]
    assert spec.action_spec.discrete_branches == (7,) and spec.action_spec.continuous_size == 0
    decisions, _ = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(36))
    assert decisions.group_id.tolist() == np.repeat(np.arange(1, 13), 3).tolist()
    assert not decisions.reward.any() and not decisions.group_reward.any()


def test_first_observation_has_two_empty_frames() -> None:
    decisions, _ = dungeon().get_steps(NAME)
    stacked = decisions.obs[1].reshape(3, 3, 120)
    assert not stacked[:, :2].any() and stacked[:, 2].any()
    assert (decisions.obs[0] == [0, 0, 0, 0, 0, 0, 0, 0, 0, 1]).all()
    assert not decisions.obs[2].any()


@pytest.mark.parametrize(
    ("action", "axis", "gain"),
    [(FORWARD, 2, 3.0), (BACKWARD, 2, -3.0), (STRAFE_LEFT, 0, -2.25), (STRAFE_RIGHT, 0, 2.25)],
)
def test_speed_on_the_ground(action: int, axis: int, gain: float) -> None:
    """Each tick: v <- (v + gain) * 0.92, then 1.2 * 14.715 * 0.02 * 0.92 of it is lost to the floor."""
    env = quiet([(0.0, -2.0, 90.0), (-10.0, 0.0, 0.0), (10.0, 6.0, 0.0)])
    speed = 0.0
    for _ in range(5):
        speed = (speed + abs(gain)) * 0.92 - 0.3249072
    decisions, _ = play(env, [action, NONE, NONE])
    expected = np.zeros(3)
    expected[axis] = np.sign(gain) * speed
    np.testing.assert_allclose(decisions.obs[0][0, :3], expected, atol=1e-5)
    x_axis = {2: 1.0, 0: 0.0}[axis]  # at yaw 90 degrees ahead is +x, and right is -z
    moved = env.room.velocity[0]
    np.testing.assert_allclose(moved, [x_axis * expected[2], 0, -expected[0]], atol=1e-6)


def test_turns_are_20_degrees_a_decision_and_right_is_clockwise() -> None:
    env = quiet(FAR)
    play(env, [RIGHT, LEFT, NONE])
    np.testing.assert_allclose(np.degrees(env.room.yaw), [20.0, -20.0, 0.0], atol=1e-9)


def test_agents_fall_from_one_metre_and_stay_on_the_floor() -> None:
    env = dungeon()
    place_dragon(env, -9.0, -9.0)
    assert (env.room.position[:, 1] == 1.0).all()
    decisions, _ = play(env)
    assert (decisions.obs[0][:, 1] < -0.9).all()  # 5 ticks of 14.715 m/s^2 with drag
    for _ in range(4):
        play(env)
    assert (env.room.position[:, 1] == 0.5).all() and not env.room.velocity.any()


def test_walls_stop_agents_and_rays_no_longer_report_them() -> None:
    env = quiet([(0.0, -6.0, 180.0), (-10.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    for _ in range(8):
        play(env, [FORWARD, NONE, NONE])
    assert env.room.position[0, 2] == pytest.approx(-12.0, abs=0.02)
    assert abs(env.room.velocity[0, 2]) < 0.01
    assert frame(env)[0, MISS] == 1.0 and frame(env)[0, DISTANCE] == 1.0


def test_columns_tombstones_and_agents_are_solid() -> None:
    env = quiet([(4.5, -2.0, 180.0), (-10.0, 0.0, 0.0), (-10.0, 1.5, 180.0)])
    for _ in range(6):
        play(env, [FORWARD, FORWARD, NONE])
    assert env.room.position[0, 2] == pytest.approx(-4.0 + 0.85 + 0.5, abs=0.02)  # a column's base
    assert env.room.position[2, 2] - env.room.position[1, 2] == pytest.approx(1.0, abs=0.05)
    assert env.room.position[2, 2] > 3.0  # pushed along


def test_ray_order_right_first() -> None:
    """An agent at +60 degrees is seen by ray 13, one at -60 by ray 14; ahead is the lock."""
    right = (6 * np.sin(np.radians(60)), 6 * np.cos(np.radians(60)), 0.0)
    env = quiet([(0.0, 0.0, 0.0), right, (-right[0], right[1], 0.0)])
    env.enabled[0, 2] = False
    env.room.refresh(env.enabled)
    rays = frame(env)
    assert rays[0, LOCK_TAG] == 1.0
    assert rays[0, DISTANCE] == pytest.approx((DOOR_FRONT - 0.5) / 40)
    assert rays[13, AGENT_TAG] == 1.0 and 4.7 < rays[13, DISTANCE] * 40 < 5.1
    assert rays[14, AGENT_TAG] == 0.0
    assert (rays[:, :6].sum(axis=1) == 1).all()  # inside four walls nothing misses


def test_rays_tell_tags_and_distances() -> None:
    env = quiet([(0.0, 0.0, 180.0), (-10.0, 5.0, 0.0), (10.0, 5.0, 0.0)])
    assert frame(env)[0, WALL_TAG] == 1.0
    assert frame(env)[0, DISTANCE] == pytest.approx((12.5 - 0.5) / 40)
    env.room.thing[0, DRAGON] = (0.0, 0.75, -5.0)
    env.room.thing_yaw[0, DRAGON] = 0.0  # looks at the agent: its key comes first
    rays = frame(env)
    assert rays[0, KEY_TAG] == 1.0 and rays[0, DISTANCE] == pytest.approx((5 - 0.94 - 0.09 - 0.5) / 40)
    env.room.thing_yaw[0, DRAGON] = np.pi
    rays = frame(env)
    assert rays[0, DRAGON_TAG] == 1.0 and rays[0, DISTANCE] == pytest.approx((5 - 0.75 - 0.5) / 40)
    env.room.present[0, DRAGON] = False
    env.room.put_key(np.array([0]), np.array([[0.0, 0.75, -5.0]]), np.array([0.0]))
    rays = frame(env)
    gap = 0.75 - 0.23 - 0.5  # the key's lower edge is 2 cm above the sphere's centre
    assert rays[0, KEY_TAG] == 1.0
    assert rays[0, DISTANCE] == pytest.approx((5 - 0.09 - np.sqrt(0.25 - gap**2)) / 40)
    env.room.position[0] = (8.0, 0.5, -8.0)
    env.room.yaw[0] = np.radians(135.0)  # towards the portal
    assert frame(env)[0, PORTAL_TAG] == 1.0


def test_the_sacrifice() -> None:
    """Who touches the dragon vanishes with it, a tombstone stands there, the key lies at its place."""
    env = quiet([(0.0, 0.0, 30.0), (-10.0, 5.0, 0.0), (10.0, 5.0, 0.0)], dragon=(0.0, 1.27))
    decisions, terminals = play(env)
    assert terminals.agent_id.tolist() == [0] and len(decisions) == 0  # not a decision tick
    assert terminals.group_id.tolist() == [1] and not terminals.interrupted.any()
    assert terminals.group_reward.tolist() == [0.0] and terminals.reward.tolist() == [0.0]
    room = env.room
    assert room.present[0, [TOMB, DRAGON, KEY]].tolist() == [True, False, True]
    np.testing.assert_allclose(room.thing[0, TOMB], [0.0, 0.73, 0.0], atol=1e-6)
    assert room.thing_yaw[0, TOMB] == pytest.approx(np.radians(30.0))
    np.testing.assert_allclose(
        np.hypot(*(room.thing[0, KEY, ::2] - [0.0, 1.27])), 0.186, atol=1e-6
    )  # beside the origin, which is the dragon's
    decisions, _ = play(env)
    assert decisions.agent_id.tolist() == [1, 2] and decisions.group_id.tolist() == [1, 1]


def test_key_and_door_free_the_area() -> None:
    env = quiet([(0.0, 0.0, 0.0), (3.0, 8.0, -90.0), (10.0, 0.0, 0.0)], dragon=(0.0, 1.27))
    play(env)  # agent 0 dies
    env.room.put_key(np.array([0]), np.array([[1.5, 0.75, 8.0]]), np.array([0.0]))
    play(env)
    decisions, _ = play(env, [FORWARD, NONE])
    decisions, _ = play(env, [FORWARD, NONE])
    assert decisions.obs[2].ravel().tolist() == [1.0, 0.0]
    assert not env.room.present[0, KEY]
    env.room.position[1] = (0.0, 0.5, DOOR_FRONT - 1.0)
    env.room.yaw[1] = 0.0
    for _ in range(5):
        decisions, terminals = play(env, FORWARD)
        if len(terminals):
            break
    assert terminals.agent_id.tolist() == [1, 2]
    assert terminals.group_reward.tolist() == [1.0, 1.0] and not terminals.reward.any()
    assert not terminals.interrupted.any() and terminals.group_id.tolist() == [1, 1]
    assert not terminals.obs[2].any()  # the key is used up
    while not len(decisions):
        decisions, _ = play(env)
    assert decisions.agent_id.tolist() == [1, 2, 3]  # the dead one is back under a new id
    assert decisions.group_id.tolist() == [1, 1, 1] and not decisions.obs[2].any()
    assert env.room.present[0, [TOMB, DRAGON, KEY]].tolist() == [False, True, False]


def test_the_lock_opens_on_entering_it_only() -> None:
    """An agent that gets the key while it leans on the door must leave it first."""
    env = quiet([(0.0, DOOR_FRONT - 0.51, 0.0), (-10.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    play(env)
    env.has_key[0, 0] = True
    _, terminals = play(env, [FORWARD, NONE, NONE])
    assert not len(terminals)
    play(env, [BACKWARD, NONE, NONE])
    for _ in range(3):
        _, terminals = play(env, [FORWARD, NONE, NONE])
        if len(terminals):
            break
    assert terminals.group_reward.tolist() == [1.0] * 3


def into_portal(env: DungeonEscape, slot: int) -> TerminalSteps:
    """Put an agent before the portal, facing it, and let it walk in."""
    env.room.position[slot] = (9.5, 0.5, -9.5)
    env.room.yaw[slot] = np.radians(135.0)
    for _ in range(6):
        decisions, _ = env.get_steps(NAME)
        walking = [FORWARD if agent == slot else NONE for agent in decisions.agent_id]
        _, terminals = play(env, walking)
        if len(terminals):
            return terminals
    raise AssertionError("nobody reached the portal")


def test_portal_takes_agents_one_by_one_and_the_last_ends_the_episode() -> None:
    env = quiet(FAR)
    for slot in (0, 1):
        terminals = into_portal(env, slot)
        assert terminals.agent_id.tolist() == [slot] and not terminals.interrupted.any()
    assert env.remaining.tolist() == [1]
    terminals = into_portal(env, 2)
    assert terminals.agent_id.tolist() == [2] and not terminals.group_reward.any()
    assert env.remaining.tolist() == [3] and env.enabled.all()
    assert sorted(env.agents.agent_id.tolist()) == [2, 3, 4]


def test_a_key_holder_in_the_portal_ends_the_episode() -> None:
    env = quiet(FAR)
    env.has_key[0, 0] = True
    terminals = into_portal(env, 0)
    assert terminals.agent_id.tolist() == [0, 1, 2] and not terminals.group_reward.any()
    assert env.agents.agent_id.tolist() == [0, 1, 2]


def test_the_dragon_escapes() -> None:
    env = quiet(FAR)
    place_dragon(env, 8.0, -8.0, speed=7.0)
    for _ in range(6):
        _, terminals = play(env)
        if len(terminals):
            break
    assert terminals.agent_id.tolist() == [0, 1, 2]
    assert not terminals.interrupted.any() and not terminals.group_reward.any()


def test_the_dragon_walks_straight_and_slides_past_a_column() -> None:
    env = quiet(FAR)
    env.room.present[0, DRAGON] = True
    place_dragon(env, 0.0, 8.0, speed=5.0)
    start = env.room.thing[0, DRAGON].copy()
    env.controllers()
    env.simulate()
    way = env.room.thing[0, DRAGON] - start
    assert np.hypot(way[0], way[2]) == pytest.approx(0.1)
    assert np.arctan2(way[0], way[2]) == pytest.approx(np.arctan2(11.58, -19.59))
    ticks = 1
    while env.timer[0] > 0:
        env.room.position[:] = [(-11, 0.5, 0), (-11, 0.5, 3), (-11, 0.5, 6)]
        env.controllers()
        env.simulate()
        ticks += 1
    assert 200 < ticks < 220  # 22.8 m less about 1.7 m to the portal's front, at 0.1 m a tick


def test_time_limit_interrupts_the_group() -> None:
    env = quiet(FAR)
    env.timer[0] = 15_000 - 4
    _, terminals = play(env)
    assert terminals.agent_id.tolist() == [0, 1, 2] and terminals.interrupted.all()
    assert env.timer[0] < 5 and env.remaining.tolist() == [3]


def test_nobody_left_waits_for_the_timer() -> None:
    env = quiet(FAR)
    into_portal(env, 0)
    into_portal(env, 1)
    env.room.position[2] = (0.0, 0.5, 0.0)
    place_dragon(env, 0.0, 1.25)
    _, terminals = play(env)
    assert terminals.agent_id.tolist() == [2] and not env.enabled.any()
    env.timer[0] = 15_000 - 3
    while not len(env.get_steps(NAME)[0]):
        env.step()
    assert env.get_steps(NAME)[0].agent_id.tolist() == [3, 4, 5]


def test_spawns_keep_clear_of_columns_and_each_other() -> None:
    env = dungeon(200, seed=3)
    seen = []
    for _ in range(3):
        env.reset()
        env.room.reset(np.arange(200), env.rng, env.enabled, (1.0, 7.0))
        seen.append(env.room.position.reshape(200, 3, 3).copy())
    place = np.concatenate(seen)
    assert (place[..., 1] == 1.0).all() and np.abs(place[..., ::2]).max() <= 6.25
    beside = np.maximum(np.abs(np.abs(place[..., ::2]) - [4.5, 4.0]) - 2.5, 0)
    assert (np.hypot(beside[..., 0], beside[..., 1]) > 0.718).all()
    for one, other in ((1, 0), (2, 0), (2, 1)):
        apart = np.abs(place[:, one, ::2] - place[:, other, ::2]).max(axis=1)
        assert apart.min() >= 2.5 + np.sqrt(0.125)  # a body turned by 45 degrees, beside the box's corner
    assert 0.05 < (np.abs(place[..., 0]) > 2).mean() and 0.05 < (np.abs(place[..., 2]) > 2).mean()
    yaw = env.room.yaw
    assert yaw.min() >= 0 and yaw.max() <= 2 * np.pi and yaw.std() > 1.6


def test_dragon_starts_in_world_axes_with_a_new_speed() -> None:
    env = dungeon(400, seed=1)
    env.room.reset(np.arange(400), env.rng, env.enabled, (1.0, 7.0))
    starts = {(x, z) for x, z in env.room.thing[:, DRAGON, ::2].tolist()}
    assert starts == {(0.0, 8.0), (-8.0, 0.0), (0.0, -8.0), (8.0, 0.0)}
    yaw = np.degrees(env.room.thing_yaw[:, DRAGON])
    ahead = {(x, z): turn for (x, _, z), turn in zip(env.room.thing[:, DRAGON].tolist(), yaw, strict=True)}
    assert ahead == {(0.0, 8.0): 180.0, (-8.0, 0.0): 90.0, (0.0, -8.0): 0.0, (8.0, 0.0): -90.0}
    place = env.room.thing[:, DRAGON].copy()
    env.room.step()
    way = env.room.thing[:, DRAGON] - place
    assert np.allclose(env.room.thing_yaw[:, DRAGON], np.arctan2(way[:, 0], way[:, 2]))  # it faces the portal
    speed = env.room.dragon_speed
    assert 1.0 <= speed.min() < 1.2 and 6.8 < speed.max() <= 7.0


def test_later_reset_brings_all_agents_back() -> None:
    env = quiet([(0.0, 0.0, 0.0), (-10.0, 5.0, 0.0), (10.0, 5.0, 0.0)], dragon=(0.0, 1.27))
    play(env)
    env.reset()
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == [1, 2, 3] and not len(terminals)
    assert env.timer.tolist() == [1]


def test_gravity() -> None:
    env = dungeon()
    env.set_parameter("gravity", 0.0)
    play(env)
    assert (env.room.position[:, 1] == 1.0).all()


def played(env: DungeonEscape, rounds: int) -> list[Any]:
    rng = np.random.default_rng(5)
    seen: list[Any] = []
    for _ in range(rounds):
        decisions, terminals = env.get_steps(NAME)
        seen += [decisions.obs[1].copy(), decisions.agent_id, terminals.agent_id, terminals.group_reward]
        actions = rng.integers(0, 7, (len(decisions), 1)).astype(np.int32)
        env.set_actions(NAME, ActionTuple(discrete=actions))
        env.step()
    return seen


def test_state_is_exact() -> None:
    env = dungeon(8, seed=2)
    played(env, 60)
    state = env.get_state()
    first = played(env, 60)
    other = dungeon(8, seed=9)
    other.set_state(state)
    second = played(other, 60)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_contract() -> None:
    check_env(make_scene("DungeonEscape", num_areas=4), steps=150)


def test_unitys_policy_frees_areas(shared: Path) -> None:
    """Sheet: 0.96 of the areas; over agent episodes a group return of 0.616, and 0.1 at random."""
    pytest.importorskip("onnxruntime")
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    assert spec is not None and spec.loader is not None
    run_policy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run_policy)
    file = str(shared / "oracle" / "DungeonEscape.onnx")
    policy = run_policy.OfficialPolicy(file, np.random.default_rng(0), False)
    done = run_policy.play(make_scene("DungeonEscape", num_areas=24), {"DungeonEscape": policy}, 500, 2000)
    assert np.mean([row[1] for row in done[NAME]]) > 0.54


def test_the_script_counts_freed_areas() -> None:
    script = Path(__file__).resolve().parents[2] / "scripts" / "check_dungeon.py"
    command = [sys.executable, str(script), "--policy", "random", "--episodes", "40", "--num-areas", "16"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    with_sight = subprocess.run([*command, "--sight"], capture_output=True, text=True, timeout=120)
    *same, freed, lost = with_sight.stdout.splitlines()
    assert same == done.stdout.splitlines()
    assert ", freed: seen in 0." in freed and ", lost: seen in 0." in lost
    counts = [int(line.rpartition(" of ")[2].split(",")[0].split()[0]) for line in done.stdout.splitlines()]
    total, turns, speeds = counts[0], counts[1:5], counts[5:]
    assert total >= 40 and sum(turns) == sum(speeds) == total and len(speeds) == 6
