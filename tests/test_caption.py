"""What a video tells beside its pictures, and where its camera goes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.core.shapes import Camera, Drawing, Follow
from mappo_unity.scenes.registry import drawing_of
from mappo_unity.viewing.camera import LAG_S, MovingCamera
from mappo_unity.viewing.caption import Tally

Rows = dict[int, float]  # agent id -> reward


def steps(asked: Rows, ended: Rows | None = None, team: float = 0.0, interrupted: bool = False) -> Any:
    """Return the records of one behavior; `team` is the group reward of those that ended."""
    ended = ended or {}
    zeros, ids = np.zeros(len(asked), np.float32), np.array(list(asked), np.int32)
    reward = np.array(list(asked.values()), np.float32)
    decisions = DecisionSteps([], reward, ids, None, zeros.astype(int), zeros)
    reward, ids = np.array(list(ended.values()), np.float32), np.array(list(ended), np.int32)
    group, cut = np.full(ids.size, team, np.float32), np.full(ids.size, interrupted)
    return decisions, TerminalSteps([], reward, cut, ids, np.zeros(ids.size, int), group)


def test_the_return_so_far_is_the_mean_of_the_episode_that_runs() -> None:
    tally = Tally()
    assert tally.score() == ["return 0.00"]
    assert tally.add({"A": steps({1: 0.0, 2: 0.0})}) == {"A": [1, 2]}
    assert tally.add({"A": steps({1: 1.0, 2: 0.25})}) == {"A": []}
    assert tally.score() == ["return 0.62"]
    tally.add({"A": steps({1: 0.5}, {2: -0.25})})  # 2 leaves with 0: it counts until the episode is over
    assert tally.score() == ["return 0.75"] and tally.returns == [0.0]
    assert tally.add({"A": steps({3: 0.0, 4: 0.0}, {1: 0.5}, team=1.0)}) == {"A": [3, 4]}
    assert tally.score() == ["return 0.00", "last episode 1.50"] and tally.returns == [0.0, 3.0]
    tally.add({"A": steps({3: -250.0, 4: -0.002})})
    assert tally.score() == ["return -125", "last episode 1.50"]


def test_an_agent_that_goes_on_in_another_behavior_has_ended_its_episode() -> None:
    tally = Tally()
    tally.add({"A": steps({}), "B": steps({7: 0.0})})
    begun = tally.add({"A": steps({7: 0.0}), "B": steps({}, {7: 0.9})})
    assert begun == {"A": [7], "B": []} and tally.score() == ["return 0.00", "last episode 0.90"]


def test_the_caption_is_about_the_agent_that_is_followed() -> None:
    tally = Tally(agent=2)
    tally.add({"A": steps({1: 0.0, 2: 0.0})})
    tally.add({"A": steps({1: 5.0, 2: 1.0})})
    assert tally.score() == ["return 1.00"]
    tally.add({"A": steps({1: 5.0, 2: 0.0}, {2: 2.0})})
    assert tally.score() == ["return 0.00", "last episode 3.00"] and tally.returns == [3.0]


def test_goals_count_for_the_side_that_did_not_lose_and_a_time_limit_is_none() -> None:
    tally = Tally(goals=True)
    blue, purple = "SoccerTwos?team=0", "SoccerTwos?team=1"
    tally.add({purple: steps({1: 0, 2: 0}), blue: steps({3: 0, 4: 0})})
    assert tally.score() == ["blue 0 : 0 purple"]
    lost, won = steps({1: 0, 2: 0}, {1: 0, 2: 0}, -1.0), steps({3: 0, 4: 0}, {3: 0, 4: 0}, 0.7)
    tally.add({purple: lost, blue: won})
    assert tally.score() == ["blue 1 : 0 purple"]
    tally.add({purple: steps({1: 0, 2: 0}, {1: 0, 2: 0}, 0.4), blue: steps({3: 0}, {3: 0, 4: 0}, -1.0)})
    assert tally.score() == ["blue 1 : 1 purple"]
    late = steps({1: 0, 2: 0}, {1: 0, 2: 0}, -1.0, interrupted=True)
    tally.add({purple: late, blue: steps({3: 0}, {3: 0, 4: 0}, interrupted=True)})
    assert tally.score() == ["blue 1 : 1 purple"]


@pytest.mark.parametrize(
    ("name", "x", "score"),
    [
        ("SoccerTwos", 16.0, "blue 1 : 0 purple"),
        ("SoccerTwos", -16.0, "blue 0 : 1 purple"),
        ("StrikersVsGoalie", 16.0, "blue 1 : 0 purple"),
    ],
)
def test_goals_are_those_of_the_scene(name: str, x: float, score: str) -> None:
    scene: Any = make_scene(name, seed=0, num_areas=1)
    tally = Tally(drawing_of(name).goals)
    scene.reset()
    for step in range(12):
        records = {behavior: scene.get_steps(behavior) for behavior in scene.behavior_specs}
        tally.add(records)
        for behavior, (decisions, _) in records.items():
            count = len(decisions)
            empty = ActionTuple(np.zeros((count, 0), np.float32), np.zeros((count, 3), np.int32))
            scene.set_actions(behavior, empty)
        if step == 2:
            scene.physics.place(0, np.array([0]), np.array([np.sign(x) * 14.0]), np.zeros(1))
            scene.physics.velocity[0, 0, 0] = x
        scene.step()
    assert tally.score() == [score]


def moving(places: list[tuple[float, float]], episodes: list[int], reach: float = 100.0) -> np.ndarray:
    """Return where the camera looks, [n, 2] (x, z), while an agent goes through `places`, 0.04 s apart."""
    scene: Any = SimpleNamespace(agents=SimpleNamespace(step_count=np.zeros(1, int)), at=(0.0, 0.0))
    view = Camera((0.0, 1.0, 2.0), 10.0)
    follow = Follow(view, lambda scene, area: (scene.at[0], 0.0, scene.at[1]), (reach, reach))
    camera = MovingCamera(scene, Drawing(lambda *_: [], follow), 0.04)
    seen = []
    for place, steps_ in zip(places, episodes, strict=True):
        scene.at, scene.agents.step_count[0] = place, steps_
        seen.append(camera.view())
    assert all(camera.distance == 10.0 and camera.target[1] == 1.0 for camera in seen)
    return np.array([camera.target for camera in seen])[:, ::2]


def test_the_camera_follows_smoothly() -> None:
    start = moving([(0, 0)] * 3 + [(3, 0)] * 100, list(range(103)))
    assert start[:3].tolist() == [[0, 2]] * 3  # at once where the first episode begins
    way = np.diff(start[2:, 0])
    assert (way > 0).all() and (np.diff(way) < 0).all()  # no overshoot, no jerk
    assert start[3 + round(LAG_S / 0.04) - 1, 0] == pytest.approx(3 * (1 - np.exp(-1)), rel=1e-9)
    assert start[-1, 0] == pytest.approx(3, abs=1e-3)


def test_the_camera_cuts_to_where_a_new_episode_begins() -> None:
    seen = moving([(0, 0), (1, 0), (-30, 5), (-30, 5)], [10, 15, 0, 5])
    assert 0 < seen[1, 0] < 1
    assert seen[2:].tolist() == [[-30, 7], [-30, 7]]


def test_the_camera_stays_above_the_area() -> None:
    seen = moving([(0, 0), (50, -70)], [9, 0], reach=40.0)
    assert seen[1].tolist() == [40, -40]


def test_a_camera_that_follows_nobody_stands() -> None:
    scene, drawing = make_scene("Basic", seed=0, num_areas=1), drawing_of("Basic")
    camera = MovingCamera(scene, drawing, 0.1)
    assert camera.view() == camera.view() == drawing.camera
