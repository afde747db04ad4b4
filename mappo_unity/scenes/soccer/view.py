"""What soccer's agents see: sphere casts in a plane against ball, agents, walls, nets and posts.

Facts: docs/scenes/SoccerTwos.md. All casts run level at a height of 1 m, so they are casts of a disc of 0.5 m
among upright shapes: ball and agents, whose centres are 0.5 m lower, are met at sqrt((R + 0.5)^2 - 0.5^2),
walls at their inner faces and, where these end in the open, at their edges.
Legend: n agents that look, R rays, B bodies of a field, C edges, P walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mappo_unity.scenes.core.ray_sensor import RaySensor
from mappo_unity.scenes.soccer.casts import Walls, cast_discs, first_met, numbered, unmet_discs
from mappo_unity.scenes.soccer.physics import AGENT_RADIUS, BALL_RADIUS, SoccerPhysics
from mappo_unity.scenes.soccer.pitch import (
    BACK_X,
    BLOCK_X,
    BLOCK_Z,
    CORNER_END,
    CORNER_LENGTH,
    CORNER_NORMAL,
    CORNER_OFFSET,
    GOAL_FLOOR_Z,
    NET_LENGTH,
    NET_Z,
    POST_X,
    SIDE_Z,
)

CAST_RADIUS, CAST_HEIGHT = 0.5, 0.5  # m; the height above the centres of ball and agents
RAY_LENGTH = 20.0  # m
TOUCH = 0.01  # m: a wall nearer than this at the start is not reported
_BEYOND = np.nextafter(RAY_LENGTH, np.inf)  # m: what is met later is not met at all
FORWARD, REVERSE, AROUND = (5, 60.0, 0.0), (1, 45.0, 180.0), (20, 180.0, 0.0)
"""Rays on each side, angle of the outermost, and turn of the sensor, in degrees."""


@dataclass(frozen=True)
class View:
    """Describe what agents of a behavior see: fans of rays, one a sensor, and the tags that all list."""

    tags: tuple[str, ...]
    fans: tuple[tuple[int, float, float], ...] = (FORWARD, REVERSE)

    def sensors(self) -> list[RaySensor]:
        """Return the ray sensors, one a fan."""
        return [
            RaySensor(
                tags=len(self.tags),
                rays_per_side=rays,
                max_degrees=degrees,
                length=RAY_LENGTH,
                radius=CAST_RADIUS,
                start_offset=CAST_HEIGHT,
                end_offset=CAST_HEIGHT,
                turn_degrees=turn,
            )
            for rays, degrees, turn in self.fans
        ]


class SoccerView:
    """Cast the rays of the agents of all fields."""

    def __init__(
        self, physics: SoccerPhysics, yaw: np.ndarray, views: Sequence[View], agent_tags: Sequence[str]
    ) -> None:
        """`yaw`: the scene's array float64 [A, F]; `views`: one a behavior; `agent_tags`: one an agent."""
        self._physics, self._yaw = physics, yaw
        self._views = [_Rays(view) for view in views]

        walls = list(_walls(physics.pitch.blue_closed))
        self._walls = Walls(
            np.array([wall.begin for wall in walls]), np.array([wall.end for wall in walls]), CAST_RADIUS
        )

        owned = [(edge, number) for number, wall in enumerate(walls) for edge in wall.edges]
        self._edges = np.array([edge for edge, _ in owned]).T[:, :, None]  # [2, C, 1]
        self._owner = np.array([n for _, n in owned])

        radius = np.array([BALL_RADIUS] + [AGENT_RADIUS] * len(agent_tags))
        self._num_bodies, self._num_discs = len(radius), len(radius) + len(owned)
        self._reach = np.full((self._num_discs, 1), CAST_RADIUS)  # bodies, edges
        self._reach[: len(radius), 0] = np.sqrt((radius + CAST_RADIUS) ** 2 - CAST_HEIGHT**2)

        tags = ["ball", *agent_tags, *(walls[owner].tag for _, owner in owned), *(wall.tag for wall in walls)]
        self._columns = np.array([rays.columns(tags) for rays in self._views])

        self._layouts: dict[tuple[int, ...], _Layout] = {}

    def frames(self, slots: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
        """Return one frame float32 [n, R * (tags + 2)] a sensor, of `slots` [n] of each behavior.

        All in one go: what a cast costs depends little on the number of rays.
        """
        layout = self._layout(tuple(map(len, slots)))
        field, agent = np.divmod(np.concatenate(slots), len(self._yaw))

        heading = self._yaw[agent, field].take(layout.caster) + layout.angles
        travel = self._cast(agent, field, heading, layout.caster)

        nearest = first_met(travel, layout.number)

        # one of a ray's numbers says what it meets, the last one how far away
        numbers = np.zeros(layout.size, np.float32)
        numbers[layout.first + self._columns.take(layout.columns + nearest)] = 1.0

        share = travel.take(nearest * len(heading) + layout.every) / RAY_LENGTH
        numbers[layout.last] = np.minimum(share, 1.0)

        return [
            [numbers[begin:end].reshape(shape)[:, columns] for columns in sensors]
            for begin, end, shape, sensors in layout.blocks
        ]

    def _cast(
        self, agent: np.ndarray, field: np.ndarray, heading: np.ndarray, caster: np.ndarray
    ) -> np.ndarray:
        """Return travels [B + C + P + 1, R] of rays: to bodies, edges, walls, and to just beyond their ends.

        `agent`, `field` [n]: who casts; `heading` [R] rad; `caster` [R]: whose ray it is, 0 to n - 1. A
        wall that the caster touches is not seen at all; its edges are edges of the same collider.
        """
        bodies, discs = self._num_bodies, self._num_discs
        position = self._physics.position
        origin = position[:, 1 + agent, field]

        towards = np.empty((3, discs, len(agent)))  # x, z, and what is beyond the reach
        np.subtract(position.take(field, 2), origin[:, None], out=towards[:2, :bodies])
        np.subtract(self._edges, origin[:, None], out=towards[:2, bodies:])
        towards[2] = unmet_discs(towards[:2], self._reach)

        places = self._walls.places(origin)
        touched = self._walls.touched(places, TOUCH)
        np.putmask(places[0], touched | (places[0] < 0), np.nan)
        np.putmask(towards[2, bodies:], touched.take(self._owner, 0), np.inf)

        # up to here all is a caster's; from here on, a ray's
        towards, places = towards.take(caster, 2), places.take(caster, 2)

        direction = np.stack([np.sin(heading), np.cos(heading)])
        travel = np.empty((discs + places.shape[1] + 1, len(heading)))
        travel[:discs] = cast_discs(towards[:2], towards[2], direction)
        travel[discs:-1] = self._walls.cast(places, direction)
        travel[-1] = _BEYOND

        return travel

    def _layout(self, counts: tuple[int, ...]) -> _Layout:
        if counts not in self._layouts:
            self._layouts[counts] = _Layout(counts, self._views, self._columns.shape[1])
        return self._layouts[counts]


class _Rays:
    """The rays of an agent of one behavior: angles in rad, numbers a ray and in all, sensors' slices."""

    def __init__(self, view: View) -> None:
        sensors = view.sensors()
        self.tags = view.tags
        self.angles = np.concatenate([eyes.angles for eyes in sensors])
        self.numbers = len(view.tags) + 2

        ends = np.cumsum([eyes.size for eyes in sensors]).tolist()
        self.size = ends[-1]
        self.sensors = [slice(end - eyes.size, end) for end, eyes in zip(ends, sensors, strict=True)]

    def columns(self, tags: Sequence[str]) -> list[int]:
        """Return which of a ray's numbers is 1 when it meets a collider of `tags` first, or none at all.

        For tags that are not listed it is the last one, where the distance is put afterwards.
        """
        listed = [self.tags.index(tag) if tag in self.tags else self.numbers - 1 for tag in tags]
        return [*listed, self.numbers - 2]


class _Layout:
    """Where the numbers of all rays are, for some number of agents of each behavior.

    [R] each: `caster`, whose ray it is; `angles`, rad; `first` and `last` place of its numbers; `columns`,
    where the row of its behavior begins in a table of `num_columns` colliders; `every`, 0 to R - 1.
    `number` [colliders, R]: the colliders' numbers.
    `blocks`: a behavior's begin, end, shape, and slices of its sensors.
    """

    def __init__(self, counts: Sequence[int], views: Sequence[_Rays], num_columns: int) -> None:
        rays = [len(view.angles) for view in views]
        # rays stand behavior by behavior, then agent by agent
        behavior = np.repeat(np.arange(len(views)), np.multiply(counts, rays))

        numbers = np.array([view.numbers for view in views])[behavior]
        self.caster = np.repeat(np.arange(sum(counts)), np.repeat(rays, counts))
        self.angles = np.concatenate(
            [np.tile(view.angles, count) for view, count in zip(views, counts, strict=True)]
        )

        self.columns = behavior * num_columns
        self.every = np.arange(len(behavior))
        self.number = numbered(num_columns, len(behavior))

        # a ray's numbers: one for each tag, whether it missed, and last the distance
        self.size = int(numbers.sum())
        self.last = np.cumsum(numbers) - 1
        self.first = self.last - (numbers - 1)

        shapes = [(count, view.size) for count, view in zip(counts, views, strict=True)]
        ends = np.cumsum([count * size for count, size in shapes])

        self.blocks = [
            (end - shape[0] * shape[1], end, shape, view.sensors)
            for end, shape, view in zip(ends.tolist(), shapes, views, strict=True)
        ]


@dataclass(frozen=True)
class _Wall:
    """One collider: its inner face, the pitch to the right of the way from begin to end, and free edges."""

    tag: str
    begin: tuple[float, float]
    end: tuple[float, float]
    edges: tuple[tuple[float, float], ...] = ()


def _walls(blue_closed: bool) -> Iterator[_Wall]:
    """Yield the colliders of the pitch that level casts can meet."""
    (c, s), length = CORNER_NORMAL, CORNER_LENGTH
    edge = (c * CORNER_OFFSET + s * CORNER_END, s * CORNER_OFFSET - c * CORNER_END)  # (15.46, 4.216)

    for z in (-1.0, 1.0):
        yield _faced("wall", (-15.5, z * SIDE_Z), (15.5, z * SIDE_Z))
        for x in (-1.0, 1.0):
            free = (x * edge[0], z * edge[1])
            yield _faced("wall", (x * (edge[0] - s * length), z * (edge[1] + c * length)), free, free)

    for x, goal, post_x, back_x in zip((-1.0, 1.0), ("blueGoal", "purpleGoal"), POST_X, BACK_X, strict=True):
        if x < 0 and blue_closed:
            corners = ((-BLOCK_X, -BLOCK_Z), (-BLOCK_X, BLOCK_Z))
            yield _faced("wall", *corners, *corners)
            continue

        yield _faced(goal, (x * back_x, -GOAL_FLOOR_Z), (x * back_x, GOAL_FLOOR_Z))
        for z in (-NET_Z, NET_Z):
            yield _faced(goal, (x * post_x, z), (x * (post_x + NET_LENGTH), z), (x * post_x, z))


def _faced(
    tag: str, begin: tuple[float, float], end: tuple[float, float], *edges: tuple[float, float]
) -> _Wall:
    """Return a wall with the middle of the pitch to the right of its way."""
    if begin[0] * end[1] - begin[1] * end[0] > 0:  # the middle is to the left
        begin, end = end, begin
    return _Wall(tag, begin, end, edges)
