"""The Walkers of all areas in motion: drives, poses, velocities and heights above the ground.

Arrays are by area and part, in the order of `body.PARTS`. Legend: N areas, B = 16 parts, J = 26 hinges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.physics import AreaPhysics
from mappo_unity.scenes.walker import body

DRAG_KEPT = 1.0 - 0.05 * body.TICK_S  # drag and angular drag of every part, 0.05/s each
PART_MAX_SPIN = 50.0  # rad/s: set by the parts' script; here of the hips and of every hinge
UNDRIVEN = 0.03  # share of its damping that a joint without a drive keeps; free, light parts are unstable
TARGET_MAX_SPIN = 7.0  # rad/s: the engine's limit for bodies that set none


def colliders() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the parts' colliders as boxes or segments with a radius, and their places at rest.

    Half extents [B, 3] m, radius [B] m, centre [B, 3] m in the part's frame, and the part's origin at rest
    [B, 3] m from the hips'.
    """
    names = [part.name for part in body.PARTS]
    half, centre, rest = (np.zeros((len(names), 3)) for _ in range(3))
    radius = np.zeros(len(names))

    for part in body.depth_first():
        number, (kind, radius_m, height) = names.index(part.name), part.collider
        radius[number] = radius_m
        if kind == "foot":
            half[number], centre[number] = body.FOOT_HALF, body.FOOT_CENTRE
        elif kind != "sphere":
            half[number, "xy".index(kind)] = height / 2 - radius_m

        if part.parent:
            rest[number] = rest[names.index(part.parent)] + part.offset

    return half, radius, centre, rest


_HALF, _RADIUS, _CENTRE, _REST = colliders()
_SHARE = np.array([body.JOINTS[part].share for part, _ in body.HINGES])
_STIFFNESS = _SHARE * body.STIFFNESS  # [J] N m / rad
_DAMPING = _SHARE * (body.DAMPING + body.TICK_S * body.STIFFNESS)  # [J] N m s / rad, of the implicit drive
_SWING = np.array(
    [i for i, (part, axis) in enumerate(body.HINGES) if axis == "Y" and not body.JOINTS[part].z]
)  # Y hinges of joints whose Z is locked: their drive acts about the parent's Y; X stands right before
_TWIST = _SWING - 1


class WalkerPhysics:
    """Step the figures and targets of N areas.

    Attributes, all float64, to be read and written in place:
    `position`, `velocity` (of the centre of mass), `spin` [N, B, 3], `rotation` [N, B, 4] (w first): the
    parts in world axes, as of the last `step` or `stand`;
    `angle` [N, J] rad (in the order of `HINGES`), `drive_target` [N, J] rad, `drive_on` [N, J] 0 or 1;
    `target_position` [N, 3] m.
    """

    def __init__(self, num_areas: int, num_threads: int) -> None:
        self._areas = AreaPhysics(body.area(), num_areas, num_threads=num_threads)
        # Its sensors show joints as poses: they are of the state before a step moves it.
        self._figures = AreaPhysics(body.area(kinematic=True), num_areas, num_threads=num_threads)
        # Views into the areas' own models: the drives write them in every tick.
        self._armatures = [self._areas.own_model(area)[0].dof_armature[6:32] for area in range(num_areas)]

        parts = len(body.PARTS)
        by_kind = np.split(self._figures.sensordata, np.cumsum([3 * parts, 4 * parts, 3 * parts]), axis=1)
        self.position, self.rotation, self.velocity, self.spin = (
            kind.reshape(num_areas, parts, -1) for kind in by_kind
        )

        self.angle = self._areas.qpos[:, 7:33]
        self.target_position = self._areas.qpos[:, 33:36]
        self.drive_target = np.zeros((num_areas, len(body.HINGES)))
        self.drive_on = np.ones((num_areas, len(body.HINGES)))

        self.find_poses()

    def step(self) -> None:
        """Advance one tick, and find all poses."""
        # Velocities: hips [0:6], hinges [6:32], target [32:38], whose drag acts on its spin only.
        self._areas.qvel[:, :32] *= DRAG_KEPT
        np.clip(self._areas.qvel[:, 3:32], -PART_MAX_SPIN, PART_MAX_SPIN, out=self._areas.qvel[:, 3:32])
        self._areas.qvel[:, 35:38] *= DRAG_KEPT

        spin = self._areas.qvel[:, 35:38]
        spin *= np.minimum(1, TARGET_MAX_SPIN / np.maximum(np.linalg.norm(spin, axis=1), 1e-9))[:, None]

        self._drive()
        self._areas.step()
        self.find_poses()

    def stand(self, areas: np.ndarray, yaw: np.ndarray) -> None:
        """Put figures into the start pose, turned by `yaw` [n] rad about +y, at rest; drives stay."""
        half = 0.5 * yaw
        turn = np.stack([np.cos(half), np.zeros_like(yaw), np.sin(half), np.zeros_like(yaw)], axis=1)

        self._areas.qpos[areas, :3] = body.HIPS_START
        self._areas.qpos[areas, 3:7] = turn
        self._areas.qpos[areas, 7:33] = 0
        self._areas.qvel[areas, :32] = 0

        # the parts' poses by hand: the first observation comes before the next step finds them
        s, c = np.sin(yaw)[:, None], np.cos(yaw)[:, None]
        x, y, z = _REST.T
        self.position[areas] = np.stack([x * c + z * s, y + 0 * c, z * c - x * s], axis=2) + body.HIPS_START
        self.rotation[areas] = turn[:, None]

        self.velocity[areas] = 0
        self.spin[areas] = 0

    def ground_gap(self) -> np.ndarray:
        """Return the distance between every part's collider and the ground, float64 [N, B] m."""
        w, x, y, z = np.moveaxis(self.rotation, 2, 0)
        up = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=2)

        centre = self.position[:, :, 1] + (up * _CENTRE).sum(axis=2)
        return centre - (np.abs(up) * _HALF).sum(axis=2) - _RADIUS - body.GROUND_Y

    def target_touched(self) -> np.ndarray:
        """Return in which areas a part touched the target in the last tick, bool [N]."""
        return self._areas.sensordata[:, 0] > 0

    def set_gravity(self, gravity: float) -> None:
        """Set the downward acceleration, m/s^2."""
        self._areas.set_gravity(gravity)

    def find_poses(self) -> None:
        """Recompute the parts' poses and velocities from the joints' after these were written."""
        self._figures.qpos[...] = self._areas.qpos[:, :33]
        self._figures.qvel[...] = self._areas.qvel[:, :32]
        self._figures.step()

    def get_state(self) -> dict[str, Any]:
        """Return copies of everything that changes."""
        return {
            "areas": self._areas.get_state(),
            "figures": self._figures.get_state(),
            "drive_target": self.drive_target.copy(),
            "drive_on": self.drive_on.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        self._areas.set_state(state["areas"])
        self._figures.set_state(state["figures"])
        self.drive_target[...] = state["drive_target"]
        self.drive_on[...] = state["drive_on"]

    def _drive(self) -> None:
        """Apply the drives: torque k (target - angle) - D rate, and armature h D, which makes it implicit.

        M (v' - v) = h (forces + k e - D v') with D = d + h k is the drive k (target - angle) - d v, solved
        implicitly; hence (M + h D) (v' - v) = h (forces + k e - D v), and h D is what an armature adds to M.
        A real armature instead of an implicit force lets the contacts feel it too.
        A swing drive acts about the parent's Y, of which the hinge's share is the cosine of the twist.
        """
        error = self.drive_target - self.angle
        twist = np.cos(self.angle[:, _TWIST])

        stiffness = _STIFFNESS * self.drive_on
        damping = _DAMPING * np.maximum(self.drive_on, UNDRIVEN)

        error[:, _SWING] = np.sin(error[:, _SWING])
        stiffness[:, _SWING] *= twist * np.cos(self.drive_target[:, _TWIST])
        damping[:, _SWING] *= twist * twist

        self._areas.qfrc_applied[:, 6:32] = stiffness * error - damping * self._areas.qvel[:, 6:32]

        # h D, the armature, of every area's own model
        damping *= body.TICK_S
        for armature, row in zip(self._armatures, damping, strict=True):
            armature[...] = row
