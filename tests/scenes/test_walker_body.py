"""The Walker's body, its observations and its actions, on hand-placed figures."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple
from walker_figures import (
    FIRST,
    NAME,
    PARTS,
    REST,
    ROOT_HALF,
    STRENGTHS,
    Posed,
    aim_at,
    observed,
    posed,
    position_of,
    rotation_of,
)

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.scene import ACTION_ORDER, Walker, shortest_rotation


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
