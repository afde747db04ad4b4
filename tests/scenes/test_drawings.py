"""Drawings: every scene has one, made of sound shapes that stand where the bodies stand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mappo_unity.errors import ConfigError
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.core.shapes import (
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    Camera,
    Follow,
    Kind,
    Shape,
    along,
    box,
    quaternion_rotation,
    yaw_rotation,
)
from mappo_unity.scenes.grid_food_collector.drawing import FROZEN_COLOR
from mappo_unity.scenes.registry import BUILT_IN, drawing_of


def played(name: str, decisions: int = 3) -> Any:
    scene: Any = make_scene(name, seed=1, num_areas=2)
    policy = RandomPolicy(1)
    scene.reset()
    for _ in range(decisions):
        for behavior, spec in scene.behavior_specs.items():
            steps, _ = scene.get_steps(behavior)
            if len(steps):
                scene.set_actions(behavior, policy.act(behavior, steps, spec))
        scene.step()
    return scene


def check_shape(shape: Shape) -> None:
    assert len(shape.size) == (3 if shape.kind in (Kind.box, Kind.ellipsoid) else 2)
    assert min(shape.size) > 0 and np.isfinite(shape.size).all() and np.isfinite(shape.position).all()
    assert shape.position.shape == (3,) and len(shape.color) == 4
    np.testing.assert_allclose(shape.rotation @ shape.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(shape.rotation) == pytest.approx(1)


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_scene_has_a_drawing_of_sound_shapes_in_its_view(name: str) -> None:
    scene, drawing = played(name), drawing_of(name)
    for area in (0, 1):
        shapes = drawing.shapes(scene, area)
        for shape in shapes:
            check_shape(shape)
        across, down, _ = in_picture(shapes, drawing.view(scene, area))
        seen = (np.abs(across) < 1) & (np.abs(down) < 1)
        if not isinstance(drawing.camera, Follow):
            assert seen.mean() > 0.95
    assert drawing.tick_s > 0


@pytest.mark.parametrize("name", BUILT_IN)
def test_agents_are_large_enough_to_be_seen(name: str) -> None:
    scene, drawing = played(name), drawing_of(name)
    agents = [
        shape
        for shape in drawing.shapes(scene, 1)
        if shape.color in (BLUE, PURPLE, FROZEN_COLOR) and (len(set(shape.size)) == 1 or name == "Walker")
    ]
    if isinstance(drawing.camera, Follow) and name != "Walker":
        agents = agents[:1]  # the others come and go
    across, down, pixels = in_picture(agents, drawing.view(scene, 1))
    assert (np.abs(across) < 0.95).all()
    assert (-0.95 < down).all() and (down < 0.87).all()  # above the caption
    height = np.ptp(down) * 544 / 2 if name == "Walker" else pixels * 2 * agents[0].size[1]
    assert np.min(height) > 17


@pytest.mark.parametrize(
    ("name", "x", "z"), [("GridFoodCollector", 49, 49), ("Pyramids", 49, 49), ("Hallway", 9, 24)]
)
def test_an_agent_in_a_corner_is_in_the_picture(name: str, x: float, z: float) -> None:
    camera = drawing_of(name).camera
    assert isinstance(camera, Follow)
    for corner in ((-x, 0.5, -z), (x, 0.5, -z), (-x, 0.5, z), (x, 0.5, z)):
        follow = replace(camera, place=lambda scene, area, at=corner: at)
        across, down, _ = in_picture([box(corner, (0.5, 0.5, 0.5), BLUE)], follow.view(None, 0))
        assert abs(across[0]) < 0.97 and -0.97 < down[0] < 0.87


def in_picture(shapes: list[Shape], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where shapes are in a picture of 960x544, -1 to 1 across and down, and pixels a metre."""
    yaw, pitch = np.radians([camera.yaw, camera.pitch])
    ahead = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    below = np.array([-np.sin(yaw) * np.sin(pitch), -np.cos(pitch), -np.cos(yaw) * np.sin(pitch)])
    offset = np.array([shape.position for shape in shapes]) - camera.target
    half = (offset @ ahead + camera.distance) * np.tan(np.radians(camera.field_of_view / 2))
    return offset @ right / half * 544 / 960, offset @ below / half, 544 / 2 / half


def test_shapes_follow_the_bodies() -> None:
    scene = played("3DBall")
    (ball,) = (shape for shape in drawing_of("3DBall").shapes(scene, 1) if shape.color == ORANGE)
    np.testing.assert_array_equal(ball.position, scene.ball_position[1])
    scene = played("GridFoodCollector")
    scene.frozen[1] = [True, False, False, True, False]
    shapes = drawing_of("GridFoodCollector").shapes(scene, 1)
    assert sum(shape.color == FROZEN_COLOR for shape in shapes) == 2
    food = np.array([shape.position for shape in shapes if shape.color == GREEN])
    np.testing.assert_array_equal(food, scene.physics.ball_position[:, 1, :25].T)


def test_rotations_are_unitys() -> None:
    ahead, right = np.array([0, 0, 1.0]), np.array([1.0, 0, 0])
    np.testing.assert_allclose(yaw_rotation(np.pi / 2) @ ahead, right, atol=1e-12)  # clockwise from above
    quarter = np.array([np.cos(np.pi / 4), 0, np.sin(np.pi / 4), 0])
    np.testing.assert_allclose(quaternion_rotation(2 * quarter) @ ahead, right, atol=1e-12)
    for way in ([1.0, 0, 0], [0, -2.0, 0], [1.0, 2.0, -3.0]):
        turn = along(np.array(way))
        np.testing.assert_allclose(turn @ [0, 1, 0], np.array(way) / np.linalg.norm(way), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)


def test_an_unknown_scene_has_no_drawing() -> None:
    with pytest.raises(ConfigError, match="no drawing of a scene '4DBall'; choices: 3DBall, Basic"):
        drawing_of("4DBall")


def test_in_pyramids_the_camera_looks_towards_what_the_agent_has_to_reach() -> None:
    scene = played("Pyramids")
    follow = drawing_of("Pyramids").camera
    assert isinstance(follow, Follow)
    scene.bodies.position[1] = (1.0, 0.5, 2.0)
    scene.bodies.switch_position[1] = (31.0, 2.0, 2.0)
    np.testing.assert_allclose(follow.place(scene, 1), (9.0, 0.0, 2.0))  # 8 m towards the switch
    scene.switch_on[1] = True
    scene.bricks.appear(np.array([1]), scene.brick_spot[1:])
    scene.bricks.bodies[1, -1, :3] = (1.0, 3.0, -8.0)
    np.testing.assert_allclose(follow.place(scene, 1), (1.0, 0.0, -2.0))  # two fifths of the way to the goal
