"""Walker against numbers worked out by hand from its sheet, and against Unity's own policy."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple

from mappo_unity.config import ConfigError
from mappo_unity.scenes import make_scene
from mappo_unity.scenes import walker_body as body
from mappo_unity.scenes.check import check_env
from mappo_unity.scenes.walker import ACTION_ORDER, Walker, shortest_rotation

NAME = "Walker?team=0"
PARTS = (
    "hips chest spine head thighL shinL footL thighR shinR footR armL forearmL handL armR forearmR handR"
).split()
FIRST = dict(
    zip(PARTS, (18, 28, 43, 58, 73, 88, 103, 118, 133, 148, 163, 178, 193, 203, 218, 233), strict=True)
)
"""Index of every part's first observation, from the sheet."""
REST = {
    "hips": (0, 0.953, 0), "spine": (0, 1.17839, 0), "chest": (0, 1.44404, 0), "head": (0, 1.8935, 0),
    "armL": (-0.4125, 1.44404, 0), "forearmL": (-0.7425, 1.44404, 0), "handL": (-0.9735, 1.44404, 0),
    "armR": (0.4125, 1.44404, 0), "forearmR": (0.7425, 1.44404, 0), "handR": (0.9735, 1.44404, 0),
    "thighL": (-0.132, 0.689, 0), "shinL": (-0.132, 0.359, 0), "footL": (-0.132, 0.161, 0),
    "thighR": (0.132, 0.689, 0), "shinR": (0.132, 0.359, 0), "footR": (0.132, 0.161, 0),
}  # fmt: skip
STRENGTHS = (
    "chest spine head thighL shinL footL thighR shinR footR armL forearmL armR forearmR".split()
)  # of actions 26 to 38
ROOT_HALF = np.sqrt(0.5)


class Posed(Walker):
    """Walker without physics: figures stay as they are put; `hits` maps a tick to (slot, parts)."""

    def __init__(self, hits: dict[int, tuple[int, list[str]]] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self.hits = hits or {}
        self.tick = 0
        self.physics.step = self.hit  # type: ignore[method-assign]

    def hit(self) -> None:
        self.tick += 1
        self.physics.find_poses()
        if self.tick in self.hits:
            slot, parts = self.hits[self.tick]
            for part in parts:
                self.physics.position[slot, PARTS.index(part), 1] = 0.1


def posed(angles: Mapping[tuple[str, str], float] | None = None, yaw: float = 0.0, **options: Any) -> Posed:
    """Return one figure in the start pose at `yaw` degrees with the given joint angles (degrees)."""
    env = Posed(num_areas=1, **options)
    env.reset()
    env.physics.stand(np.array([0]), np.radians([yaw]))
    for hinge, degrees in (angles or {}).items():
        env.physics.angle[0, body.HINGES.index(hinge)] = np.radians(degrees)
    env.physics.find_poses()
    aim_at(env, (0.0, 1.0, 5.0))
    env.grounded[:] = False
    return env


def aim_at(env: Walker, target: tuple[float, float, float]) -> None:
    env.physics.target_position[:] = target
    env.fixed_update()
    env.agents.reward[:] = 0


def observed(env: Walker) -> np.ndarray:
    return env.observe(0, np.array([0]))[0][0]


def position_of(obs: np.ndarray, part: str) -> list[float]:
    """Return a part's position from the hips, in the cube's frame."""
    return obs[FIRST[part] + 7 : FIRST[part] + 10].tolist()


def rotation_of(obs: np.ndarray, part: str) -> list[float]:
    return obs[FIRST[part] + 10 : FIRST[part] + 14].tolist()


def play(env: Walker, steps: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        decisions, terminals = env.get_steps(NAME)
        if len(decisions):
            action = rng.uniform(-1, 1, (len(decisions), 39)).astype(np.float32)
            env.set_actions(NAME, ActionTuple(continuous=action))
        for part in (decisions, terminals):
            rows += [part.agent_id, part.reward, part.obs[0].ravel()]
        env.step()
    return np.concatenate(rows)


# ---- the behavior and the body ---------------------------------------------------------------------------


def test_spec_ids_and_groups() -> None:
    env = make_scene("Walker")
    env.reset()
    spec = env.behavior_specs[NAME]
    assert list(env.behavior_specs) == [NAME]
    assert [(o.name, o.shape) for o in spec.observation_specs] == [("VectorSensor_size243", (243,))]
    assert spec.action_spec.continuous_size == 39 and spec.action_spec.discrete_branches == ()
    decisions, terminals = env.get_steps(NAME)
    assert decisions.agent_id.tolist() == list(range(10)) and not decisions.group_id.any()
    assert not decisions.reward.any() and len(terminals) == 0


def test_body_at_rest() -> None:
    env = posed()
    assert [part.name for part in body.PARTS] == PARTS
    for number, part in enumerate(PARTS):
        assert env.physics.position[0, number].tolist() == pytest.approx(REST[part], abs=1e-9), part
    model = body.area().compile()
    assert model.body("hips").subtreemass[0] == pytest.approx(109)
    assert len(body.HINGES) == 26 and model.nv == 6 + 26 + 6
    gap = dict(zip(PARTS, env.physics.ground_gap()[0], strict=True))
    assert gap["footL"] == pytest.approx(0.1393 - 0.125, abs=1e-4) and gap["footR"] == gap["footL"]
    assert gap["head"] == pytest.approx(1.6735 - 0.125) and gap["hips"] == pytest.approx(0.853 - 0.125)
    assert gap["shinL"] == pytest.approx(0.199 - 0.125) and gap["thighR"] == pytest.approx(0.539 - 0.125)


def test_pose_after_standing_is_that_of_the_joints() -> None:
    env = posed({("thighL", "X"): -30, ("head", "Y"): 10})
    env.physics.stand(np.array([0]), np.radians([50]))
    written = [env.physics.position.copy(), env.physics.rotation.copy(), env.physics.velocity.copy()]
    env.physics.find_poses()
    for mine, found in zip(
        written, (env.physics.position, env.physics.rotation, env.physics.velocity), strict=True
    ):
        assert np.abs(mine - found).max() < 1e-12


def test_ground_gap_agrees_with_mujoco() -> None:
    env = Walker(num_areas=6)
    env.reset()
    env.physics.angle[:] = np.random.default_rng(0).uniform(-0.9, 0.9, env.physics.angle.shape)
    env.physics.find_poses()
    model = body.area().compile()
    data = mujoco.MjData(model)
    ground = model.geom("ground").id
    for area, gaps in enumerate(env.physics.ground_gap()):
        data.qpos[:33] = env.physics._areas.qpos[area, :33]
        mujoco.mj_kinematics(model, data)
        data.geom_xpos[ground, 1] -= 1  # a plane has no distance to anything below it
        for part, gap in zip(PARTS, gaps, strict=True):
            near = mujoco.mj_geomDistance(model, data, ground, model.geom(part).id, 5, None)
            assert near - 1 == pytest.approx(gap, abs=1e-6), part


# ---- what every observation means ------------------------------------------------------------------------


def test_goal_observations() -> None:
    env = posed(yaw=90)  # faces +x; the target lies ahead in +z
    env.goal_speed[:] = 4.0
    env.physics.velocity[:] = (1.0, 0.5, 2.0)
    obs = observed(env)
    assert obs[0] == pytest.approx(np.sqrt(1 + 0.25 + 4))
    assert obs[1:7].tolist() == pytest.approx([1.0, 0.5, 2.0, 0, 0, 4.0])
    quarter = [0, -ROOT_HALF, 0, ROOT_HALF]  # from +x to +z: 90 degrees to the left
    assert obs[7:11].tolist() == pytest.approx(quarter) and obs[11:15].tolist() == pytest.approx(quarter)
    assert obs[15:18].tolist() == pytest.approx([0, 1 - 0.953, 5])


def test_vectors_are_seen_from_the_cube() -> None:
    env = posed()
    aim_at(env, (7.0, 0.25, 0.0))  # ahead is +x, so the cube's right is -z
    for number in range(16):
        env.physics.velocity[0, number] = (number, 100 + number, 200 + number)
        env.physics.spin[0, number] = (300 + number, 400 + number, 500 + number)
    obs = observed(env)
    for number, part in enumerate(PARTS):
        first = FIRST[part]
        assert obs[first + 1 : first + 4].tolist() == [-200 - number, 100 + number, number]
        assert obs[first + 4 : first + 7].tolist() == [-500 - number, 400 + number, 300 + number]
        x, y, z = REST[part]
        assert position_of(obs, part) == pytest.approx([-z, y - 0.953, x], abs=1e-6)
    assert obs[15:18].tolist() == pytest.approx([0, 0.25 - 0.953, 7], abs=1e-6)


def test_ground_contacts_are_seen_at_each_parts_first_index() -> None:
    env = posed()
    for number, part in enumerate(PARTS):
        env.grounded[0] = np.arange(16) == number
        obs = observed(env)
        assert [p for p in PARTS if obs[FIRST[p]] == 1] == [part]
        assert sum(obs[FIRST[p]] for p in PARTS) == 1


def test_strengths_are_zero_until_the_first_action_and_outlive_a_reset() -> None:
    env = posed()
    places = [FIRST[part] + 14 for part in STRENGTHS]
    assert not observed(env)[places].any()
    env.agents.continuous[0, 26:] = np.linspace(-1, 1, 13)
    env.act(np.array([0]))
    assert observed(env)[places].tolist() == pytest.approx((np.linspace(0, 1, 13)).tolist())
    env.end_episode(np.array([0]))
    assert observed(env)[places].tolist() == pytest.approx((np.linspace(0, 1, 13)).tolist())


LEG_FORWARD = {
    "thighL": (-0.132, -0.264 + 0.16, 0.16), "shinL": (-0.132, -0.104, 0.49), "footL": (-0.132, -0.104, 0.688)
}  # fmt: skip


@pytest.mark.parametrize(
    ("hinge", "degrees", "rotation", "places"),
    [
        (("thighL", "X"), -90, (-ROOT_HALF, 0, 0, ROOT_HALF), LEG_FORWARD),
        (("shinR", "X"), 90, (ROOT_HALF, 0, 0, ROOT_HALF), {"shinR": (0.132, -0.424, -0.17)}),
        (("shinR", "X"), 120, (np.sqrt(3) / 2, 0, 0, 0.5), {}),  # heel back
        (("head", "X"), -30, (np.sin(np.pi / 12), 0, 0, np.cos(np.pi / 12)), {}),  # nods
        (("armL", "X"), 90, (0, ROOT_HALF, 0, ROOT_HALF), {"handL": (-0.2325, 0.49104, 0.741)}),
        (("armR", "X"), 90, (0, -ROOT_HALF, 0, ROOT_HALF), {"handR": (0.2325, 0.49104, 0.741)}),
        (("forearmL", "X"), 90, (0, ROOT_HALF, 0, ROOT_HALF), {"handL": (-0.5825, 0.49104, 0.391)}),
        (("forearmR", "X"), 90, (0, -ROOT_HALF, 0, ROOT_HALF), {"handR": (0.5825, 0.49104, 0.391)}),
        (("spine", "X"), 20, (-np.sin(np.pi / 18), 0, 0, np.cos(np.pi / 18)), {}),
        (("footL", "X"), 20, (-np.sin(np.pi / 18), 0, 0, np.cos(np.pi / 18)), {}),
        (("footR", "Y"), 20, (0, -np.sin(np.pi / 18), 0, np.cos(np.pi / 18)), {}),
        (("footR", "Z"), 20, (0, 0, -np.sin(np.pi / 18), np.cos(np.pi / 18)), {}),
        (("chest", "Y"), 20, (0, 0, np.sin(np.pi / 18), np.cos(np.pi / 18)), {}),  # Y is -z: rolls
        (("chest", "Z"), 15, (0, -np.sin(np.pi / 24), 0, np.cos(np.pi / 24)), {}),  # Z is +y: turns
        (("thighR", "Y"), 40, (0, 0, np.sin(np.pi / 9), np.cos(np.pi / 9)), {}),  # sideways
    ],
)
def test_a_joint_angle_turns_its_part_about_minus_the_axis(
    hinge: tuple[str, str],
    degrees: float,
    rotation: tuple[float, ...],
    places: dict[str, tuple[float, float, float]],
) -> None:
    obs = observed(posed({hinge: degrees}))
    for part in STRENGTHS:
        expected = rotation if part == hinge[0] else (0, 0, 0, 1)
        assert rotation_of(obs, part) == pytest.approx(expected, abs=1e-6), part
    for part, place in places.items():
        assert position_of(obs, part) == pytest.approx(place, abs=1e-6), part


def test_euler_order_is_z_then_x_then_y() -> None:
    env = posed({("footL", "Z"): 90, ("footL", "X"): 90})
    # (-k s, s) (-i s, s) with s = sin 45: the cross product k x i = j is positive; x first would make it -j.
    assert rotation_of(observed(env), "footL") == pytest.approx([-0.5, 0.5, -0.5, 0.5], abs=1e-6)


def test_rotations_do_not_depend_on_where_the_figure_faces() -> None:
    angles = {("thighL", "X"): -60, ("thighL", "Y"): 20, ("head", "X"): 5}
    one, two = (observed(posed(angles, yaw=yaw)) for yaw in (0, 200))
    for part in STRENGTHS:
        assert rotation_of(one, part) == pytest.approx(rotation_of(two, part), abs=1e-6)


def test_velocities_are_those_of_the_centres_of_mass() -> None:
    env = posed()
    env.physics._areas.qvel[0, :6] = (1, 0, 0, 0, 2, 0)  # moves right, spins about +y
    env.physics.find_poses()
    obs = observed(env)
    foot = FIRST["footL"]
    # Unity's cross product: (0, 2, 0) x (x, y, z) = (2 z, 0, -2 x), at the foot's centre.
    assert obs[foot + 1 : foot + 4].tolist() == pytest.approx([1 + 2 * 0.03283, 0, 0.264], abs=1e-6)
    assert obs[foot + 4 : foot + 7].tolist() == pytest.approx([0, 2, 0], abs=1e-6)
    head = FIRST["head"]
    assert obs[head + 1 : head + 4].tolist() == pytest.approx([1, 0, 0], abs=1e-6)


def test_shortest_rotation_of_opposite_vectors_is_half_a_turn() -> None:
    turn = shortest_rotation(np.array([[0, 0, 1.0]]), np.array([[0, 0, -1.0]]))
    assert turn.tolist() == [[0, 1, 0, 0]]


# ---- actions ---------------------------------------------------------------------------------------------


def test_which_joint_target_each_action_sets() -> None:
    env = posed()
    hinges = (
        "chestX chestY chestZ spineX spineY spineZ thighLX thighLY thighRX thighRY shinLX shinRX "
        "footRX footRY footRZ footLX footLY footLZ armLX armLY armRX armRY forearmLX forearmRX headX headY"
    ).split()
    assert ["".join(hinge) for hinge in ACTION_ORDER] == hinges
    low, high = targets(env, -1.0), targets(env, 1.0)
    for number, hinge in enumerate(hinges):
        env.agents.continuous[0] = -1
        env.agents.continuous[0, number] = 1
        env.act(np.array([0]))
        moved = [h for h in hinges if target(env, h) != low[h]]
        assert moved == [hinge] and target(env, hinge) == high[hinge]
    assert (low["thighLX"], high["thighLX"]) == (-90, 60) and (low["headX"], high["headX"]) == (-30, 10)
    assert (low["shinRX"], high["shinRX"]) == (0, 120) and (low["forearmLX"], high["forearmLX"]) == (0, 160)
    assert (low["armRY"], high["armRY"]) == (-100, 100) and (low["spineZ"], high["spineZ"]) == (-15, 15)


def target(env: Walker, hinge: str) -> float:
    """Return a hinge's target in degrees."""
    number = ["".join(each) for each in body.HINGES].index(hinge)
    return round(float(np.degrees(env.physics.drive_target[0, number])), 9)


def targets(env: Walker, action: float) -> dict[str, float]:
    env.agents.continuous[0] = action
    env.act(np.array([0]))
    return {"".join(hinge): target(env, "".join(hinge)) for hinge in body.HINGES}


def test_mid_and_out_of_range_actions() -> None:
    env = posed()
    middle = targets(env, 0.0)
    assert middle["thighLX"] == -15 and middle["shinLX"] == 60 and middle["headX"] == -10
    assert middle["thighLY"] == 0 and middle["footRZ"] == 0
    assert targets(env, 3.0) == targets(env, 1.0) and targets(env, -1.0) == targets(env, -3.0)
    assert observed(env)[FIRST["head"] + 14] == -1  # the strength is not clamped


def test_a_strength_of_zero_switches_its_drive_off() -> None:
    env = posed()
    env.agents.continuous[0] = 0.5
    env.agents.continuous[0, 26 + STRENGTHS.index("shinR")] = -1
    env.act(np.array([0]))
    off = [hinge for hinge, on in zip(body.HINGES, env.physics.drive_on[0], strict=True) if not on]
    assert off == [("shinR", "X")]
    env.physics._drive()
    shin = body.HINGES.index(("shinR", "X"))
    torque = env.physics._areas.qfrc_applied[0, 6:32]
    left = body.HINGES.index(("shinL", "X"))
    assert torque[shin] == 0 and torque[left] == pytest.approx(40000 * 0.018 * np.pi / 2)


def test_actions_are_executed_at_decisions_only() -> None:
    env = Posed(num_areas=1)
    env.reset()
    env.set_actions(NAME, ActionTuple(continuous=np.full((1, 39), 0.5, np.float32)))
    env.step()
    assert target(env, "shinLX") == 90 and env.tick == 5
    env.end_episode(np.array([0]))
    assert target(env, "shinLX") == 90  # joint targets outlive the reset
    env.reset()  # a later reset executes one action of zeros
    assert target(env, "shinLX") == 60 and env.strength[0].tolist() == [0.5] * 13


# ---- drives and physics ----------------------------------------------------------------------------------


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


# ---- rewards, ends, resets -------------------------------------------------------------------------------


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


# ---- the whole ------------------------------------------------------------------------------------------


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
