"""Where Pyramids' agent, switch and bricks may be."""

from __future__ import annotations

from typing import Any

import numpy as np

from scene_ranges.plan import passed
from scene_ranges.ranges import Ranges


def _pyramids_walls() -> np.ndarray:
    """Return the inner walls as x, z, half sizes along x and z, [16, 4]."""
    crosses = [
        (x, z, *half) for x in (-16.55, 16.55) for z in (-16.56, 16.56) for half in ((7.575, 0.5), (0.5, 7.5))
    ]
    sides = [(x, z, 7.25, 0.5) for x in (-42.25, 42.25) for z in (-16.5, 16.5)]
    return np.array([*crosses, *sides, *((z, x, 0.5, 7.25) for x, z, _, _ in sides)])


class Pyramids(Ranges):
    """Pyramids: nine things in a permutation of nine zones, each within 11.905 m of its zone's centre."""

    WALLS = _pyramids_walls()

    def __init__(self, scene: Any) -> None:
        super().__init__(scene)
        self.last = np.full((scene.num_areas, 2), np.nan)  # x, z a tick ago
        self.watch(scene.bricks, "appear", self._appeared)
        _ = scene.bricks._fall  # made when first needed: not a growth of memory

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check the zones and what stands in them."""
        scene, bodies = self.scene, self.scene.bodies
        agent, switch = bodies.position[rows], bodies.switch_position[rows]
        spots = np.concatenate(
            [
                agent[:, None, ::2],
                switch[:, None, ::2],
                scene.brick_spot[rows][:, None],
                bodies.stone_root[rows],
            ],
            axis=1,
        )
        zone = np.round(spots / 30)
        self.within("begin: things from their zone's centre, x, z", spots - 30 * zone, -11.905, 11.905)
        self.within("begin: zones of the agent, x", zone[:, 0, 0], -1, 1)
        taken = np.sort((zone + 1) @ (1, 3), axis=1)
        self.holds("every zone is taken once", (taken == np.arange(9)).all(axis=1))
        self.within("begin: agent y", agent[:, 1], 2, 2)
        self.within("begin: agent velocity", bodies.velocity[rows], 0, 0)
        degrees = np.degrees(bodies.yaw[rows])
        self.within("begin: agent yaw, degrees", degrees, 0, 359)
        self.within("begin: agent yaw beside whole degrees", degrees - np.round(degrees), 0, 0)
        self.within("begin: switch's box y", switch[:, 1], 4, 4)
        self.within("begin: switch yaw", bodies.switch_yaw[rows], 0, 0)
        self.holds("switch off, no bricks", ~(scene.switch_on[rows] | scene.bricks.present[rows]))
        self.last[rows] = np.nan

    def tick(self) -> None:
        """Check that agent and bricks are within the outer walls, and the agent not through inner ones.

        At 42 m/s an agent's centre may be 0.35 m past a face for a tick, as in DungeonEscape.
        """
        scene, bodies = self.scene, self.scene.bodies
        place = bodies.position[:, ::2]
        self.within("agent x", place[:, 0], -49.5 - 0.35, 49.5 + 0.35)
        self.within("agent z", place[:, 1], -49.6 - 0.35, 49.1 + 0.35)
        self.within("agent y", bodies.position[:, 1], 0.3, 2.0)
        self.within("switch's box y", bodies.switch_position[:, 1], 2.0, 4.0)
        self.holds("nobody passes through an inner wall", ~passed(self.last, place, self.WALLS[None]))
        self.last = place.copy()
        present = np.flatnonzero(scene.bricks.present)
        if present.size:
            cubes = scene.bricks.bodies[present]
            self.within("brick x", cubes[:, :, 0], -49.5, 49.5)
            self.within("brick y", cubes[:, :, 1], 0.4, 8.1)
            self.within("brick z", cubes[:, :, 2], -49.6, 49.1)
            length = np.einsum("nbi,nbi->nb", cubes[:, :, 3:], cubes[:, :, 3:])
            self.within("brick's quaternion, length squared", length, 1 - 1e-5, 1 + 1e-5)

    def _appeared(self, rows: np.ndarray, before: None) -> None:
        goal = self.scene.bricks.bodies[rows, -1, :3] - (0.45, 8.0, 0.8)
        self.within("bricks appear: goal's root x, z, from the spot", goal[:, ::2] - self._spot(rows), 0, 0)
        self.within("bricks appear: goal's root y", goal[:, 1], 0, 0)

    def _spot(self, rows: np.ndarray) -> np.ndarray:
        return np.asarray(self.scene.brick_spot[rows])
