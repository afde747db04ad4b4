"""What soccer's agents see, on hand-placed bodies, against distances worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mappo_unity.scenes import make_scene
from mappo_unity.scenes.core.rays import cast_rectangles, cast_spheres
from mappo_unity.scenes.soccer.casts import Walls, cast_discs, first_met, numbered, unmet_discs
from mappo_unity.scenes.soccer.scene import PURPLE, SoccerScene, SoccerTwos, StrikersVsGoalie

BALL_REACH = np.sqrt(1.1241719**2 - 0.25)  # 1.007: radii of ball and cast, centres 0.5 m apart in height
AGENT_REACH = np.sqrt(0.75)
MISS = 6


def scene(name: str = "SoccerTwos") -> SoccerScene:
    """Return one field, everybody far from the middle and facing along z, the ball in a corner."""
    env = make_scene(name, num_areas=1)
    assert isinstance(env, SoccerScene)
    env.reset()
    field = np.zeros(1, np.int64)
    for body, (x, z) in enumerate(
        [(-13.0, 6.0), (-12.0, -5), (-10, -5), (-8, -5), (-6, -5)][: 1 + len(env.ROLES)]
    ):
        env.physics.place(body, field, x, z)
    env.yaw[:] = 0
    return env


def put(env: SoccerScene, body: int, x: float, z: float) -> None:
    env.physics.place(body, np.zeros(1, np.int64), x, z)


def rays(env: SoccerScene, slot: int) -> list[np.ndarray]:
    """Return the frames of a slot's sensors, [rays, tags + 2] each."""
    behavior = env.AREA_BEHAVIORS[slot]
    views = env.VIEWS[behavior].sensors()
    frames = env.observe(behavior, np.array([slot]))
    return [frame.reshape(eyes.num_rays, -1) for frame, eyes in zip(frames, views, strict=True)]


def seen(ray: np.ndarray) -> tuple[int, float]:
    """Return the tag (the number of tags: a miss, -1: not listed) and the distance in m."""
    hot = np.flatnonzero(ray[:-1])
    assert len(hot) <= 1 and set(ray[hot].tolist()) <= {1.0}
    return (int(hot[0]) if len(hot) else -1), float(ray[-1]) * 20


ANGLES = [0, 12, -12, 24, -24, 36, -36, 48, -48, 60, -60]


@pytest.mark.parametrize(("ray", "degrees"), list(enumerate(ANGLES)))
def test_forward_rays_alternate_right_first(ray: int, degrees: float) -> None:
    env = scene()
    put(env, 1, 0, 0)
    yaw = np.radians(30)
    env.yaw[0] = yaw
    put(env, 0, 5 * np.sin(yaw + np.radians(degrees)), 5 * np.cos(yaw + np.radians(degrees)))
    assert seen(rays(env, 0)[0][ray]) == (0, pytest.approx(5 - BALL_REACH, abs=1e-5))


@pytest.mark.parametrize(("ray", "degrees"), [(0, 180), (1, 225), (2, 135)])
def test_reverse_rays_look_back_left_first(ray: int, degrees: float) -> None:
    env = scene()
    put(env, 1, 0, 0)
    put(env, 0, 3 * np.sin(np.radians(degrees)), 3 * np.cos(np.radians(degrees)))
    assert seen(rays(env, 0)[1][ray]) == (0, pytest.approx(3 - BALL_REACH, abs=1e-5))


@pytest.mark.parametrize("slot", range(4))
def test_tags_are_own_and_opposing(slot: int) -> None:
    env = scene()
    assert isinstance(env, SoccerTwos)
    purple = env.ROLES[slot].team == PURPLE
    me, mate, foe = 1 + slot, 1 + (slot + 2) % 4, 1 + (slot + 1) % 4
    put(env, me, 0, 0)
    put(env, mate, 0, 4)
    assert seen(rays(env, slot)[0][0]) == (4, pytest.approx(4 - AGENT_REACH, abs=1e-5))
    put(env, mate, -9, 5)
    put(env, foe, 0, 4)
    assert seen(rays(env, slot)[0][0]) == (5, pytest.approx(4 - AGENT_REACH, abs=1e-5))
    env.yaw[slot] = np.pi / 2  # towards the purple goal
    assert seen(rays(env, slot)[0][0]) == (1 if purple else 2, pytest.approx(17.356 - 0.5, abs=1e-5))
    env.yaw[slot] = -np.pi / 2
    put(env, mate, -9, 6)
    assert seen(rays(env, slot)[0][0]) == (2 if purple else 1, pytest.approx(17.373 - 0.5, abs=1e-5))


def test_walls_misses_and_lateral_reach() -> None:
    env = scene()
    put(env, 1, 0, -1)
    assert seen(rays(env, 0)[0][0]) == (3, pytest.approx(8.508 - 0.5, abs=1e-5))
    env.yaw[0] = np.pi / 2
    put(env, 1, -6, 0)  # the purple goal is 23.356 m away
    assert seen(rays(env, 0)[0][0]) == (MISS, pytest.approx(20))
    put(env, 0, 0, BALL_REACH - 0.001)
    assert seen(rays(env, 0)[0][0])[0] == 0
    put(env, 0, 0, BALL_REACH + 0.001)
    assert seen(rays(env, 0)[0][0])[0] == MISS


def test_posts_and_corner_walls() -> None:
    env = scene()
    put(env, 1, 10, 4.15)
    env.yaw[0] = np.pi / 2  # along the line of a net's side: the corner wall comes first
    met = (15.4974 - 0.5 - 0.5 * 4.15) / np.sqrt(0.75)  # its face: 0.866 x + 0.5 z = 15.4974
    assert seen(rays(env, 0)[0][0]) == (3, pytest.approx(met - 10, abs=1e-3))
    put(env, 1, 12, 3.8)
    tag, distance = seen(rays(env, 0)[0][0])
    assert (tag, distance) == (1, pytest.approx(15.47 - np.sqrt(0.25 - 0.35**2) - 12, abs=1e-4))
    env.yaw[0] = np.radians(60)  # square to the middle of the corner wall, from 6 m
    middle = np.array([14.46, 6.41]) - 0.4607 / 2 * np.array([np.sqrt(0.75), 0.5])
    start = middle - 6 * np.array([np.sqrt(0.75), 0.5])
    put(env, 1, *start)
    assert seen(rays(env, 0)[0][0]) == (3, pytest.approx(5.5, abs=1e-4))


def test_what_the_caster_overlaps_is_not_seen() -> None:
    env = scene()
    put(env, 1, 0, 0)
    put(env, 3, 0, 0.8)  # nearer than 0.866
    put(env, 0, 0, 4)
    assert seen(rays(env, 0)[0][0]) == (0, pytest.approx(4 - BALL_REACH, abs=1e-5))
    put(env, 1, 0, 7.008)  # pressed against the wall: it is not reported, and nothing lies behind it
    assert seen(rays(env, 0)[0][0]) == (MISS, pytest.approx(20))
    put(env, 1, 0, 6.99)
    assert seen(rays(env, 0)[0][0]) == (3, pytest.approx(0.018, abs=1e-5))


def test_goalie_looks_around_and_does_not_list_itself_or_the_blue_goal() -> None:
    env = scene("StrikersVsGoalie")
    assert isinstance(env, StrikersVsGoalie)
    goalie = 1
    put(env, 1 + goalie, 0, 0)
    frame = rays(env, goalie)[0]
    assert frame.shape == (41, 6)
    for ray, degrees in ((1, 9), (2, -9), (20, -90), (39, 180), (40, -180)):
        put(env, 0, 4 * np.sin(np.radians(degrees)), 4 * np.cos(np.radians(degrees)))
        assert seen(rays(env, goalie)[0][ray]) == (0, pytest.approx(4 - BALL_REACH, abs=1e-5)), ray
    put(env, 0, 10, 5)
    assert seen(rays(env, goalie)[0][19]) == (1, pytest.approx(17.356 - 0.5, abs=1e-5))  # purple goal
    assert seen(rays(env, goalie)[0][20]) == (2, pytest.approx(15.01 - 0.5, abs=1e-5))  # the block: wall
    put(env, 1, 0, 3)
    assert seen(rays(env, goalie)[0][0]) == (3, pytest.approx(3 - AGENT_REACH, abs=1e-5))


def test_strikers_see_the_goalie_and_the_purple_goal() -> None:
    env = scene("StrikersVsGoalie")
    put(env, 1, 0, 0)
    env.yaw[0] = np.pi / 2
    assert seen(rays(env, 0)[0][0]) == (1, pytest.approx(17.356 - 0.5, abs=1e-5))
    put(env, 2, 4, 0)
    assert seen(rays(env, 0)[0][0]) == (4, pytest.approx(4 - AGENT_REACH, abs=1e-5))
    put(env, 3, 3, 0)
    assert seen(rays(env, 0)[0][0]) == (3, pytest.approx(3 - AGENT_REACH, abs=1e-5))


@pytest.mark.parametrize("name", ["SoccerTwos", "StrikersVsGoalie"])
def test_behaviors_seen_at_once_or_one_by_one_or_agent_by_agent(name: str) -> None:
    env = make_scene(name, num_areas=5, seed=2)
    assert isinstance(env, SoccerScene)
    env.reset()
    slots = env.agents.members
    for behavior, at_once in enumerate(env.observe_all(slots)):
        alone = env.observe(behavior, slots[behavior])
        single = [env.observe(behavior, slot) for slot in slots[behavior][:, None]]
        for sensor, frame in enumerate(at_once):
            assert np.array_equal(frame, alone[sensor])
            assert np.array_equal(frame, np.concatenate([each[sensor] for each in single]))


def test_walls_agree_with_boxes_seen_from_their_front() -> None:
    rng = np.random.default_rng(0)
    centre, half = np.array([3.0, 1.0]), np.array([0.25, 4.0])
    hits = 0
    for yaw in rng.uniform(-0.5, 0.5, 50):
        right, along = np.array([np.cos(yaw), -np.sin(yaw)]), np.array([np.sin(yaw), np.cos(yaw)])
        begin, end = centre - half[0] * right + half[1] * along, centre - half[0] * right - half[1] * along
        origin = rng.uniform(-2, 0, (20, 2))
        heading = rng.uniform(-1, 4, 20)
        direction = np.stack([np.sin(heading), np.cos(heading)], axis=-1)
        wall = Walls(begin[None], end[None], 0.5)
        way = wall.cast(wall.places(origin.T), direction.T)[0]
        box = cast_rectangles(origin, direction, 0.5, centre, half, yaw)
        met = way >= 0
        hits += int(met.sum())
        assert way[met] == pytest.approx(box[met], abs=1e-9)
        at = (origin + np.where(np.isfinite(box), box, 0)[..., None] * direction - centre) @ along
        assert np.isinf(box[~met]).all() or (np.abs(at[~met & np.isfinite(box)]) > half[1] - 1e-9).all()
    assert hits > 200


def test_touched_walls_and_their_ends() -> None:
    walls = Walls(np.array([[0.0, 0.0]]), np.array([[2.0, 0.0]]), radius=0.4)
    points = np.array([[1.0, -0.49], [1.0, 0.51], [2.3, 0.3], [2.4, 0.4], [-0.49, 0.0]])
    assert walls.touched(walls.places(points.T), 0.1)[0].tolist() == [True, False, True, False, True]


def test_cast_discs_agree_with_spheres_and_the_nearest_is_first() -> None:
    rng = np.random.default_rng(1)
    origin, centre = rng.uniform(-5, 5, (300, 1, 2)), rng.uniform(-5, 5, (8, 2))
    heading = rng.uniform(-4, 4, 300)
    direction = np.stack([np.sin(heading), np.cos(heading)])
    expected = cast_spheres(origin, direction.T[:, None], centre, 1.5).T
    towards = (centre - origin).transpose(2, 1, 0)
    way = cast_discs(towards, unmet_discs(towards, np.full((8, 1), 1.5)), direction)
    met = np.isfinite(expected)
    assert way[met] == pytest.approx(expected[met]) and not (way[~met] >= 0).any()
    some = met.any(axis=0)
    assert 100 < some.sum() < 300
    assert np.array_equal(first_met(way, numbered(8, 300))[some], expected.argmin(axis=0)[some])
