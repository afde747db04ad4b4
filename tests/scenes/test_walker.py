"""Walker's drives, rewards, ends and resets by numbers from its sheet; Unity's own policy walks in it."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple
from walker_figures import (
    FIRST,
    NAME,
    PARTS,
    Posed,
    play,
    posed,
)

from mappo_unity.errors import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.scene import Walker


def test_a_tick_of_the_drives_is_the_implicit_step() -> None:
    """From rest, without gravity or contacts: (M + h D) v' = h k (target - angle), with MuJoCo's M."""
    env = Walker(num_areas=1, gravity=0.0)
    env.reset()
    areas = env.physics._areas
    areas.qpos[0, 1] = 5.0
    error = np.random.default_rng(1).uniform(-0.1, 0.1, 26)
    middle = (areas.model.jnt_range[1:27].sum(axis=1)) / 2
    env.physics.angle[0] = middle  # away from the limits
    env.physics.drive_target[0] = middle + error
    model = body.area().compile()
    share = {
        "spine": 0.05, "chest": 0.05, "head": 0.125, "thigh": 0.0163, "shin": 0.018, "foot": 0.025,
        "arm": 0.0054, "forearm": 0.127,
    }  # fmt: skip
    parts = [share[part.rstrip("LR")] for part, _ in body.HINGES]
    stiffness, drive_damping = 40000 * np.array(parts), (5000 + 0.01333 * 40000) * np.array(parts)
    torque = stiffness * error
    for number, (part, axis) in enumerate(body.HINGES):
        if axis == "Y" and part.rstrip("LR") in ("head", "thigh", "arm"):
            twist, wanted = middle[number - 1], middle[number - 1] + error[number - 1]
            torque[number] = stiffness[number] * np.cos(twist) * np.cos(wanted) * np.sin(error[number])
            drive_damping[number] *= np.cos(twist) ** 2
    model.dof_armature[:] = 0
    data = mujoco.MjData(model)
    data.qpos[:] = areas.qpos[0]
    mujoco.mj_forward(model, data)
    inertia = np.zeros((38, 38))
    mujoco.mj_fullM(model, data, inertia)
    inertia[range(6, 32), range(6, 32)] += 0.01333 * drive_damping
    expected = np.linalg.solve(inertia, np.concatenate([np.zeros(6), 0.01333 * torque, np.zeros(6)]))
    env.physics.step()
    assert np.abs(areas.qvel[0, :32] - expected[:32]).max() < 1e-9 * np.abs(expected).max()
    assert np.abs(expected).max() > 0.1


def test_extreme_actions_stay_stable() -> None:
    """Full targets with drives switched on and off at random: parts spun past 80 rad/s without damping."""
    env = Walker(num_areas=64)
    env.reset()
    rng = np.random.default_rng(0)
    fastest = 0.0
    for _ in range(60):
        decisions, _ = env.get_steps(NAME)
        action = np.sign(rng.uniform(-1, 1, (len(decisions), 39))).astype(np.float32)
        env.set_actions(NAME, ActionTuple(continuous=action))
        env.step()
        fastest = max(fastest, float(np.abs(env.physics.spin).max()))
    assert 10 < fastest < 75


def test_fast_parts_are_limited_to_50() -> None:
    env = Walker(num_areas=1, gravity=0.0)
    env.reset()
    areas = env.physics._areas
    areas.qpos[0, 1] = 5.0
    areas.qvel[0, 4] = 80.0
    env.physics.step()
    assert areas.qvel[0, 4] == pytest.approx(50, rel=0.05)


def test_free_fall_with_drag_and_gravity_at_once() -> None:
    env = Walker(num_areas=1)
    env.reset()
    env.physics._areas.qpos[0, 1] = 9.0
    env.physics.drive_on[:] = 0
    env.physics.step()
    assert env.physics.velocity[0, 3, 1] == pytest.approx(-14.715 * 0.01333, rel=1e-6)
    env.set_parameter("gravity", 2.0)
    env.physics.step()
    kept = 1 - 0.05 * 0.01333
    assert env.physics.velocity[0, 3, 1] == pytest.approx(-14.715 * 0.01333 * kept - 2 * 0.01333, rel=1e-6)


def test_target_falls_and_rests_on_the_ground() -> None:
    env = Walker(num_areas=3)
    env.reset()
    assert (env.physics.target_position[:, 1] == 1).all()
    env.physics.target_position[:, [0, 2]] = [(5, 5), (-5, 5), (5, -5)]
    for _ in range(60):
        env.physics.step()
    assert env.physics.target_position[:, 1] == pytest.approx(0.25, abs=2e-3)
    assert np.abs(env.physics._areas.qvel[:, 32:]).max() < 1e-2


@pytest.mark.parametrize(("gap", "touches"), [(0.018, True), (0.03, False)])
def test_target_moves_away_when_touched_and_keeps_its_velocity(gap: float, touches: bool) -> None:
    env = Walker(num_areas=2, gravity=0.0)
    env.reset()
    env.physics.stand(np.arange(2), np.zeros(2))
    env.physics.drive_on[:] = 0
    beside = (1.0535 + gap + 0.125, 1.44404, 0)  # beside the right hand
    env.physics.target_position[:] = [beside, (6, 1, 6)]
    env.physics._areas.qvel[:, 32:35] = (0.0, 0.3, 0.0)
    env.simulate()
    moved = np.linalg.norm(env.physics.target_position - [beside, (6, 1, 6)], axis=1) > 0.1
    assert moved.tolist() == [touches, False]
    assert env.physics._areas.qvel[:, 33] == pytest.approx(0.3, rel=1e-3)
    if touches:
        assert env.physics.target_position[0, 1] == 1


def test_a_target_that_left_the_platform_comes_back() -> None:
    env = posed()
    env.physics.target_position[:] = (12.6, 0.25, 0)
    env.simulate()
    assert np.linalg.norm(env.physics.target_position[0] - (0, 1, 1)) <= 9


def test_reward_is_velocity_match_times_look() -> None:
    env = posed(yaw=60)  # the head looks 60 degrees off: look = (0.5 + 1) / 2
    env.goal_speed[:] = 4.0
    env.physics.velocity[:] = (0, 0, 2.0)  # misses by 2 of 4: match = (1 - 0.25)^2
    env.fixed_update()
    assert env.agents.reward[0] == pytest.approx(0.5625 * 0.75)
    env.physics.velocity[:] = (0, 0, 8.5)  # further off than the goal speed: no reward
    env.agents.reward[:] = 0
    env.fixed_update()
    assert env.agents.reward[0] == 0


def test_a_nodding_head_looks_less() -> None:
    env = posed({("head", "X"): -30})
    env.goal_speed[:] = 1.0
    env.physics.velocity[:] = (0, 0, 1.0)
    env.fixed_update()
    assert env.agents.reward[0] == pytest.approx((np.cos(np.pi / 6) + 1) / 2)


def test_the_cube_turns_from_its_previous_place() -> None:
    env = posed()
    env.physics.position[0, 0] = (3.0, 0.9, 0.0)
    env.fixed_update()
    assert env.cube_forward[0].tolist() == pytest.approx([0, 0, 1])  # as seen from where the cube was
    assert env.cube_position[0].tolist() == [3.0, 0.9, 0.0]
    env.fixed_update()
    assert env.cube_forward[0].tolist() == pytest.approx([-3 / np.sqrt(34), 0, 5 / np.sqrt(34)])


def test_a_record_holds_five_ticks_of_reward() -> None:
    env = Posed(num_areas=1)
    env.reset()
    env.goal_speed[:] = 10.0
    env.physics._areas.qvel[0, :6] = 0
    env.physics._areas.qvel[0, :3] = 10 * env.cube_forward[0]
    env.physics.find_poses()
    env.step()
    look = (env.cube_forward[0] @ forward_of(env)) / 2 + 0.5
    assert env.get_steps(NAME)[0].reward[0] == pytest.approx(5 * look, rel=1e-5)


def forward_of(env: Walker) -> np.ndarray:
    w, x, y, z = env.physics.rotation[0, 3]
    return np.array([2 * (x * z + w * y), 0, 1 - 2 * (x * x + y * y)])


def test_a_fall_ends_the_episode_with_minus_one() -> None:
    env = Posed({3: (1, ["forearmL"])}, num_areas=2)
    env.reset()
    env.physics._areas.qvel[1, :3] = 1.0
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert env.tick == 3 and len(decisions) == 0
    assert terminals.agent_id.tolist() == [1] and terminals.reward.tolist() == [-1]
    assert terminals.interrupted.tolist() == [False]
    assert terminals.obs[0][0, FIRST["forearmL"]] == 1
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert len(decisions) == 2 and len(terminals) == 0 and (decisions.reward >= 0).all()
    assert decisions.obs[0][1, FIRST["forearmL"]] == 0


def test_a_second_part_in_the_same_tick_leaves_minus_one_behind() -> None:
    env = Posed({5: (0, ["head", "handR"])}, num_areas=1)
    env.reset()
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert terminals.reward.tolist() == [-1] and len(terminals) == 1
    assert decisions.reward.tolist() == pytest.approx([-1], abs=0.01)


@pytest.mark.parametrize("part", PARTS)
def test_which_parts_end_the_episode(part: str) -> None:
    env = Posed({1: (0, [part])}, num_areas=1)
    env.reset()
    env.step()
    ends = part not in ("shinL", "shinR", "footL", "footR")
    assert len(env.get_steps(NAME)[1]) == ends


def test_contact_flags_follow_begin_and_end_and_are_cleared_by_a_reset() -> None:
    env = Posed({1: (0, ["shinL"]), 2: (0, ["shinL"]), 4: (0, ["shinL"])}, num_areas=1)
    env.reset()
    env.physics._areas.qpos[0, 1] = 3.0
    shin, seen = PARTS.index("shinL"), []
    for tick in range(1, 5):
        env.simulate()
        seen.append(bool(env.grounded[0, shin]))
        if tick == 1:
            env.grounded[0] = False  # as a reset does: a contact that goes on does not begin again
    assert seen == [True, False, False, True]


def test_time_limit_interrupts() -> None:
    env = Posed(num_areas=2)
    env.reset()
    env.agents.step_count[0] = 4998
    env.step()
    decisions, terminals = env.get_steps(NAME)
    assert terminals.agent_id.tolist() == [0] and terminals.interrupted.tolist() == [True]
    assert terminals.reward[0] >= 0 and env.tick == 3  # sent in the next tick


def test_reset_ranges() -> None:
    env = Walker(num_areas=600)
    env.reset()
    obs = env.get_steps(NAME)[0].obs[0]
    assert 0.1 <= obs[:, 6].min() < 0.2 and 9.9 < obs[:, 6].max() <= 10
    ahead = env.physics.rotation[:, 0]
    yaw = np.degrees(2 * np.arctan2(ahead[:, 2], ahead[:, 0])) % 360
    assert np.histogram(yaw, 4, (0, 360))[0].min() > 110
    assert not ahead[:, [1, 3]].any() and not env.physics.velocity.any() and not env.physics.spin.any()
    offset = env.physics.target_position - (0, 1, 1)
    radius = np.linalg.norm(offset, axis=1)
    assert not offset[:, 1].any() and 8 < radius.max() <= 9
    assert np.mean(radius**2) == pytest.approx(2 / 5 * 81, rel=0.1)  # of a ball's projection
    before = env.physics.target_position.copy()
    env.end_episode(np.arange(600))
    assert (env.physics.target_position == before).all()


def test_contract() -> None:
    report = check_env(Walker(num_areas=4), steps=150, remake=lambda: Walker(num_areas=4))
    assert report.terminals > 0 and "get_state/set_state" in report.checks and "seed" in report.checks


def test_threads_do_not_change_the_run() -> None:
    one, two = Walker(num_areas=5, num_threads=1), Walker(num_areas=5, num_threads=2)
    for env in (one, two):
        env.reset()
    assert (play(one, 80) == play(two, 80)).all()


def test_snapshot_is_exact_in_a_fresh_scene() -> None:
    env = Walker(num_areas=5, gravity=12.0)
    env.reset()
    play(env, 60)
    state = env.get_state()
    first = play(env, 80)
    fresh = Walker(num_areas=5, seed=9)
    fresh.set_state(state)
    assert (play(fresh, 80) == first).all()
    env.set_state(state)
    assert (play(env, 80) == first).all()


def test_unknown_parameter() -> None:
    with pytest.raises(ConfigError, match="no parameter 'hip_mass'; choices: gravity"):
        make_scene("Walker", hip_mass=8)


def test_official_policy_walks(shared: Path) -> None:
    """Play 300 decisions of 24 figures; Unity's policy falls once in 100 to 250 decisions, random in 15."""
    pytest.importorskip("onnxruntime")
    spec = importlib.util.spec_from_file_location("run_policy", shared / "oracle" / "run_policy.py")
    assert spec is not None and spec.loader is not None
    oracle = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(oracle)
    policy = oracle.OfficialPolicy(str(shared / "oracle" / "Walker.onnx"), np.random.default_rng(0), True)
    env = Walker(num_areas=24)
    env.reset()
    falls = 0
    rewards: list[float] = []
    heights: list[float] = []
    feet: list[float] = []
    while len(rewards) < 300:
        decisions, terminals = env.get_steps(NAME)
        falls += len(terminals)
        if len(decisions):
            rewards.append(decisions.reward.mean())
            heights.append(env.physics.position[:, 0, 1].mean())
            feet.append(decisions.obs[0][:, [FIRST["footL"], FIRST["footR"]]].mean())
            env.set_actions(NAME, policy.act(decisions, env.behavior_specs[NAME]))
        env.step()
    assert falls < 24 * 300 / 120 and 0.85 < np.mean(rewards) < 2.5
    assert 0.82 < np.mean(heights) < 0.92 and 0.55 < np.mean(feet) < 0.9
