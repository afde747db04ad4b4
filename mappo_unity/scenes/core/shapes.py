"""What a drawing consists of: coloured primitive shapes and a camera.

They are plain descriptions, which a renderer turns into pictures. Unity's axes everywhere: x right, y up,
z forward, metres; left-handed, so a positive yaw turns clockwise seen from above.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

Color = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""


class Kind(Enum):
    """Form of a shape; the long axis of capsules and cylinders is their own y."""

    box = "box"
    """size: half-edges x, y, z."""
    ellipsoid = "ellipsoid"
    """size: half-axes x, y, z."""
    capsule = "capsule"
    """size: radius, half the length of the middle part."""
    cylinder = "cylinder"
    """size: radius, half the height."""


@dataclass(frozen=True)
class Shape:
    """Describe one shape in the frame of its area."""

    kind: Kind
    size: tuple[float, ...]
    """Metres; see `Kind`."""
    position: np.ndarray
    """[3], m: the middle."""
    rotation: np.ndarray
    """[3, 3]: its columns are the shape's own x, y, z axes."""
    color: Color
    shadow: bool = True
    """Whether it throws one: not what can be seen through, and floors and small parts need none."""


@dataclass(frozen=True)
class Camera:
    """Look at a point from a distance."""

    target: tuple[float, float, float]
    """The point, m."""
    distance: float
    """From the point, m."""
    yaw: float = 0.0
    """Heading of the view, degrees clockwise from forward (z) seen from above."""
    pitch: float = 30.0
    """How far the view points downwards, degrees."""
    field_of_view: float = 35.0
    """Vertical angle of the picture, degrees."""


@dataclass(frozen=True)
class Follow:
    """Go with the first agent of an area that is too large to be seen as a whole."""

    camera: Camera
    """The view; its target counts from the place of the agent."""
    place: Callable[[Any, int], Sequence[float] | np.ndarray]
    """Called as place(scene, area): where the agent is, [3], m."""
    reach: tuple[float, float] = (math.inf, math.inf)
    """The point looked at stays that close to the area's middle in x and z, m: outside is nothing to see."""

    def view(self, scene: Any, area: int) -> Camera:
        """Return the view of the agent where it is now."""
        target = np.add(self.place(scene, area), self.camera.target)
        target[[0, 2]] = np.clip(target[[0, 2]], np.negative(self.reach), self.reach)
        return replace(self.camera, target=tuple(target.tolist()))


@dataclass(frozen=True)
class Drawing:
    """How a scene is shown."""

    shapes: Callable[[Any, int], list[Shape]]
    """Called as shapes(scene, area): everything to be seen in that area now."""
    camera: Camera | Follow
    """A fixed view, or one that follows."""
    tick_s: float = 0.02
    """Seconds of video that a tick takes."""
    goals: bool = False
    """Whether blue (team 0) and purple (team 1) play for goals."""

    def view(self, scene: Any, area: int) -> Camera:
        """Return where the camera belongs now."""
        return self.camera.view(scene, area) if isinstance(self.camera, Follow) else self.camera


GREY: Color = (0.62, 0.64, 0.67, 1.0)
DARK: Color = (0.16, 0.17, 0.20, 1.0)
WHITE: Color = (0.95, 0.95, 0.95, 1.0)
FLOOR: Color = (0.80, 0.82, 0.85, 1.0)
LINE: Color = (0.72, 0.74, 0.78, 1.0)
"""Lines on the floor."""
WALL: Color = (0.47, 0.53, 0.62, 1.0)
BLUE: Color = (0.20, 0.45, 0.85, 1.0)
PURPLE: Color = (0.52, 0.30, 0.78, 1.0)
GREEN: Color = (0.25, 0.68, 0.35, 1.0)
RED: Color = (0.86, 0.27, 0.23, 1.0)
ORANGE: Color = (0.95, 0.58, 0.15, 1.0)
YELLOW: Color = (0.97, 0.83, 0.25, 1.0)
BROWN: Color = (0.55, 0.40, 0.28, 1.0)


def box(
    middle: Sequence[float] | np.ndarray,
    half: Sequence[float] | np.ndarray,
    color: Color,
    rotation: np.ndarray | None = None,
    shadow: bool = True,
) -> Shape:
    """Return a box; `half`: half-edges along its own axes."""
    return _shape(Kind.box, half, middle, rotation, color, shadow)


def ball(
    middle: Sequence[float] | np.ndarray,
    radius: float,
    color: Color,
    rotation: np.ndarray | None = None,
    shadow: bool = True,
) -> Shape:
    """Return a sphere."""
    return _shape(Kind.ellipsoid, (radius, radius, radius), middle, rotation, color, shadow)


def cylinder(
    middle: Sequence[float] | np.ndarray,
    radius: float,
    half_height: float,
    color: Color,
    rotation: np.ndarray | None = None,
) -> Shape:
    """Return a cylinder along its own y."""
    return _shape(Kind.cylinder, (radius, half_height), middle, rotation, color)


def capsule(
    middle: Sequence[float] | np.ndarray,
    radius: float,
    half_length: float,
    color: Color,
    rotation: np.ndarray | None = None,
) -> Shape:
    """Return a capsule along its own y; `half_length` leaves out the round ends."""
    return _shape(Kind.capsule, (radius, half_length), middle, rotation, color)


def square_walls(
    half_x: float,
    half_z: float,
    height: float,
    thickness: float,
    color: Color,
    middle: Sequence[float] = (0, 0, 0),
) -> list[Shape]:
    """Return four walls around a rectangle of inner half-widths `half_x`, `half_z`, standing on `middle`."""
    x, y, z = middle
    y, half = y + height / 2, thickness / 2
    long = (half_x + thickness, height / 2, half)
    short = (half, height / 2, half_z)
    return [
        box((x, y, z + half_z + half), long, color),
        box((x, y, z - half_z - half), long, color),
        box((x + half_x + half, y, z), short, color),
        box((x - half_x - half, y, z), short, color),
    ]


def floor_lines(half: float, spacing: float, width: float, color: Color, top: float = 0.0) -> list[Shape]:
    """Return lines on a square floor of half-width `half` m: they show how fast what is followed moves."""
    ends = half - half % spacing
    lines = np.arange(-ends, ends + spacing / 2, spacing)
    along_z = [box((x, top, 0), (width / 2, 0.004, half), color, shadow=False) for x in lines]
    # Not as high as the others: what has two surfaces at one place is lit twice.
    along_x = [box((0, top, z), (half, 0.002, width / 2), color, shadow=False) for z in lines]
    return along_z + along_x


def agent_cube(
    middle: Sequence[float] | np.ndarray, half: float, yaw: float, color: Color, headband: bool = False
) -> list[Shape]:
    """Return an agent as Unity draws it: a cube with two eyes; `yaw` in rad."""
    middle, turn = np.asarray(middle, float), yaw_rotation(yaw)
    shapes = [box(middle, (half, half, half), color, turn)]

    for side in (-1, 1):
        eye = middle + turn @ (half * np.array([0.42 * side, 0.35, 0.98]))
        pupil = middle + turn @ (half * np.array([0.42 * side, 0.35, 1.10]))
        shapes += [ball(eye, 0.26 * half, WHITE, shadow=False)]
        shapes += [ball(pupil, 0.16 * half, DARK, shadow=False)]

    if headband:
        band = middle + turn @ (half * np.array([0.0, 0.78, 0.0]))
        shapes.append(box(band, (1.03 * half, 0.12 * half, 1.03 * half), WHITE, turn, shadow=False))
    return shapes


def yaw_rotation(yaw: float) -> np.ndarray:
    """Return the rotation [3, 3] by `yaw` rad clockwise seen from above."""
    sin, cos = np.sin(yaw), np.cos(yaw)
    return np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def quaternion_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion w, x, y, z (MuJoCo's order)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def along(direction: np.ndarray) -> np.ndarray:
    """Return a rotation [3, 3] that turns the y axis into `direction` [3]."""
    y = np.asarray(direction, float) / np.linalg.norm(direction)
    helper = np.array([1.0, 0.0, 0.0]) if abs(y[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
    x = np.cross(y, helper)
    x /= np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def faded(color: Color, opacity: float) -> Color:
    """Return `color` with another opacity."""
    return (*color[:3], opacity)


def _shape(
    kind: Kind,
    size: Sequence[float] | np.ndarray,
    middle: Sequence[float] | np.ndarray,
    rotation: np.ndarray | None,
    color: Color,
    shadow: bool = True,
) -> Shape:
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    sizes, shadow = tuple(float(part) for part in size), shadow and color[3] == 1
    return Shape(kind, sizes, np.asarray(middle, float), turn, color, shadow)
