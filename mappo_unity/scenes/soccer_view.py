"""What soccer's agents see: sphere casts in a plane against ball, agents, walls, nets and posts.

In: the bodies and headings of a field. Out: frames of ray sensors. Knows no rules and no stacks.
Facts: docs/scenes/SoccerTwos.md. All casts run level at a height of 1 m, so they are casts of a disc of 0.5 m
among upright shapes: ball and agents, whose centres are 0.5 m lower, are met at sqrt((R + 0.5)^2 - 0.5^2),
walls at their inner faces and, where these end in the open, at their edges.
Legend: n agents that look, R rays, B bodies of a field, C edges, P walls.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mappo_unity.scenes.rays import Faces, RaySensor, cast_spheres
from mappo_unity.scenes.soccer_physics import AGENT_RADIUS, BALL_RADIUS, SoccerPhysics
from mappo_unity.scenes.soccer_pitch import (
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
TOUCH = 0.01  # m: a wall nearer than this at the start is not reported
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
                length=20.0,
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
        self._sensors = [view.sensors() for view in views]
        self._angles = [np.concatenate([eyes.angles for eyes in sensors]) for sensors in self._sensors]
        walls = list(_walls(physics.pitch.blue_closed))
        self._walls = Faces(np.array([wall.begin for wall in walls]), np.array([wall.end for wall in walls]))
        self._num_walls = len(walls)
        owned = [(edge, number) for number, wall in enumerate(walls) for edge in wall.edges]
        self._edges, self._owner = np.array([edge for edge, _ in owned]), np.array([n for _, n in owned])
        radius = np.array([BALL_RADIUS] + [AGENT_RADIUS] * len(agent_tags))
        self._reach = np.full(len(radius) + len(owned), CAST_RADIUS)  # bodies, edges
        self._reach[: len(radius)] = np.sqrt((radius + CAST_RADIUS) ** 2 - CAST_HEIGHT**2)
        tags = ["ball", *agent_tags, *(walls[owner].tag for _, owner in owned), *(wall.tag for wall in walls)]
        self._tags = [
            np.array([view.tags.index(tag) if tag in view.tags else -1 for tag in tags]) for view in views
        ]

    def frames(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return one frame float32 [n, R * (tags + 2)] a sensor of `slots` [n], agents of `behavior`."""
        field, agent = np.divmod(slots, len(self._yaw))
        position = self._physics.position
        heading = self._yaw[agent, field][:, None] + self._angles[behavior]
        direction = np.stack([np.sin(heading), np.cos(heading)], axis=-1)[:, :, None]
        distance = self._cast(position[:, 1 + agent, field].T, direction, position[:, :, field].T)
        sensors = self._sensors[behavior]
        encoded = sensors[0].encode(distance, self._tags[behavior]).reshape(len(slots), -1)
        frames, first = [], 0
        for eyes in sensors:
            frames.append(encoded[:, first : first + eyes.size])
            first += eyes.size
        return frames

    def _cast(self, origin: np.ndarray, direction: np.ndarray, bodies: np.ndarray) -> np.ndarray:
        """Return distances in m, inf where nothing is met, [n, R, B + C + P]: bodies, edges, walls.

        `origin` [n, 2]; unit `direction` [n, R, 1, 2]; `bodies` [n, B, 2]. A wall that the caster touches
        is not seen at all; its edges are edges of the same collider.
        """
        num_bodies, num_discs = bodies.shape[1], len(self._reach)
        discs = np.empty((len(origin), 1, num_discs, 2))
        discs[:, 0, :num_bodies] = bodies
        discs[:, 0, num_bodies:] = self._edges
        distance = np.empty((*direction.shape[:2], num_discs + self._num_walls))
        origin = origin[:, None, None]
        distance[:, :, :num_discs] = cast_spheres(origin, direction, discs, self._reach)
        distance[:, :, num_discs:] = self._walls.cast(origin, direction, CAST_RADIUS)
        touched = self._walls.touches(origin, CAST_RADIUS + TOUCH)[:, 0]
        row, wall = np.nonzero(touched)
        if row.size:
            distance[row, :, num_discs + wall] = np.inf
            row, edge = np.nonzero(touched[:, self._owner])
            distance[row, :, num_bodies + edge] = np.inf
        return distance


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
