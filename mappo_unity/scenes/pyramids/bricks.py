"""The brick pyramid of Pyramids: 25 cubes and the goal on top, which topple, on MuJoCo.

Each area's pile is in one of four modes: absent; falling, along a recording made once (a pile that falls
untouched always falls alike); asleep, at rest; awake, stepped by MuJoCo together with its area's agent. It
wakes when the agent or a turning switch may reach a cube, and sleeps when all cubes are at rest and out of
reach. Only awake piles cost anything, and of those only the cubes that move: each sleeps by itself.
Legend: N areas, B = 26 bodies (25 bricks, then the goal).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from mappo_unity.scenes.core.ground import CONTACT_GAP, TICK_S
from mappo_unity.scenes.core.sleeping import SleepingPhysics
from mappo_unity.scenes.pyramids.area import area_spec
from mappo_unity.scenes.pyramids.layout import BRICKS, GOAL, INNER_WALLS, SPAWN_Y

NUM_BODIES = len(BRICKS) + 1
SUBSTEPS = 10  # of 2 ms in a tick: agents hit the cubes at up to 40 m/s
CALM_SUBSTEPS = 5  # of 4 ms, while nothing in a pile, nor the agent beside it, is faster than
CALM_SPEED = 16.0  # m/s: 6.4 cm a substep, less than the 8 cm of 40 m/s
ABSENT, FALLING, ASLEEP, AWAKE = range(4)
HALVES = np.array([[0.5] * 3] * len(BRICKS) + [[1.0] * 3])
RADII = np.sqrt((HALVES**2).sum(axis=1))
AGENT_RADIUS = np.sqrt(0.75)
SWITCH_RADIUS = np.sqrt(12.0)
REST_SPEED = 0.05  # m/s and rad/s
REST_TICKS = 25  # at rest for so long: asleep
MAX_SPIN = 7.0  # rad/s: the engine's limit
SPIN_KEPT = 1.0 - 0.05 * TICK_S
FALL_TICKS = 150  # of the recording; the pile is at rest after about 100
MARGIN = 0.1  # m
_AGENT_JOINTS = 3  # along x and z, about y


class PyramidsBricks:
    """Keep the brick pyramids of all areas.

    `mode` [N] (see the module's docstring), `clock` [N]: ticks of the fall, or ticks at rest while awake;
    `root` [N, 2]: x, z where the pile appeared.
    """

    def __init__(self, num_areas: int, num_threads: int = 1) -> None:
        self._physics = _physics(num_areas, num_threads)
        start = _AGENT_JOINTS
        self.bodies = self._physics.qpos[:, start:].reshape(num_areas, NUM_BODIES, 7)  # x y z, w x y z
        self._speeds = self._physics.qvel[:, start:].reshape(num_areas, NUM_BODIES, 6)

        self.mode = np.full(num_areas, ABSENT)
        self.clock = np.zeros(num_areas, np.int64)
        self.root = np.zeros((num_areas, 2))

    @cached_property
    def _fall(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the recording of a fall at the origin: poses [T, B, 7] and velocities [T, B, 6]."""
        alone = _physics(1, num_threads=1)
        poses, speeds = [], []
        alone.qpos[0, :2] = 40.0  # the agent, far away
        alone.qpos[0, _AGENT_JOINTS:] = _spawned().ravel()

        for _ in range(FALL_TICKS):
            alone.step(SUBSTEPS, np.zeros(1, int), TICK_S / SUBSTEPS)
            poses.append(alone.qpos[0, _AGENT_JOINTS:].reshape(NUM_BODIES, 7).copy())
            speeds.append(alone.qvel[0, _AGENT_JOINTS:].reshape(NUM_BODIES, 6).copy())

        return np.array(poses), np.array(speeds)

    def surround(self, areas: np.ndarray, stone_root: np.ndarray) -> None:
        """Set x, z of the stone pyramids, [n, 6, 2]; they stand at rest by the time bricks come near."""
        self._physics.mocap_pos[areas, 1:, ::2] = stone_root
        self._physics.mocap_pos[areas, 1:, 1] = 0.0

    def appear(self, areas: np.ndarray, root: np.ndarray) -> None:
        """Let a pile appear above x, z `root` [n, 2] in `areas` [n]; it falls."""
        self.bodies[areas] = _spawned()
        self.bodies[areas, :, 0] += root[:, :1]
        self.bodies[areas, :, 2] += root[:, 1:]

        self._speeds[areas] = 0.0
        self._physics.wake(areas)
        self.root[areas] = root
        self.clock[areas] = 0

        # the recording fell on a free floor: at an inner wall the pile has to be computed
        self.mode[areas] = np.where(_clear_of_walls(root), FALLING, AWAKE)

    def remove(self, areas: np.ndarray) -> None:
        """Remove the piles of `areas` [n]."""
        self.mode[areas] = ABSENT

    @property
    def present(self) -> np.ndarray:
        """Return which areas have a pile, bool [N]."""
        return self.mode != ABSENT

    def wake(
        self, position: np.ndarray, velocity: np.ndarray, switch_position: np.ndarray, switch_spin: np.ndarray
    ) -> np.ndarray:
        """Wake piles within reach of agents or turning switches; return who is awake, bool [N]."""
        still = np.flatnonzero((self.mode == FALLING) | (self.mode == ASLEEP))
        if still.size:
            self.mode[still[self._in_reach(still, position, velocity, switch_position, switch_spin)]] = AWAKE

        # a switch is no body that wakes those that it touches
        self._physics.wake(np.flatnonzero((self.mode == AWAKE) & (switch_spin != 0)))
        return self.mode == AWAKE

    def step(
        self,
        position: np.ndarray,
        velocity: np.ndarray,
        yaw: np.ndarray,
        switch: tuple[np.ndarray, np.ndarray],
    ) -> np.ndarray:
        """Advance by one tick; return which agents touch the goal, bool [N].

        Agents of awake areas move: `position`, `velocity` [N, 3] change in place. `switch`: position [N, 3]
        and yaw [N] of the switches.
        """
        self._replay()
        goal = np.zeros(len(self.mode), bool)

        areas = np.flatnonzero(self.mode == AWAKE)
        if not areas.size:
            return goal

        physics = self._physics
        # the engine moves agents along x and z only: their heading is set, so that nothing spins them
        physics.qpos[areas, 0], physics.qpos[areas, 1] = position[areas, 0], position[areas, 2]
        physics.qpos[areas, 2] = yaw[areas]
        physics.qvel[areas, 0], physics.qvel[areas, 1] = velocity[areas, 0], velocity[areas, 2]
        physics.qvel[areas, 2] = 0.0

        physics.mocap_pos[areas, 0] = switch[0][areas]
        physics.mocap_quat[areas, 0, 0] = np.cos(0.5 * switch[1][areas])
        physics.mocap_quat[areas, 0, 2] = np.sin(0.5 * switch[1][areas])

        self._limit_spin(areas)
        calm = self._calm(areas, position, velocity)
        for some, substeps in ((areas[calm], CALM_SUBSTEPS), (areas[~calm], SUBSTEPS)):
            if some.size:
                gaps = physics.step(substeps, some, TICK_S / substeps)[:, :, 0]
                goal[some] = gaps.min(axis=1) < CONTACT_GAP  # it may be thrown clear in the tick

        # the pile may have slowed the agents down
        position[areas, 0], position[areas, 2] = physics.qpos[areas, 0], physics.qpos[areas, 1]
        velocity[areas, 0], velocity[areas, 2] = physics.qvel[areas, 0], physics.qvel[areas, 1]

        self._rest(areas)
        return goal

    def get_state(self) -> dict[str, Any]:
        """Return the physics, modes and clocks."""
        arrays = {"mode": self.mode.copy(), "clock": self.clock.copy(), "root": self.root.copy()}
        return {"physics": self._physics.get_state(), **arrays}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        self._physics.set_state(state["physics"])
        self.mode[:], self.clock[:], self.root[:] = state["mode"], state["clock"], state["root"]

    def _replay(self) -> None:
        """Move falling piles along the recording; at its end they sleep."""
        areas = np.flatnonzero(self.mode == FALLING)
        if areas.size:
            poses, speeds = self._fall
            tick = self.clock[areas]
            self.bodies[areas] = poses[tick]
            self.bodies[areas, :, 0] += self.root[areas, :1]
            self.bodies[areas, :, 2] += self.root[areas, 1:]

            # speeds too: a pile may wake in the middle of its fall
            self._speeds[areas] = speeds[tick]
            self._physics.wake(areas)
            self.clock[areas] += 1
            self._sleep(areas[tick + 1 == FALL_TICKS])

    def _sleep(self, areas: np.ndarray) -> None:
        self.mode[areas] = ASLEEP
        self.clock[areas] = 0
        self._speeds[areas] = 0.0

    def _rest(self, areas: np.ndarray) -> None:
        """Put piles to sleep that have been at rest for a while."""
        moving = (np.abs(self._speeds[areas]) > REST_SPEED).any(axis=(1, 2))
        self.clock[areas] = np.where(moving, 0, self.clock[areas] + 1)
        self._sleep(areas[self.clock[areas] >= REST_TICKS])

    def _in_reach(
        self,
        areas: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
        switch_position: np.ndarray,
        switch_spin: np.ndarray,
    ) -> np.ndarray:
        """Return in which of `areas` [n] an agent or a turning switch may touch a body within a tick."""
        apart = ((self.bodies[areas, :, :3] - switch_position[areas, None]) ** 2).sum(axis=2)
        by_switch = (apart < (RADII + SWITCH_RADIUS + MARGIN) ** 2).any(axis=1)

        return self._beside(areas, position, velocity) | ((switch_spin[areas] != 0) & by_switch)

    def _beside(self, areas: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return in which of `areas` [n] an agent may touch a body within a tick."""
        # the reach takes in the agent's way in this tick
        speed = np.sqrt((velocity[areas] ** 2).sum(axis=1))
        reach = RADII + (AGENT_RADIUS + MARGIN + speed * TICK_S)[:, None]
        apart = ((self.bodies[areas, :, :3] - position[areas, None]) ** 2).sum(axis=2)
        return (apart < reach**2).any(axis=1)

    def _calm(self, areas: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return in which of `areas` [n] neither bodies nor an agent beside them are fast."""
        fastest = (self._speeds[areas, :, :3] ** 2).sum(axis=2).max(axis=1)
        agent = (velocity[areas] ** 2).sum(axis=1) * self._beside(areas, position, velocity)
        return np.maximum(fastest, agent) <= CALM_SPEED**2

    def _limit_spin(self, areas: np.ndarray) -> None:
        """Damp the bodies' spin and cap it, as the engine does at the start of a tick."""
        spin = self._speeds[areas, :, 3:] * SPIN_KEPT
        rate = np.sqrt((spin**2).sum(axis=2, keepdims=True))
        self._speeds[areas, :, 3:] = spin * (MAX_SPIN / np.maximum(rate, MAX_SPIN))


def _physics(num_areas: int, num_threads: int) -> SleepingPhysics:
    """Return the physics of piles; a cube rests as a pile does."""
    return SleepingPhysics(area_spec(SUBSTEPS), num_areas, tolerance=REST_SPEED, num_threads=num_threads)


def _spawned() -> np.ndarray:
    """Return the poses [B, 7] of a pile that appears above the origin."""
    poses = np.zeros((NUM_BODIES, 7))
    poses[:, :3] = np.vstack([BRICKS, GOAL]) + (0.0, SPAWN_Y, 0.0)
    poses[:, 3] = 1.0
    return poses


def _clear_of_walls(root: np.ndarray) -> np.ndarray:
    """Return bool [n]: whether piles above `root` [n, 2] touch no inner wall; others are not replayed."""
    low, high = BRICKS[:, ::2].min(axis=0) - 0.5 - MARGIN, BRICKS[:, ::2].max(axis=0) + 0.5 + MARGIN
    centre, half = root + 0.5 * (low + high), 0.5 * (high - low)
    beside = np.abs(centre[:, None] - INNER_WALLS[:, [0, 2]])
    return ~(beside < half + INNER_WALLS[:, [3, 5]]).all(axis=2).any(axis=1)
