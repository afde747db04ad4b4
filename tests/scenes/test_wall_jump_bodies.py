"""The bodies of WallJump: ground, walls, pushing and standing on the block, against hand-worked numbers."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes.wall_jump.bodies import WallJumpBodies

GRAVITY = 2.75 * 9.81


def bodies(z: float = -10.0, yaw_deg: float = 0.0, wall: float = 0.0) -> WallJumpBodies:
    """Return one area with the agent on the floor at (0, z), the block at (0, -6.27)."""
    area = WallJumpBodies(1)
    area.position[:] = (0.0, 0.95, z)
    area.yaw[:] = np.radians(yaw_deg)
    area.wall_height[:] = wall
    return area


def step(area: WallJumpBodies, ticks: int = 1, drive: tuple[float, float, float] = (0, 0, 0)) -> None:
    for _ in range(ticks):
        area.step(np.array([drive], float), np.full(1, GRAVITY))


def test_ground_speed_of_the_sheet() -> None:
    area = bodies(-14.0)
    area.block[:, 0] = 8.0
    speeds = []
    for _ in range(20):
        step(area, 1, (0, 0, 3))
        speeds.append(area.velocity[0, 2])
        assert area.position[0, 1] == pytest.approx(0.95)
    np.testing.assert_allclose(speeds[:4], [2.26, 4.43, 6.51, 8.51], atol=0.01)
    assert speeds[-1] == pytest.approx(31.5, abs=0.1)


def test_landing_takes_the_horizontal_speed() -> None:
    area = bodies()
    area.velocity[:] = (0, -20, 10)
    step(area, 1)
    assert area.velocity[0].tolist() == [0, 0, 0]


def test_a_push_shares_momentum_and_the_block_coasts() -> None:
    """25 kg at v meet 10 kg at rest: v * 25 / 35. Alone, the block loses 2 % a tick."""
    area = bodies(-8.27)  # touching: -6.27 - 1.5 - 0.5
    area.velocity[:] = (0, 0, 7)
    before = 7 * 0.96 - 1.2 * GRAVITY * 0.02 * 0.96
    step(area)
    assert area.block_velocity[0, 2] == pytest.approx(before * 25 / 35, rel=1e-3)
    assert area.velocity[0, 2] == pytest.approx(before * 25 / 35, rel=1e-3)
    area.position[:, 2] = -14.0
    speed = area.block_velocity[0, 2]
    step(area, 10)
    assert area.block_velocity[0, 2] == pytest.approx(speed * 0.98**10)
    assert area.block[0, 1] == 1.5


def test_a_block_is_pushed_against_the_wall_and_stays() -> None:
    """Its far face stops at the wall's, z = -2.73; so its middle at -4.23."""
    area = bodies(-9.0, wall=8.0)
    step(area, 60, (0, 0, 3))
    assert area.block[0, 2] == pytest.approx(-4.23, abs=0.01)
    assert area.position[0, 2] == pytest.approx(-6.23, abs=0.02)
    assert area.block[0, 0] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("wall", "z"), [(8.0, -4.23), (4.0, -4.23), (1.0, -2.8), (0.0, -2.8)])
def test_a_block_drawn_into_the_wall_is_pushed_out(wall: float, z: float) -> None:
    """At 10 m/s at most, without keeping a speed; a wall below the block's feet (H / 2 <= 0.5) does not."""
    area = bodies(-12.0, wall=wall)
    area.block[:, 2] = -2.8
    step(area)
    assert area.block[0, 2] == pytest.approx(-2.8 - (0.2 if z < -3 else 0.0))
    step(area, 24)
    assert area.block[0, 2] == pytest.approx(z, abs=0.01) and not area.block_velocity.any()


@pytest.mark.parametrize("yaw", [0.0, 20.0, 45.0])
def test_the_wall_holds_at_full_speed(yaw: float) -> None:
    area = bodies(-7.0, yaw, wall=8.0)
    area.block[:] = (8.0, 1.5, -9.0)
    area.velocity[:] = (0, 0, 31)
    reach = 0.5 * (np.cos(np.radians(yaw)) + np.sin(np.radians(yaw)))
    step(area, 40, (0, 0, 3))
    assert area.position[0, 2] == pytest.approx(-2.73 - reach, abs=0.01)


def test_standing_on_the_block_drags_it_along() -> None:
    """Friction slows the agent and speeds the block up until both are equally fast."""
    area = bodies(-6.27)
    area.position[:, 1] = 3.0
    area.velocity[:] = (4, 0, 0)
    step(area)
    impulse = GRAVITY * 0.02 * 0.96 * 1.2
    assert area.velocity[0, 0] == pytest.approx(4 * 0.96 - impulse)
    assert area.block_velocity[0, 0] == pytest.approx(impulse * 25 / 10)
    assert area.position[0, 1] == pytest.approx(3.0)


def test_small_ground_check() -> None:
    """A surface up to 0.55 m below the feet's middle: floor, block top 2.5, wall top H / 2."""
    area = WallJumpBodies(7)
    area.block[:] = (0.0, 1.5, -8.0)
    area.wall_height[:] = 8.0
    area.position[:] = [
        (5, 1.49, -8),
        (5, 1.51, -8),
        (0, 3.54, -8),
        (0, 3.56, -8),
        (1.6, 3.0, -8),
        (5, 5.04, -1.98),
        (5, 5.06, -1.98),
    ]
    assert area.stands_over().tolist() == [True, False, True, False, False, True, False]


def test_goal_volume_turns_with_the_agent() -> None:
    """Beside the goal's face by 0.6 m: inside only where the agent's corner points at it."""
    area = WallJumpBodies(2)
    area.position[:] = (6.37 - 2.0 - 0.6, 0.95, 2.93)
    area.yaw[:] = np.radians([0, 45])
    assert area.in_goal().tolist() == [1]
