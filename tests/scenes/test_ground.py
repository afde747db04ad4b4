"""The contact rules of upright boxes, against numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes.core import ground

CUBE = (0.5, 0.5, 0.5)


def _yaw(*degrees: float) -> np.ndarray:
    return np.radians(np.array(degrees))


def test_a_driven_box_follows_the_recorded_hallway_speeds() -> None:
    """Sheet of Hallway: 5.4 m/s after six ticks from rest, terminal speed 24.7 m/s."""
    velocity = np.zeros((1, 3))
    speeds = []
    for _ in range(400):
        velocity[:, 2] = (velocity[:, 2] + 1.5) * 0.96
        ground.slide(velocity, 19.62 * 0.02 * 0.96)
        speeds.append(velocity[0, 2])
    assert speeds[0] == pytest.approx(0.988, abs=1e-3)
    assert speeds[5] == pytest.approx(5.4, abs=0.1)
    assert speeds[-1] == pytest.approx(24.7, abs=0.05)


def test_slide_stops_at_rest_and_leaves_the_air_alone() -> None:
    velocity = np.array([[0.3, -1.0, 0.4], [3.0, -1.0, 4.0]])
    ground.slide(velocity, np.array([10.0, 0.0]))
    np.testing.assert_allclose(velocity, [[0, -1, 0], [3, -1, 4]])


def test_plan_extent_of_a_turned_cube_is_its_half_diagonal() -> None:
    x, z = ground.plan_extent(_yaw(0, 45), CUBE)
    np.testing.assert_allclose(x, [0.5, 0.5**0.5])
    np.testing.assert_allclose(z, [0.5, 0.5**0.5])


def test_box_gap_finds_side_top_and_corner() -> None:
    """Beside, on top, and a cube on its corner whose nearest side is its own face."""
    offset = np.array([[2.1, 0.2, 0.0], [0.3, 0.9, 0.1], [2.0, 0.0, 2.0]])
    gap, normal = ground.box_gap(offset, _yaw(0, 0, 45), CUBE, (1.5, 0.5, 1.5))
    # 2.1 - 2; 0.9 - 1; distance of the centres sqrt(8) - (0.5 + half diagonal 1.5 sqrt(2))
    np.testing.assert_allclose(gap, [0.1, -0.1, 8**0.5 - 0.5 - 1.5 * 2**0.5])
    np.testing.assert_allclose(normal, [[1, 0, 0], [0, 1, 0], [0.5**0.5, 0, 0.5**0.5]], atol=1e-12)


def test_box_gap_is_the_same_in_a_turned_world() -> None:
    rng = np.random.default_rng(0)
    offset, yaw, other = rng.normal(size=(50, 3)), rng.uniform(-9, 9, 50), rng.uniform(-9, 9, 50)
    half, other_half = (0.5, 0.6, 0.7), (1.0, 0.4, 0.2)
    gap, normal = ground.box_gap(offset, yaw, half, other_half, other)
    local = np.stack(
        [
            offset[:, 0] * np.cos(other) - offset[:, 2] * np.sin(other),
            offset[:, 1],
            offset[:, 0] * np.sin(other) + offset[:, 2] * np.cos(other),
        ],
        1,
    )
    expected, local_normal = ground.box_gap(local, yaw - other, half, other_half)
    np.testing.assert_allclose(gap, expected)
    x, y, z = local_normal.T  # right = (cos, 0, -sin), forward = (sin, 0, cos)
    back = np.stack([x * np.cos(other) + z * np.sin(other), y, z * np.cos(other) - x * np.sin(other)], 1)
    np.testing.assert_allclose(normal, back, atol=1e-12)
    overlap = ground.boxes_overlap(offset, yaw, half, other_half, other)
    assert (overlap == (gap < 0)).all() and 0 < overlap.sum() < 50
    swapped, opposite = ground.box_gap(-offset, other, other_half, half, yaw)
    np.testing.assert_allclose(gap, swapped)
    np.testing.assert_allclose((normal * opposite).sum(1), -1)


def test_stop_closes_the_gap_and_rubs_twice() -> None:
    """A gap of 1 cm lets 0.5 m/s through; 3.5 m/s are taken, and 1.2 times as much along the wall."""
    velocity = np.array([[-4.0, 0.0, 10.0], [4.0, 0.0, 10.0]])
    impulse = ground.stop(velocity, np.tile([1.0, 0.0, 0.0], (2, 1)), np.array([0.01, 0.01]))
    np.testing.assert_allclose(impulse, [3.5, 0])
    np.testing.assert_allclose(velocity, np.array([[-0.5, 0, 10 - 1.2 * 3.5], [4, 0, 10]]))


def test_stop_pair_conserves_momentum_and_respects_frozen_axes() -> None:
    """25 kg at 7 m/s meet 10 kg at rest: both go on at 5 m/s; friction cannot lift a frozen axis."""
    a, b = np.array([[7.0, 2.0, 0.0]]), np.zeros((1, 3))
    normal, mass_a = np.array([[-1.0, 0, 0]]), np.full(3, 1 / 25)
    impulse = ground.stop_pair(a, b, normal, np.zeros(1), mass_a, np.array([0.1, 0, 0.1]))
    np.testing.assert_allclose(impulse, [50])
    np.testing.assert_allclose(a, [[5, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(b, [[5, 0, 0]], atol=1e-12)


def test_push_out_is_limited_to_ten_metres_a_second() -> None:
    np.testing.assert_allclose(ground.push_out(np.array([0.1, -0.1, -1.0])), [0, 0.08, 0.2])
