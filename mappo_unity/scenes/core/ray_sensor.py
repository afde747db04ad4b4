"""A ray sensor of Unity ML-Agents: where its rays go, and what an observation of them holds.

The casts are those of `rays.py`. Rules: sensors of the component "RayPerceptionSensor" (alternating order,
right first).

    eyes = RaySensor(tags=5, rays_per_side=2, max_degrees=70, length=12)
    sensor = eyes.sensor("RayPerceptionSensor", stack=3)              # in the behavior
    origin, direction = eyes.casts(position, yaw)                     # [N, 1, 1, 3], [N, R, 1, 3]
    balls = cast_spheres(origin, direction, centres[:, None], radii + eyes.cast_radius)
    walls = cast_upright_boxes(origin, direction, eyes.cast_radius, wall_centres, wall_halves, wall_yaws)
    frame = eyes.encode(np.concatenate([balls, walls], axis=2), tags)  # float32 [N, eyes.size]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mappo_unity.scenes.core.specs import Sensor


@dataclass(frozen=True)
class RaySensor:
    """Describe a ray sensor (RayPerceptionSensorComponent3D); lengths in m, angles in degrees."""

    tags: int
    """Number of detectable tags."""
    rays_per_side: int = 3
    """Rays on each side, besides the one ahead."""
    max_degrees: float = 70.0
    """Angle of the outermost rays."""
    length: float = 20.0
    """Ray length."""
    radius: float = 0.5
    """Radius of the cast sphere, before scaling by the effective length."""
    start_offset: float = 0.0
    """Height of the start above the agent."""
    end_offset: float = 0.0
    """Height of the end above the agent (not above the start)."""
    turn_degrees: float = 0.0
    """Yaw of the sensor's object relative to the agent (180: a sensor that looks back)."""

    @property
    def num_rays(self) -> int:
        """Return the number of rays."""
        return 2 * self.rays_per_side + 1

    @property
    def size(self) -> int:
        """Return the length of one frame: tags, miss flag and distance a ray."""
        return self.num_rays * (self.tags + 2)

    @property
    def cast_length(self) -> float:
        """Return the distance from start to end, by which distances are divided."""
        return float(np.hypot(self.length, self.end_offset - self.start_offset))

    @property
    def cast_radius(self) -> float:
        """Return the radius of the cast sphere."""
        return self.radius * self.cast_length / self.length

    @cached_property
    def angles(self) -> np.ndarray:
        """Return the rays' angles in rad, right positive: 0, d, -d, 2d, -2d, ... in the agent's frame."""
        step = np.arange(1, self.rays_per_side + 1) * self.max_degrees / self.rays_per_side
        return np.radians(np.concatenate([[0.0], np.stack([step, -step], 1).ravel()]) + self.turn_degrees)

    def sensor(self, name: str, stack: int = 1) -> Sensor:
        """Return the declaration of the sensor for a behavior."""
        return Sensor(name, (self.size,), stack)

    def casts(self, position: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return origins [N, 1, 1, 3] and unit directions [N, R, 1, 3] of the rays.

        `position`: agents' origins [N, 3], x right, y up, z forward. `yaw`: [N] rad, clockwise from above.
        """
        heading = yaw[:, None] + self.angles
        # A ray's end is `length` away on the level, and higher or lower than its start.
        level, rise = self.length / self.cast_length, (self.end_offset - self.start_offset) / self.cast_length
        direction = np.empty((*heading.shape, 1, 3))
        direction[:, :, 0, 0] = np.sin(heading) * level
        direction[:, :, 0, 1] = rise
        direction[:, :, 0, 2] = np.cos(heading) * level
        origin = position + (0.0, self.start_offset, 0.0)
        return origin[:, None, None], direction

    def encode(self, distance: np.ndarray, tags: np.ndarray) -> np.ndarray:
        """Return one frame, float32 [N, size]: a ray's tag one-hot, 1 if it missed, distance / length.

        `distance` [N, R, M] m; `tags` int [M] or [N, M]: the index of each collider's tag, -1: not listed.
        """
        count, rays, colliders = distance.shape
        frame = np.zeros((count, rays, self.tags + 2), np.float32)

        nearest = distance.argmin(axis=2)
        travelled = np.take_along_axis(distance, nearest[..., None], 2)[..., 0] / self.cast_length
        hit = travelled <= 1.0
        frame[..., -1] = np.where(hit, travelled, 1.0)
        frame[..., -2] = ~hit

        # A collider without a listed tag hides what is behind it: its distance counts, it sets no tag.
        tag = np.broadcast_to(tags, (count, colliders))[np.arange(count)[:, None], nearest]
        listed = hit & (tag >= 0)
        agent, ray = np.nonzero(listed)
        frame[agent, ray, tag[listed]] = 1.0
        return frame.reshape(count, -1)
