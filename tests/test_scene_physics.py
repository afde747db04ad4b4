"""MuJoCo areas: independence, exactness, substeps, and numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mappo_unity.scenes.core.physics import AreaPhysics

AREA = """
<mujoco>
  <option timestep="0.01" gravity="0 -10 0"/>
  <worldbody>
    <geom name="floor" type="box" size="5 1 5" pos="0 -1 0" {contact}/>
    <body name="hand" mocap="true" pos="0 7 0"><geom type="sphere" size="0.1" contype="0" conaffinity="0"/></body>
    <body name="ball" pos="0 3 0">
      <freejoint/><geom name="ball" type="sphere" size="0.5" mass="2" {contact}/>
    </body>
    <body name="slider" pos="3 9 0">
      <joint name="slide" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="4" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  {pair}
  <actuator><motor joint="slide"/></actuator>
  <sensor><framepos objtype="body" objname="ball"/></sensor>
</mujoco>
"""  # noqa: E501
PAIR = '<contact><pair geom1="floor" geom2="ball"/></contact>'


def areas(count: int, per_model: int = 1, **options: int) -> AreaPhysics:
    contact = "" if per_model == 1 else 'contype="0" conaffinity="0"'
    text = AREA.format(contact=contact, pair="" if per_model == 1 else PAIR)
    return AreaPhysics(mujoco.MjSpec.from_string(text), count, areas_per_model=per_model, **options)


@pytest.mark.parametrize("per_model", [1, 3, 8])
def test_arrays_inputs_and_free_fall(per_model: int) -> None:
    physics = areas(7, per_model)
    assert physics.qpos.shape == (7, 8) and physics.qvel.shape == (7, 7) and physics.ctrl.shape == (7, 1)
    assert physics.mocap_pos.tolist() == [[[0, 7, 0]]] * 7 and physics.sensordata.shape == (7, 3)
    physics.ctrl[:, 0] = np.arange(7)
    physics.qfrc_applied[2, 0] = 6.0
    physics.step(num_substeps=4)
    assert physics.qvel[:, 1] == pytest.approx(-0.4)  # 4 * 0.01 s * 10
    assert physics.qvel[:, 6] == pytest.approx(np.arange(7) / 4 * 0.04)  # F / m * t
    assert physics.qvel[2, 0] == pytest.approx(6 / 2 * 0.04) and physics.qvel[1, 0] == 0
    assert physics.sensordata[0, 1] == pytest.approx(3 - 0.01 * (0.1 + 0.2 + 0.3))  # before the last substep


@pytest.mark.parametrize("per_model", [1, 3])
def test_state_is_exact_and_history_does_not_matter(per_model: int) -> None:
    physics, fresh = areas(5, per_model), areas(5, per_model, num_threads=2)
    physics.qvel[:] = np.random.default_rng(0).uniform(-2, 2, physics.qvel.shape)
    for _ in range(80):  # bounces and rolls
        physics.step(2)
    state = physics.get_state()
    fresh.set_state(state)
    for _ in range(50):
        physics.step(2)
        fresh.step(2)
    assert (physics.qpos == fresh.qpos).all() and (physics.qvel == fresh.qvel).all()
    physics.set_state(state)
    for _ in range(50):
        physics.step(2)
    assert (physics.qpos == fresh.qpos).all()


def test_several_areas_a_model_equal_one_area_a_model() -> None:
    one, three = areas(5, 1), areas(5, 3)
    for physics in (one, three):
        physics.qvel[:, :3] = [[i, 0, -i] for i in range(5)]
        for _ in range(100):
            physics.step()
    assert one.qpos == pytest.approx(three.qpos, abs=1e-4)
    assert (three.qpos[:, 1] > 0.4).all()  # on the floor, not through it


@pytest.mark.parametrize("per_model", [1, 4])
def test_own_model_changes_one_area(per_model: int) -> None:
    physics = areas(6, per_model)
    model, prefix = physics.own_model(4)
    model.body(f"{prefix}slider").mass[0] = 8.0
    physics.constants_changed(4)
    physics.ctrl[:] = 1.0
    physics.step()
    expected = np.full(6, 0.01 / 4)
    expected[4] = 0.01 / 8
    assert physics.qvel[:, 6] == pytest.approx(expected)
    physics.set_gravity(20.0)
    physics.step()
    assert physics.qvel[:, 1] == pytest.approx(-0.1 - 0.2)


def test_infinite_state_names_the_area(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into a file there
    physics = areas(3)
    physics.qvel[1, 0] = np.inf
    with pytest.raises(FloatingPointError, match="physics of area 1"):
        physics.step()
