"""Sphere casts against hand-placed colliders and against slow, independent sphere tracing."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.core.rays import (
    cast_boxes,
    cast_capsules,
    cast_rectangles,
    cast_spheres,
    cast_upright_boxes,
    flat_radius,
)

ORIGIN, AHEAD = np.zeros(3), np.array([0.0, 0, 1])


def test_rays_alternate_right_first() -> None:
    eyes = RaySensor(tags=5, rays_per_side=2, max_degrees=70, length=12)
    assert np.degrees(eyes.angles).tolist() == pytest.approx([0, 35, -35, 70, -70])
    assert eyes.num_rays == 5 and eyes.size == 35
    assert eyes.sensor("RayPerceptionSensor", 3).spec().shape == (105,)
    _, direction = eyes.casts(np.zeros((1, 3)), np.zeros(1))
    assert direction[0, 1, 0].tolist() == pytest.approx([np.sin(np.radians(35)), 0, np.cos(np.radians(35))])
    _, direction = eyes.casts(np.zeros((1, 3)), np.array([np.pi / 2]))
    assert direction[0, 0, 0].tolist() == pytest.approx([1, 0, 0])  # yaw is clockwise: z turns to x


def test_sensor_that_looks_back() -> None:
    eyes = RaySensor(tags=6, rays_per_side=1, max_degrees=45, turn_degrees=180)
    _, direction = eyes.casts(np.zeros((1, 3)), np.zeros(1))
    half = np.sqrt(0.5)
    assert direction[0, :, 0, 0] == pytest.approx([0, -half, half])  # back, back-left, back-right
    assert direction[0, :, 0, 2] == pytest.approx([-1, -half, -half])


def test_offset_sensor_has_its_effective_length_and_radius() -> None:
    eyes = RaySensor(tags=3, length=20, start_offset=2.5, end_offset=5)
    assert eyes.cast_length == pytest.approx(20.156, abs=5e-4)
    assert eyes.cast_radius == pytest.approx(0.504, abs=5e-4)
    origin, direction = eyes.casts(np.array([[1.0, 2.0, 3.0]]), np.zeros(1))
    assert origin[0, 0, 0].tolist() == [1, 4.5, 3]
    assert np.degrees(np.arcsin(direction[0, 0, 0, 1])) == pytest.approx(7.1, abs=0.05)


def test_spheres() -> None:
    def cast(*centre: float) -> float:
        return float(cast_spheres(ORIGIN, AHEAD, np.array(centre), 1.0))

    assert cast(0, 0, 5) == 4
    assert cast(0.6, 0, 5) == pytest.approx(4.2)  # 5 - sqrt(1 - 0.36)
    assert cast(0, 0.8, 5) == pytest.approx(4.4)
    assert cast(1.01, 0, 5) == np.inf and cast(0, 0, -5) == np.inf
    assert cast(0, 0, 0.9) == np.inf  # overlapped at the start
    assert cast_spheres(ORIGIN, AHEAD, np.array([0, 0, 1.01]), 1.0, skip_gap=0.02) == np.inf


def test_capsules() -> None:
    def cast(x: float, y: float, z: float) -> float:
        low, high = np.array([x, y - 1, z]), np.array([x, y + 1, z])
        return float(cast_capsules(ORIGIN, AHEAD, 0.5, low, high, 0.5))

    assert cast(0, 0, 5) == pytest.approx(4)
    assert cast(0.6, 0.9, 5) == pytest.approx(4.2)
    assert cast(0, 1.6, 5) == pytest.approx(4.2)  # the lower cap's centre is 0.6 above the ray
    assert cast(0, 2.1, 5) == np.inf and cast(0, 0, 0.5) == np.inf
    lying = cast_capsules(ORIGIN, AHEAD, 0.5, np.array([0, 0, 3.0]), np.array([0, 0, 6.0]), 0.25)
    assert lying == pytest.approx(2.25)


def test_boxes() -> None:
    half = np.array([1.0, 1.0, 1.0])

    def cast(x: float, y: float, z: float, yaw: float = 0.0) -> float:
        return float(cast_upright_boxes(ORIGIN, AHEAD, 0.5, np.array([x, y, z]), half, yaw))

    assert cast(0, 0, 5) == pytest.approx(3.5)
    assert cast(0.99, 0.99, 5) == pytest.approx(3.5)
    assert cast(1.3, 0, 5) == pytest.approx(4 - 0.4)  # a vertical edge 0.3 aside: sqrt(0.25 - 0.09)
    assert cast(1.2, 1.2, 5) == pytest.approx(4 - np.sqrt(0.25 - 0.08))  # a corner
    assert cast(1.4, 1.4, 5) == np.inf and cast(1.51, 0, 5) == np.inf and cast(0, 0, -5) == np.inf
    assert cast(0, 0, 5, np.pi / 4) == pytest.approx(5 - np.sqrt(2) - 0.5)
    assert cast(0, 0, 1.4) == np.inf  # overlapped at the start
    assert cast(1.3, 1.3, 1.3) == pytest.approx(
        0.3 - np.sqrt(0.25 - 0.18)
    )  # inside the larger box, outside the round


def test_boxes_turn_clockwise() -> None:
    """A bar along x, turned by 30 degrees to the right: its right end is at 3 (cos 30, -sin 30)."""
    half, right_end = np.array([3.0, 0.2, 0.01]), np.array([2.5, 0, -2.5 * np.tan(np.radians(30))])
    start = np.array([2.5, 0, -10.0])
    travel = cast_upright_boxes(start, AHEAD, 0.01, np.zeros(3), half, np.radians(30))
    assert travel == pytest.approx(10 + right_end[2], abs=0.05)
    flat = cast_rectangles(start[[0, 2]], AHEAD[[0, 2]], 0.01, np.zeros(2), half[[0, 2]], np.radians(30))
    assert flat == pytest.approx(travel)


def test_thin_plate_is_met_before_its_edge() -> None:
    """Hallway: a sphere at height 1.0 and a plate with its top at 0.55: sqrt(0.25 - 0.45^2) = 0.218 m."""
    plate, half = np.array([0, 0.5, 10.0]), np.array([2.0, 0.05, 2.0])
    start = np.array([0, 1.0, 0])
    assert cast_upright_boxes(start, AHEAD, 0.5, plate, half) == pytest.approx(8 - 0.2179, abs=1e-4)
    radius = flat_radius(0.5, np.array(1.0), np.array(0.45), np.array(0.55))
    flat = cast_rectangles(start[[0, 2]], AHEAD[[0, 2]], radius, plate[[0, 2]], half[[0, 2]])
    assert flat == pytest.approx(8 - 0.2179, abs=1e-4)
    over = flat_radius(0.5, np.array(1.1), np.array(0.45), np.array(0.55))
    assert cast_rectangles(start[[0, 2]], AHEAD[[0, 2]], over, plate[[0, 2]], half[[0, 2]]) == np.inf


def test_encoding() -> None:
    eyes = RaySensor(tags=2, rays_per_side=1, max_degrees=90, length=10)
    distance = np.array([[[4.0, 2.0, np.inf], [np.inf, np.inf, np.inf], [np.inf, 11.0, 10.0]]])
    frame = eyes.encode(distance, np.array([0, 1, -1]))
    assert frame.dtype == np.float32
    assert frame[0].tolist() == pytest.approx([0, 1, 0, 0.2, 0, 0, 1, 1, 0, 0, 0, 1])
    per_agent = eyes.encode(np.concatenate([distance, distance]), np.array([[0, 1, -1], [1, 0, 0]]))
    assert per_agent[1].tolist() == pytest.approx([1, 0, 0, 0.2, 0, 0, 1, 1, 1, 0, 0, 1])


def traced(origin: np.ndarray, direction: np.ndarray, half: np.ndarray, radius: float) -> np.ndarray:
    """March along the rays by the distance to the rounded box; slow and independent of the formulas."""

    def gap(travel: np.ndarray) -> np.ndarray:
        outside = np.maximum(np.abs(origin + travel[:, None] * direction) - half, 0)
        return np.linalg.norm(outside, axis=1) - radius

    travel = np.zeros(len(origin))
    for _ in range(3000):
        travel = np.minimum(travel + np.maximum(gap(travel), 0), 100)
    return np.where((gap(travel) < 1e-6) & (travel < 50), travel, np.inf)


@pytest.mark.parametrize("half", [(1.0, 1.0, 1.0), (0.2, 3.0, 8.0), (4.0, 0.05, 4.0)])
def test_boxes_against_tracing(half: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(1)
    size = np.array(half)
    origin = rng.uniform(-6, 6, (4000, 3))
    direction = (rng.uniform(-1.3, 1.3, (4000, 3)) * size) - origin  # many near misses
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    free = np.linalg.norm(np.maximum(np.abs(origin) - size, 0), axis=1) > 0.55
    origin, direction = origin[free], direction[free]
    exact, slow = cast_boxes(origin, direction, 0.5, size), traced(origin, direction, size, 0.5)
    clear = np.isfinite(exact) == np.isfinite(slow)
    assert clear.mean() > 0.998  # rays that graze: tracing does not settle them
    both = np.isfinite(exact) & np.isfinite(slow)
    assert both.sum() > 1000 and np.abs(exact[both] - slow[both]).max() < 1e-2
    assert np.quantile(np.abs(exact[both] - slow[both]), 0.99) < 1e-5


def test_rectangles_agree_with_boxes_on_horizontal_rays() -> None:
    rng = np.random.default_rng(2)
    origin = rng.uniform(-6, 6, (500, 1, 3)) * (1, 0, 1)
    heading, yaw = rng.uniform(-np.pi, np.pi, (500, 1)), rng.uniform(-np.pi, np.pi, 7)
    direction = np.stack([np.sin(heading), 0 * heading, np.cos(heading)], axis=-1)
    centre, half = rng.uniform(-6, 6, (7, 3)) * (1, 0, 1), rng.uniform(0.3, 3, (7, 3))
    solid = cast_upright_boxes(origin, direction, 0.5, centre, half, yaw, skip_gap=0.02)
    plane = [0, 2]
    flat = cast_rectangles(
        origin[..., plane], direction[..., plane], 0.5, centre[:, plane], half[:, plane], yaw, skip_gap=0.02
    )
    assert flat.shape == (500, 7)
    assert (np.isfinite(flat) == np.isfinite(solid)).all() and 200 < np.isfinite(flat).sum()
    hit = np.isfinite(flat)
    assert np.abs(flat[hit] - solid[hit]).max() < 1e-9
