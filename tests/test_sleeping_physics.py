"""MuJoCo areas whose bodies sleep: who sleeps, what wakes them, exactness, and numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mappo_unity.scenes.core.sleeping import SleepingPhysics

AREA = """
<mujoco>
  <option timestep="0.01" gravity="0 -10 0"/>
  <worldbody>
    <geom type="plane" size="0 0 1" zaxis="0 1 0"/>
    <body name="hand" mocap="true" pos="0 50 0"><geom type="box" size="0.4 0.4 0.4"/></body>
    <body name="cart" pos="-4 0.5 0" sleep="never">
      <joint type="slide" axis="1 0 0"/><geom type="box" size="0.4 0.4 0.4" mass="5"/>
    </body>
    <body name="low" pos="0 0.5 0"><freejoint/><geom type="box" size="0.5 0.5 0.5" mass="1"/></body>
    <body name="high" pos="0 1.5 0"><freejoint/><geom type="box" size="0.5 0.5 0.5" mass="1"/></body>
    <body name="apart" pos="4 0.5 0"><freejoint/><geom type="box" size="0.5 0.5 0.5" mass="1"/></body>
  </worldbody>
  <sensor><framepos objtype="body" objname="cart"/></sensor>
</mujoco>
"""
CART, LOW, HIGH, APART = range(4)
EVERY_AREA = np.arange(3)


def areas(count: int = 3, **options: Any) -> SleepingPhysics:
    return SleepingPhysics(mujoco.MjSpec.from_string(AREA), count, tolerance=0.02, **options)


def settled(count: int = 3, **options: Any) -> SleepingPhysics:
    physics = areas(count, **options)
    for _ in range(100):
        physics.step(2, np.arange(count), 0.01)
    return physics


def test_what_rests_sleeps_and_stays_exactly_where_it_is() -> None:
    physics = settled()
    assert physics.asleep.tolist() == [[False, True, True, True]] * 3
    before = physics.qpos.copy()
    physics.step(10, EVERY_AREA, 0.01)
    assert (physics.qpos == before).all() and (physics.qvel == 0).all()
    assert physics.qpos[0, [2, 9]] == pytest.approx([0.5, 1.5], abs=0.01)  # heights, one on the other


def test_a_touch_wakes_a_body_and_all_that_it_carries() -> None:
    physics = settled()
    physics.qvel[1, 0] = 10.0  # 0.1 m a step: three metres to the lower box
    while not physics.qvel[1, 1:].any():
        assert physics.asleep[1].tolist() == [False, True, True, True]
        physics.step(1, EVERY_AREA, 0.01)
    assert physics.qpos[1, 0] == pytest.approx(3.1, abs=0.15)  # of the way from -4 to -0.9
    assert physics.asleep[1].tolist() == [False, False, False, True]
    assert physics.asleep[0].tolist() == [False, True, True, True]

    physics.qvel[1, 0] = -1.0
    for _ in range(500):
        physics.step(1, EVERY_AREA, 0.01)
    assert np.abs(physics.qpos[1, [1, 8]]).max() > 0.1  # along x: they were pushed
    assert physics.asleep[1].tolist() == [False, True, True, True]


def test_a_mocap_body_pushes_those_that_were_woken() -> None:
    physics = settled()
    before = physics.qpos.copy()
    physics.mocap_pos[:, 0] = (4.0, 0.5, 0.8)  # 0.1 m deep in the box that stands apart
    physics.wake(np.array([1]))
    for _ in range(5):
        physics.step(2, EVERY_AREA, 0.01)
    moved = np.abs(physics.qpos - before).max(axis=1)
    assert moved[1] > 0.05  # the others, too, where MuJoCo itself lets the touch wake them


def test_areas_sensors_and_lengths_of_steps() -> None:
    physics = areas(4)
    physics.qvel[:, 0] = 1.0
    sensors = physics.step(4, np.array([3, 1]), 0.02)
    assert physics.qpos[:, 0] == pytest.approx([0, 0.08, 0, 0.08])
    assert sensors.shape == (2, 4, 3)
    assert sensors[:, :, 0] == pytest.approx(np.array([[-4, -3.98, -3.96, -3.94]] * 2))  # before each motion


def test_state_is_exact_and_neither_history_nor_threads_matter() -> None:
    """Boxes that are pushed, sleep and wake are the same, to the bit, in an area alone and among others."""
    physics, threads, alone = areas(), areas(num_threads=2), [areas() for _ in EVERY_AREA]
    rng, changes = np.random.default_rng(0), 0
    for tick in range(200):
        before = physics.asleep.copy()
        speed = rng.uniform(-6.0, 8.0, 3) if tick % 20 == 0 else None
        for one in (physics, threads, *alone):
            if speed is not None:
                one.qvel[:, 0] = speed
        physics.step(3, EVERY_AREA, 0.01)
        threads.step(3, EVERY_AREA[::-1], 0.01)
        for area, one in enumerate(alone):
            one.step(3, np.array([area]), 0.01)
        changes += int((physics.asleep != before).sum())
    assert changes >= 6  # they have slept and woken

    for name, value in physics.get_state().items():
        assert (threads.get_state()[name] == value).all()
        assert all((one.get_state()[name][area] == value[area]).all() for area, one in enumerate(alone))

    fresh = areas()
    fresh.set_state(physics.get_state())
    for one in (physics, fresh):
        one.qvel[:, 0] = 5.0
        for _ in range(60):
            one.step(3, EVERY_AREA, 0.01)
    assert all((fresh.get_state()[name] == value).all() for name, value in physics.get_state().items())


def test_what_is_derived_of_those_asleep_is_what_mujoco_derives() -> None:
    physics = settled()
    physics.qvel[0, 0] = 10.0
    names = ("tree_awake", "body_awake", "ntree_awake", "nbody_awake", "nparent_awake", "nv_awake")
    data, seen = physics._data[0], set()
    for _ in range(80):
        physics.step(1, np.array([0]), 0.01)
        theirs = [np.copy(getattr(data, name)).tolist() for name in names]
        lists = [data.body_awake_ind, data.parent_awake_ind, data.dof_awake_ind]
        theirs += [part[:count].tolist() for part, count in zip(lists, theirs[3:], strict=True)]

        physics._sleepers.enter(data, data.tree_asleep.copy())
        ours = [np.copy(getattr(data, name)).tolist() for name in names]
        ours += [part[:count].tolist() for part, count in zip(lists, ours[3:6], strict=True)]
        assert ours == theirs
        seen.add(tuple(ours[0]))
    assert len(seen) >= 2


def test_infinite_state_names_the_area(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into a file there
    physics = areas()
    physics.qvel[1, 0] = np.inf
    with pytest.raises(FloatingPointError, match="physics of area 1"):
        physics.step(1, EVERY_AREA, 0.01)
