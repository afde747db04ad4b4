"""Walker: a figure of 16 parts walks towards a target at a given speed.

Facts: docs/scenes/Walker.md. One agent an area. The *cube* is a frame at the hips whose z axis points
horizontally at the target; it is an imaginary body, and the target a real one.
Legend: N areas = slots, B = 16 parts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Parameter, Sensor
from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.physics import WalkerPhysics

MAX_SPEED = 10.0  # m/s: largest goal speed, and the one before the first episode
MIN_SPEED = 0.1
TARGET_ANCHOR = (0.0, 1.0, 1.0)  # m
TARGET_RADIUS = 9.0  # m: the target appears at the anchor's height, above a point of this sphere
TARGET_FALL = 5.0  # m below its anchor
PLATFORM_HALF = 12.5  # m

_NAMES = [part.name for part in body.PARTS]
_JOINTED = np.array([_NAMES.index(name) for name in body.JOINTS])
_PARENTS = np.array([_NAMES.index(body.PARTS[i].parent) for i in _JOINTED])
_HEAD = _NAMES.index("head")
_NUM_COLUMNS = 15  # of a part: contact 1, velocity 3, spin 3, position 3, rotation 4, strength 1
_COLUMNS = np.array(
    [
        number * _NUM_COLUMNS + column
        for number, name in enumerate(_NAMES)
        for column in range(_NUM_COLUMNS if name in body.JOINTS else 10)
    ]
)

ACTION_ORDER = (
    *(("chest", axis) for axis in "XYZ"),
    *(("spine", axis) for axis in "XYZ"),
    *(("thighL", axis) for axis in "XY"),
    *(("thighR", axis) for axis in "XY"),
    ("shinL", "X"),
    ("shinR", "X"),
    *(("footR", axis) for axis in "XYZ"),
    *(("footL", axis) for axis in "XYZ"),
    *(("armL", axis) for axis in "XY"),
    *(("armR", axis) for axis in "XY"),
    ("forearmL", "X"),
    ("forearmR", "X"),
    *(("head", axis) for axis in "XY"),
)
"""(part, axis) of the joint target that each of the first 26 actions sets; the strengths follow."""

_LIMITS = {(name, axis): (low, high) for name in body.JOINTS for axis, _, low, high in body.joint_axes(name)}
_LOW, _HIGH = np.radians([_LIMITS[hinge] for hinge in body.HINGES]).T
_TARGET_ACTION = np.array([ACTION_ORDER.index(hinge) for hinge in body.HINGES])
_STRENGTH_OF_HINGE = np.array([list(body.JOINTS).index(part) for part, _ in body.HINGES])


class Walker(Scene):
    """Run Walker; parameter `gravity` (m/s^2, downward)."""

    NAME = "Walker"
    DEFAULT_NUM_AREAS = 10
    BEHAVIORS = (Behavior("Walker?team=0", (Sensor("VectorSensor_size243", (243,)),), continuous=39),)
    TAKE_ACTIONS_BETWEEN_DECISIONS = False
    MAX_STEP = 5000
    PARAMETERS = {"gravity": Parameter(14.715, at_once=True)}

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.physics = WalkerPhysics(self.num_areas, self.num_threads)
        self.physics.set_gravity(self.parameters["gravity"])

        self.goal_speed = np.full(self.num_areas, MAX_SPEED)
        self.cube_position = self.physics.position[:, 0].copy()
        self.cube_forward = np.tile([0.0, 0.0, 1.0], (self.num_areas, 1))

        self.strength = np.zeros((self.num_areas, len(body.JOINTS)))  # share of the largest force limit
        self.grounded = np.zeros((self.num_areas, len(body.PARTS)), bool)  # the contact flags
        self.touching = np.zeros_like(self.grounded)  # what touches the ground, whatever the flags say

    def fixed_update(self) -> None:
        """Aim the cubes, then reward matching the goal's velocity times looking at the target."""
        self._aim(np.arange(self.num_areas))

        goal = self.goal_speed[:, None] * self.cube_forward
        miss = np.linalg.norm(goal - self.physics.velocity.mean(axis=1), axis=1)
        match = (1 - np.minimum(miss / self.goal_speed, 1) ** 2) ** 2

        look = (np.einsum("ni,ni->n", self.cube_forward, forward(self.physics.rotation[:, _HEAD])) + 1) / 2
        self.agents.reward += match * look

    def begin_episode(self, slots: np.ndarray) -> None:
        """Stand up, turned at random, with a new goal speed; the target and the drives stay."""
        if not self.started:
            self._place_targets(slots)

        self.physics.stand(slots, np.radians(self.rng.uniform(0, 360, len(slots))))
        self.grounded[slots] = False
        self._aim(slots)
        self.goal_speed[slots] = self.rng.uniform(MIN_SPEED, MAX_SPEED, len(slots))

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the goal's and the parts' motion in the cube's frame (docs/scenes/Walker.md lists all)."""
        obs = np.empty((len(slots), 243), np.float32)
        ahead, rotation = self.cube_forward[slots], self.physics.rotation[slots]
        velocity, goal_speed = self.physics.velocity[slots], self.goal_speed[slots]

        mean = velocity.mean(axis=1)
        obs[:, 0] = np.linalg.norm(goal_speed[:, None] * ahead - mean, axis=1)
        obs[:, 1:4] = in_frame(ahead, mean)

        # in the cube's frame the goal's velocity is straight ahead
        obs[:, 4:6] = 0
        obs[:, 6] = goal_speed
        obs[:, 7:11] = shortest_rotation(forward(rotation[:, 0]), ahead)
        obs[:, 11:15] = shortest_rotation(forward(rotation[:, _HEAD]), ahead)
        obs[:, 15:18] = in_frame(ahead, self.physics.target_position[slots] - self.cube_position[slots])

        # a row of 15 numbers for each part; `_COLUMNS` leaves out those of joints that are not there
        parts = np.zeros((len(slots), len(_NAMES), _NUM_COLUMNS), np.float32)
        position = self.physics.position[slots]
        parts[:, :, 0] = self.grounded[slots]
        for column, vectors in (
            (1, velocity),
            (4, self.physics.spin[slots]),
            (7, position - position[:, :1]),
        ):
            parts[:, :, column : column + 3] = in_frame(ahead[:, None], vectors)

        parts[:, _JOINTED, 10:14] = relative_rotation(rotation[:, _PARENTS], rotation[:, _JOINTED])
        parts[:, _JOINTED, 14] = self.strength[slots]

        obs[:, 18:] = parts.reshape(len(slots), -1)[:, _COLUMNS]
        return [obs]

    def act(self, slots: np.ndarray) -> None:
        """Set the joints' target angles and strengths, in ticks of a decision only."""
        action = self.agents.continuous[slots].astype(np.float64)
        share = np.clip((action[:, _TARGET_ACTION] + 1) / 2, 0, 1)
        self.physics.drive_target[slots] = _LOW + share * (_HIGH - _LOW)

        self.strength[slots] = (action[:, 26:] + 1) / 2
        self.physics.drive_on[slots] = self.strength[slots][:, _STRENGTH_OF_HINGE] > 0

    def simulate(self) -> None:
        """Advance one tick; move targets that were touched; end episodes of those who fell."""
        self.physics.step()
        self._place_targets(np.flatnonzero(self.physics.target_touched() | self._targets_lost()))

        # a contact that outlasts a reset, which clears its flag, sets none until it begins anew
        touching = self.physics.ground_gap() <= body.CONTACT_GAP
        begun = touching & ~self.touching
        self.grounded = (self.grounded | begun) & touching
        self.touching = touching

        fallen = (begun & body.ENDS).sum(axis=1)
        for hits in (1, 2):  # the second hit of a tick sets -1 again, which the next record brings
            again = np.flatnonzero(fallen >= hits)
            if again.size:
                self.set_reward(again, -1.0)
                self.end_episode(again)

    def parameter_changed(self, name: str) -> None:
        """Apply gravity at once."""
        self.physics.set_gravity(self.parameters["gravity"])

    def scene_state(self) -> dict[str, Any]:
        """Return the physics, the cubes, the goal speeds, strengths and contacts."""
        return {"physics": self.physics.get_state(), **{name: getattr(self, name).copy() for name in _STATE}}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore `scene_state`."""
        self.physics.set_gravity(self.parameters["gravity"])
        self.physics.set_state(state["physics"])
        for name in _STATE:
            getattr(self, name)[...] = state[name]

    def _aim(self, slots: np.ndarray) -> None:
        """Turn cubes from where they were towards their targets, then move them to the hips."""
        way = self.physics.target_position[slots] - self.cube_position[slots]
        way[:, 1] = 0
        self.cube_forward[slots] = way / np.maximum(np.linalg.norm(way, axis=1), 1e-9)[:, None]
        self.cube_position[slots] = self.physics.position[slots, 0]

    def _place_targets(self, areas: np.ndarray) -> None:
        if areas.size:
            offset = self.rng.standard_normal((len(areas), 3))
            offset *= (TARGET_RADIUS * np.cbrt(self.rng.random(len(areas))) / np.linalg.norm(offset, axis=1))[
                :, None
            ]
            offset[:, 1] = 0  # the velocity is kept
            self.physics.target_position[areas] = TARGET_ANCHOR + offset

    def _targets_lost(self) -> np.ndarray:
        x, y, z = self.physics.target_position.T
        outside = (np.abs(x) > PLATFORM_HALF) | (np.abs(z) > PLATFORM_HALF)
        return outside | (y < TARGET_ANCHOR[1] - TARGET_FALL)


_STATE = ("goal_speed", "cube_position", "cube_forward", "strength", "grounded", "touching")


def forward(rotation: np.ndarray) -> np.ndarray:
    """Return the z axes [..., 3] of quaternions [..., 4] (w first)."""
    w, x, y, z = np.moveaxis(rotation, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def in_frame(ahead: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return vectors [..., 3] in the upright frame whose z axis is the horizontal unit vector `ahead`."""
    fx, fz = ahead[..., 0], ahead[..., 2]
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    return np.stack([x * fz - z * fx, y, x * fx + z * fz], axis=-1)


def shortest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return quaternions [n, 4] (x, y, z, w) that turn unit vectors `start` into `end` (FromToRotation).

    (start x end, 1 + start . end), normalised; half a turn about +y where they are opposite.
    """
    turn = np.empty((len(start), 4))
    turn[:, :3] = np.cross(start, end)
    turn[:, 3] = 1 + np.einsum("ni,ni->n", start, end)

    turn[turn[:, 3] < 1e-6] = (0, 1, 0, 0)
    return turn / np.linalg.norm(turn, axis=1, keepdims=True)


def relative_rotation(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """Return quaternions [..., 4] (x, y, z, w >= 0) of `child` in `parent`, both [..., 4] (w first)."""
    pw, px, py, pz = np.moveaxis(parent, -1, 0)
    cw, cx, cy, cz = np.moveaxis(child, -1, 0)

    local = np.stack(
        [
            pw * cx - px * cw - py * cz + pz * cy,
            pw * cy + px * cz - py * cw - pz * cx,
            pw * cz - px * cy + py * cx - pz * cw,
            pw * cw + px * cx + py * cy + pz * cz,
        ],
        axis=-1,
    )

    # a rotation has two quaternions: the one with w >= 0
    return np.where(local[..., 3:] < 0, -local, local)
