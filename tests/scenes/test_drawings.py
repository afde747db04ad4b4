"""Drawings: every scene has one, made of sound shapes that stand where the bodies stand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mappo_unity.config.schema import ConfigError
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.scenes import make_scene, scene_names
from mappo_unity.scenes.core.shapes import (
    GREEN,
    ORANGE,
    Kind,
    Shape,
    along,
    quaternion_rotation,
    yaw_rotation,
)
from mappo_unity.scenes.drawings import drawing_of
from mappo_unity.scenes.grid_food_collector.drawing import FROZEN_COLOR


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


@pytest.mark.parametrize("name", scene_names())
def test_every_scene_has_a_drawing_of_sound_shapes_in_its_view(name: str) -> None:
    scene, drawing = played(name), drawing_of(name)
    for area in (0, 1):
        shapes = drawing.shapes(scene, area)
        for shape in shapes:
            check_shape(shape)
        camera = drawing.camera(scene, area) if callable(drawing.camera) else drawing.camera
        yaw, pitch = np.radians([camera.yaw, camera.pitch])
        view = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
        offset = np.array([shape.position for shape in shapes]) - camera.target
        depth = offset @ view + camera.distance
        aside = np.linalg.norm(offset - np.outer(offset @ view, view), axis=1)
        half = np.tan(np.radians(camera.field_of_view / 2)) * 2.05  # to the corner of a picture of 16 : 9
        shares = (depth > 0) & (aside < half * depth)
        assert shares.mean() > (0.5 if name == "Walker" else 0.95)  # the walker's view goes with it
    assert drawing.tick_s > 0


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
