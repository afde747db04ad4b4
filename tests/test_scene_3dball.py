"""3DBall against numbers worked out by hand from its sheet, and against Unity's own policy."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple

from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene, scene_names
from mappo_unity.scenes.ball3d.scene import Ball3D, limited_turn, turned

NAME = "3DBall?team=0"
TENTH = np.float32(0.1)


class Still(Ball3D):
    """3DBall without physics: the ball hangs where it is put; `drops` maps a tick to a fallen slot."""

    def __init__(self, drops: dict[int, int] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self.drops = drops or {}
        self.tick = 0

    def simulate(self) -> None:
        self.tick += 1
        if self.tick in self.drops:
            self.ball_position[self.drops[self.tick]] = (0, -2.01, 0)


def level(env: Ball3D, height: float = 3.0) -> None:
    """Level every cube and put every ball at rest above its middle."""
    env.set_cubes(np.arange(env.num_areas), np.tile([[1.0], [0], [0], [0]], env.num_areas))
    env.ball_position[:] = (0, height, 0)
    env.ball_velocity[:] = 0
    env.ball_spin[:] = 0


def act(env: Ball3D, z: float, x: float) -> None:
    action = np.tile(np.array([[z, x]], np.float32), (env.num_areas, 1))
    env.set_actions(NAME, ActionTuple(continuous=action))


def test_spec_ids_and_groups() -> None:
    env = make_scene("3DBall")
    env.reset()
    spec = env.behavior_specs[NAME]
    assert list(env.behavior_specs) == [NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [("VectorSensor_size8", (8,))]
    assert spec.action_spec.continuous_size == 2 and spec.action_spec.discrete_branches == ()
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(12)) and not decisions.group_id.any()
    assert not decisions.reward.any() and len(terminals) == 0 and decisions.action_mask is None


def test_reset_ranges() -> None:
    env = make_scene("3DBall", num_areas=2000)
    env.reset()
    obs = env.get_steps(NAME)[0].obs[0]
    tilt, place = np.abs(obs[:, :2]), np.abs(obs[:, [2, 4]])
    assert 0.085 < tilt.max() <= np.sin(np.radians(5))  # half of 10 degrees
    assert 1.49 < place.max() <= 1.5 and abs(obs[:, 2].mean()) < 0.1 and abs(obs[:, 0].mean()) < 0.005
    assert (obs[:, 3] == 4).all() and not obs[:, 5:].any()


def test_window_with_a_fall() -> None:
    env = Still({3: 1}, num_areas=2)  # the ball of area 1 is down when tick 3 acts
    env.reset()
    level(env)
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert env.tick == 4 and len(decisions) == 0  # sent in tick 4, no decision tick
    assert terminals.agent_id.tolist() == [1] and terminals.reward.tolist() == [-1]
    assert terminals.interrupted.tolist() == [False]
    assert terminals.obs[0][0, 2:5].tolist() == pytest.approx([0, -2.01, 0])
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert len(terminals) == 0 and decisions.reward.tolist() == [TENTH, TENTH]
    assert decisions.obs[0][1, 3] == 4  # area 1 begins anew


def test_fall_in_the_last_tick_of_a_window() -> None:
    env = Still({4: 0}, num_areas=2)
    env.reset()
    level(env)
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert env.tick == 5 and terminals.agent_id.tolist() == [0] and terminals.reward.tolist() == [-1]
    assert decisions.agent_id.tolist() == [0, 1] and decisions.reward.tolist() == [0, TENTH]


def test_bounds_of_a_fall() -> None:
    env = Still(num_areas=8)
    env.reset()
    env.ball_position[:] = [
        (0, -1.99, 0), (0, -2.01, 0), (2.99, 3, 0), (3.01, 3, 0), (-3.01, 3, 0), (0, 3, 2.99), (0, 3, 3.01),
        (-2.99, 9, -2.99),
    ]  # fmt: skip
    env.step()
    assert env.get_steps(NAME)[1].agent_id.tolist() == [1, 3, 4, 6]


def test_full_episode_is_worth_100() -> None:
    env = Still(num_areas=1)
    env.reset()
    level(env)
    rewards: list[float] = []
    while not len(env.get_steps(NAME)[1]):
        env.step()
        rewards += env.get_steps(NAME)[0].reward.tolist()
    terminals = env.get_steps(NAME)[1]
    assert env.tick == 5000 and terminals.interrupted.tolist() == [True]
    assert rewards == [TENTH] * 999 + [0.0]  # the last one opens the next episode
    assert terminals.reward.tolist() == [TENTH]
    assert sum(rewards) + terminals.reward[0] == pytest.approx(100)


def test_time_limit_counts_from_the_agents_own_reset() -> None:
    env = Still({2: 0}, num_areas=1)
    env.reset()
    level(env)
    env.step()
    level(env)
    while env.tick < 5003:
        env.step()
    decisions, terminals = env.get_steps(NAME)
    assert env.tick == 5003 and len(decisions) == 0  # ended in tick 2, 5000 ticks later again
    assert terminals.interrupted.tolist() == [True] and terminals.reward.tolist() == [TENTH]


def test_later_reset_brings_one_tick_of_reward() -> None:
    env = Still(num_areas=2)
    env.reset()
    env.step()
    env.reset()
    decisions, terminals = env.get_steps(NAME)
    assert decisions.reward.tolist() == [TENTH, TENTH] and len(terminals) == 0
    assert (decisions.obs[0][:, 3] == 4).all()


def test_reset_clears_velocity_and_keeps_spin() -> None:
    env = Still({2: 0}, num_areas=1)
    env.reset()
    env.ball_velocity[:] = 2.0
    env.ball_spin[:] = (1.0, 2.0, 3.0)
    env.step()
    assert not env.ball_velocity.any() and env.ball_spin.tolist() == [[1.0, 2.0, 3.0]]


def test_turn_of_a_decision() -> None:
    env = Still(num_areas=1)
    env.reset()
    level(env)
    act(env, 0.5, 0.0)
    env.step()
    assert env.get_steps(NAME)[0].obs[0][0, :2] == pytest.approx([np.sin(np.radians(2.5)), 0])  # 5 degrees
    act(env, -3.0, 0.0)  # clamped to -1: 10 degrees back
    env.step()
    assert env.get_steps(NAME)[0].obs[0][0, :2] == pytest.approx([np.sin(np.radians(-2.5)), 0])


def test_turns_are_local_and_about_z_first() -> None:
    angle = np.full(1, np.radians(60))
    s, c = 0.5, np.sqrt(3) / 2
    level_cube = np.array([[1.0], [0], [0], [0]])
    both = turned(turned(level_cube, "z", angle), "x", angle)
    assert both[:, 0] == pytest.approx([c * c, c * s, s * s, s * c])  # k x i = j


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("axis", "component"), [("z", 3), ("x", 1)])
def test_tilt_limit(sign: int, axis: str, component: int) -> None:
    rotation = np.array([[1.0], [0], [0], [0]])
    for _ in range(40):
        rotation = limited_turn(rotation, axis, np.full(1, sign * np.radians(2)))
    assert rotation[component, 0] == pytest.approx(sign * np.sin(np.radians(15)))  # 30: first step past 28.96
    back = limited_turn(rotation, axis, np.full(1, -sign * np.radians(2)))
    assert back[component, 0] == pytest.approx(sign * np.sin(np.radians(14)))


def test_free_fall_and_gravity_at_once() -> None:
    env = Ball3D(num_areas=1)
    env.reset()
    env.step()
    assert env.get_steps(NAME)[0].obs[0][0, 6] == pytest.approx(-0.981, rel=1e-5)  # 5 * 0.02 s * 9.81
    env.set_parameter("gravity", 4.0)
    env.step()
    assert env.get_steps(NAME)[0].obs[0][0, 6] == pytest.approx(-0.981 - 0.4, rel=1e-5)


@pytest.mark.parametrize(("scale", "rest"), [(1.0, 3.0), (2.0, 3.5)])
def test_ball_rests_on_a_level_cube(scale: float, rest: float) -> None:
    env = Ball3D(num_areas=3, scale=scale)
    env.reset()
    level(env, height=rest)
    for _ in range(40):
        env.step()
    obs = env.get_steps(NAME)[0].obs[0]
    assert obs[:, 3] == pytest.approx(rest, abs=1e-3) and np.abs(obs[:, 5:]).max() < 1e-3


@pytest.mark.parametrize("mass", [1.0, 10.0])
def test_ball_rolls_down_a_tilted_cube(mass: float) -> None:
    env = Ball3D(num_areas=1, mass=mass)
    env.reset()
    level(env)
    theta = np.radians(6)
    env.set_cubes(np.arange(1), turned(env.cube_rotation.T, "z", np.full(1, theta)))
    env.ball_position[:] = 3.0 * np.array([-np.sin(theta), np.cos(theta), 0])
    for _ in range(5):
        env.step()
    downhill = 5 / 7 * 9.81 * np.sin(theta) * 0.5  # solid sphere, 0.5 s
    assert env.ball_velocity[0, 0] == pytest.approx(-downhill * np.cos(theta), rel=0.03)


def test_spin_is_limited_and_damped() -> None:
    env = Ball3D(num_areas=2)
    env.reset()
    env.ball_spin[:] = [(0, 30, 40), (0, 2, 0)]
    env.simulate()
    assert env.ball_spin[0].tolist() == pytest.approx([0, 4.2, 5.6])  # 7 rad/s
    assert env.ball_spin[1].tolist() == pytest.approx([0, 2 * 0.9998, 0])


def test_mass_and_scale_wait_for_the_reset() -> None:
    env = Ball3D(num_areas=20)
    env.reset()
    env.set_parameter("mass", 4.0)
    env.set_parameter("scale", 3.0)
    env.step()
    assert (env.mass == 1).all()
    env.end_episode(np.array([17]))
    assert env.mass[17] == 4 and env.mass[16] == 1 and env.scale[17] == 3
    model, prefix = env.physics.own_model(17)
    assert model.body(f"{prefix}ball").mass[0] == 4 and model.geom(f"{prefix}ball").size[0] == 1.5
    assert model.body(f"{prefix}ball").inertia.tolist() == pytest.approx([0.4 * 4 * 1.5**2] * 3)
    env.reset()
    assert (env.mass == 4).all()


def test_unknown_scene_and_parameters() -> None:
    assert "3DBall" in scene_names()
    with pytest.raises(ConfigError, match="no embedded scene '4DBall'; choices: 3DBall"):
        make_scene("4DBall")
    with pytest.raises(ConfigError, match="no parameter 'colour'; choices: gravity, mass, scale"):
        make_scene("3DBall", colour=1)
    with pytest.raises(ConfigError, match="mass=-1 of scene 3DBall is out of range: it must be > 0"):
        make_scene("3DBall", mass=-1)


def play(env: Ball3D, steps: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        decisions, terminals = env.get_steps(NAME)
        if len(decisions):
            action = rng.uniform(-1, 1, (len(decisions), 2)).astype(np.float32)
            env.set_actions(NAME, ActionTuple(continuous=action))
        for part in (decisions, terminals):
            rows += [part.agent_id, part.reward, part.obs[0].ravel()]
        env.step()
    return np.concatenate(rows)


def test_same_seed_same_run_whatever_the_threads() -> None:
    runs = []
    for threads, seed in ((1, 7), (1, 7), (2, 7), (1, 8)):
        env = Ball3D(num_areas=40, num_threads=threads, seed=seed)
        env.reset()
        runs.append(play(env, 150))
    assert (runs[0] == runs[1]).all() and (runs[0] == runs[2]).all()
    assert len(runs[3]) != len(runs[0]) or (runs[3] != runs[0]).any()


def test_snapshot_of_changed_balls_is_exact_in_a_fresh_scene() -> None:
    env = Ball3D(num_areas=20)
    env.reset()
    play(env, 40)
    env.set_parameter("mass", 3.0)
    env.set_parameter("scale", 0.5)
    env.set_parameter("gravity", 12.0)
    play(env, 40)
    assert 0 < (env.mass == 3).sum() < 20
    state = env.get_state()
    first = play(env, 80)
    fresh = Ball3D(num_areas=20, seed=5)
    fresh.set_state(state)
    assert (play(fresh, 80) == first).all()
    env.set_state(state)
    assert (play(env, 80) == first).all()


def test_areas_do_not_touch_each_other() -> None:
    one, two = Ball3D(num_areas=16), Ball3D(num_areas=16)
    for env in (one, two):
        env.reset()
    two.ball_velocity[0] = (0.3, -2.0, 0.1)
    for _ in range(60):
        one.simulate()
        two.simulate()
    assert (one.ball_position[0] != two.ball_position[0]).any()
    assert (one.ball_position[1:] == two.ball_position[1:]).all()


def run_policy(shared: Path) -> ModuleType:
    pytest.importorskip("onnxruntime")
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def mean_return(rows: list[tuple[float, ...]]) -> float:
    return float(np.mean([row[0] for row in rows]))


def test_official_policy_solves_it(shared: Path) -> None:
    oracle = run_policy(shared)
    path = str(shared / "oracle" / "3DBall.onnx")
    exact = oracle.OfficialPolicy(path, np.random.default_rng(0), True)
    rows = oracle.play(make_scene("3DBall", num_areas=100), {"3DBall": exact}, 100, 10_000)[NAME]
    assert len(rows) >= 100 and mean_return(rows) >= 99.9


def test_random_policy_earns_about_one(shared: Path) -> None:
    oracle = run_policy(shared)
    np.random.seed(0)  # noqa: NPY002 - the script draws from it
    rows = oracle.play(make_scene("3DBall", num_areas=100), {"3DBall": oracle.RandomPolicy()}, 1000, 10_000)
    assert 0.8 < mean_return(rows[NAME]) < 1.4
