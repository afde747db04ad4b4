"""The bodies of WallJump: an agent and a block an area, between floor and wall, without an engine.

The agent is a box that only turns about the vertical, the block slides at a fixed height and does not turn,
so all contacts are planes between upright boxes; see `ground.py`. As in Unity, one step of 20 ms with
discrete collision detection: a fast body may overlap for a few ticks, until it is pushed out at 10 m/s.

Area coordinates: x right, y up, z forward; metres. Legend: N areas.
"""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import (
    BOX_FRICTION,
    CONTACT_GAP,
    TICK_S,
    box_gap,
    boxes_overlap,
    push_out,
    slide,
    stop,
    stop_pair,
)

AGENT_HALF = (0.5, 0.5, 0.5)
BLOCK_HALF = (1.5, 1.0, 1.5)
BLOCK_Y = 1.5
FLOOR_Y = 0.45
FLOOR_HALF, FLOOR_Z = 10.5, -4.0
WALL_Z, WALL_HALF_X, WALL_HALF_Z = -1.98, 10.0, 0.75
GOAL_CENTRE, GOAL_HALF = np.array([6.37, 2.99, 2.93]), (2.0, 2.5, 2.0)
AGENT_INVERSE_MASS = np.full(3, 1 / 25)  # 1/kg
BLOCK_INVERSE_MASS = np.array([0.1, 0.0, 0.1])  # frozen in y
AGENT_DRAG_KEPT, BLOCK_DRAG_KEPT = 1 - 2 * TICK_S, 1 - 1 * TICK_S
SOLVER_ROUNDS = 2  # the contacts of an agent depend on each other
HELD_GAP = 1e-3  # m: a block nearer to the wall cannot be pushed towards it
FEET_HALF = (0.475, 0.5, 0.475)  # of the large ground check, 0.05 m below the agent's centre
_REACH = 0.8  # m: more than a turned agent's half diagonal, the contact gap and the feet's shift
_BLOCK_REACH = np.array(BLOCK_HALF) + _REACH
_GOAL_REACH = np.array(GOAL_HALF) + _REACH
_WALL_CENTRE = np.array([0.0, 0.0, WALL_Z])
_DOWN_5_CM = np.array([0.0, -0.05, 0.0])
_ARRAYS = ("position", "velocity", "yaw", "block", "block_velocity", "wall_height")


class WallJumpBodies:
    """Keep and move the bodies of N areas.

    Attributes: `position`, `velocity` [N, 3] and `yaw` [N] (rad, clockwise) of the agent; `block`,
    `block_velocity` [N, 3]; `wall_height` [N]: H; the wall stands with its middle at y = 0, so its top is at
    H / 2, and it is absent where that is below the floor.
    """

    def __init__(self, num_areas: int) -> None:
        self.position = np.tile([0.0, 1.0, -12.0], (num_areas, 1))
        self.velocity = np.zeros((num_areas, 3))
        self.yaw = np.full(num_areas, np.pi)
        self.block = np.tile([0.0, BLOCK_Y, -6.27], (num_areas, 1))
        self.block_velocity = np.zeros((num_areas, 3))
        self.wall_height = np.zeros(num_areas)

    def step(self, drive: np.ndarray, acceleration: np.ndarray) -> None:
        """Advance by one tick: `drive` [N, 3] is added to the agents' velocities, m/s; `acceleration` [N]
        acts downward, m/s^2.
        """
        velocity, position = self.velocity, self.position

        velocity += drive
        velocity[:, 1] -= acceleration * TICK_S
        velocity *= AGENT_DRAG_KEPT
        self.block_velocity *= BLOCK_DRAG_KEPT

        # contacts are those at the start of the tick, as in Unity's engine
        floor_gap = position[:, 1] - (FLOOR_Y + AGENT_HALF[1])
        self._land(slice(None), floor_gap)
        shift, block_shift = self._contacts(floor_gap)

        position += velocity * TICK_S
        position[:, 1] += push_out(floor_gap)
        self.block += self.block_velocity * TICK_S

        if shift is not None:
            position += shift
            self.block += block_shift

    def stands_over(self, slots: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the small ground check, bool [n]: a surface up to 0.55 m below the feet's middle."""
        x, y, z = self.position[slots].T
        top = y - 0.05  # start of a ray of 1 m straight down; a body around its start is not hit

        # the highest surface below the start counts
        level = np.where(_over_floor(x, z) & (top >= FLOOR_Y), FLOOR_Y, -np.inf)

        above_block = self._over_block(x, z, slots) & (top >= BLOCK_Y + BLOCK_HALF[1])
        level = np.where(above_block, BLOCK_Y + BLOCK_HALF[1], level)

        wall_top = self.wall_height[slots] / 2
        on_wall = (np.abs(x) < WALL_HALF_X) & (np.abs(z - WALL_Z) < WALL_HALF_Z) & (top >= wall_top)
        level = np.where(on_wall, np.maximum(level, wall_top), level)

        return top - level <= 1.0

    def grounded(self) -> np.ndarray:
        """Return the large ground check, bool [N]: floor, block or wall within 0.05 m of the feet."""
        on_floor = self.position[:, 1] + _DOWN_5_CM[1] - FEET_HALF[1] < FLOOR_Y
        rows, _, offset, half = self._near(~on_floor)
        if rows.size:
            on_floor[rows[boxes_overlap(offset + _DOWN_5_CM, self.yaw[rows], FEET_HALF, half)]] = True
        return on_floor

    def fallen(self) -> np.ndarray:
        """Return where the agent or the block is beyond the floor's edge, bool [N]."""
        x, y, z = self.position.T
        # who stands on a block that overhangs the edge is not lost
        lost = ~_over_floor(x, z) & ~(self._over_block(x, z, slice(None)) & (y > BLOCK_Y))
        return lost | ~_over_floor(self.block[:, 0], self.block[:, 2])

    def in_goal(self) -> np.ndarray:
        """Return the areas whose agent overlaps the goal volume, int [n]."""
        offset = self.position - GOAL_CENTRE
        near = (np.abs(offset) < _GOAL_REACH).all(axis=1).nonzero()[0]
        if near.size:
            near = near[boxes_overlap(offset[near], self.yaw[near], AGENT_HALF, GOAL_HALF)]
        return near

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of all arrays."""
        return {name: getattr(self, name).copy() for name in _ARRAYS}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        for name in _ARRAYS:
            getattr(self, name)[...] = state[name]

    def _land(self, rows: np.ndarray | slice, gap: np.ndarray) -> None:
        """Stop falls at the floor, with the friction of that impulse."""
        velocity = self.velocity[rows]
        impulse = np.maximum(-np.maximum(gap, 0.0) / TICK_S - velocity[:, 1], 0.0) * (gap < CONTACT_GAP)

        velocity[:, 1] += impulse
        slide(velocity, impulse)
        self.velocity[rows] = velocity

    def _contacts(self, floor_gap: np.ndarray) -> tuple[np.ndarray | None, np.ndarray]:
        """Solve agent-wall, agent-block and block-wall contacts; return push-outs of agents and blocks."""
        rows, num_wall, offset, half = self._near()
        stuck, stuck_gap, stuck_normal = self._blocks_at_wall()

        if not (rows.size or stuck.size):
            # without a push-out the second one is not looked at
            return None, floor_gap

        gap, normal = box_gap(offset, self.yaw[rows], AGENT_HALF, half)
        touch = (gap < CONTACT_GAP).nonzero()[0]
        wall, block = touch[touch < num_wall], touch[touch >= num_wall]

        self._stop(self.velocity, rows[wall], gap[wall], normal[wall])
        self._stop(self.block_velocity, stuck, stuck_gap, stuck_normal)

        shift, block_shift = np.zeros_like(self.position), np.zeros_like(self.position)
        shift[rows[wall]] += push_out(gap[wall])[:, None] * normal[wall]
        block_shift[stuck] += push_out(stuck_gap)[:, None] * stuck_normal

        if block.size:
            agents, way, held = rows[block], normal[block], stuck_gap < HELD_GAP
            mobility = self._block_mobility(agents, way, stuck[held], stuck_normal[held])
            between = wall[np.isin(rows[wall], agents)] if wall.size else wall

            # a stop at one contact may undo another: agent and block, agent and wall, floor by turns
            for _ in range(SOLVER_ROUNDS):
                velocity, block_velocity = self.velocity[agents], self.block_velocity[agents]
                stop_pair(velocity, block_velocity, way, gap[block], AGENT_INVERSE_MASS, mobility)
                self.velocity[agents], self.block_velocity[agents] = velocity, block_velocity
                self._stop(self.velocity, rows[between], gap[between], normal[between])
                self._land(agents, floor_gap[agents])

            # the overlap goes to both in proportion to how easily they move
            share = (way**2 * (AGENT_INVERSE_MASS + mobility)).sum(axis=1)
            push = (push_out(gap[block]) / share)[:, None] * way
            shift[agents] += push * AGENT_INVERSE_MASS
            block_shift[agents] -= push * mobility

        return shift, block_shift

    def _block_mobility(
        self, agents: np.ndarray, way: np.ndarray, held: np.ndarray, wall_normal: np.ndarray
    ) -> np.ndarray:
        """Return blocks' inverse masses [n, 3], with 0 where an agent pushes its block into the wall."""
        mobility = np.empty((agents.size, 3))
        mobility[:] = BLOCK_INVERSE_MASS

        if held.size:
            normal = np.zeros_like(self.block)
            normal[held] = wall_normal
            into = np.einsum("ni,ni->n", normal[agents], way) > 0
            mobility[into] *= 1.0 - np.abs(normal[agents[into]])

        return mobility

    def _near(self, among: np.ndarray | None = None) -> tuple[np.ndarray, int, np.ndarray, np.ndarray]:
        """Return the agents near enough to walls, then those near blocks, to need a closer look.

        Returns areas [n], how many of them mean walls, offsets [n, 3] from the wall or block, and its
        half-sizes [n, 3]. `among`: bool [N].
        """
        position, wall_top = self.position, self.wall_height / 2
        wall = (np.abs(position[:, 2] - WALL_Z) < WALL_HALF_Z + _REACH) & (wall_top > FLOOR_Y)
        wall &= position[:, 1] < wall_top + _REACH

        offset = position - self.block
        block = (np.abs(offset) < _BLOCK_REACH).all(axis=1)

        if among is not None:
            wall, block = wall & among, block & among

        walls, blocks = wall.nonzero()[0], block.nonzero()[0]
        rows = np.concatenate([walls, blocks])
        offset = np.concatenate([position[walls] - _WALL_CENTRE, offset[blocks]])

        half = np.empty((rows.size, 3))
        half[walls.size :] = BLOCK_HALF
        half[: walls.size] = WALL_HALF_X, 0.0, WALL_HALF_Z
        # the wall's middle is at y = 0
        half[: walls.size, 1] = wall_top[walls]

        return rows, walls.size, offset, half

    def _blocks_at_wall(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the blocks in contact with the wall: areas [n], gaps [n], normals [n, 3]."""
        offset = self.block - _WALL_CENTRE
        reach = (WALL_HALF_X + BLOCK_HALF[0], WALL_HALF_Z + BLOCK_HALF[2])
        gap_x, gap_z = np.abs(offset[:, 0]) - reach[0], np.abs(offset[:, 2]) - reach[1]

        gap = np.maximum(gap_x, gap_z)
        rows = np.flatnonzero((gap < CONTACT_GAP) & (self.wall_height / 2 > BLOCK_Y - BLOCK_HALF[1]))

        # off an end or a face of the wall, whichever has the larger gap
        normal = np.zeros((rows.size, 3))
        side = gap_x[rows] > gap_z[rows]
        normal[:, 0] = np.where(side, np.sign(offset[rows, 0]), 0.0)
        normal[:, 2] = np.where(side, 0.0, np.sign(offset[rows, 2]))

        return rows, gap[rows], normal

    def _over_block(self, x: np.ndarray, z: np.ndarray, slots: np.ndarray | slice) -> np.ndarray:
        block = self.block[slots]
        return (np.abs(x - block[:, 0]) < BLOCK_HALF[0]) & (np.abs(z - block[:, 2]) < BLOCK_HALF[2])

    @staticmethod
    def _stop(velocities: np.ndarray, rows: np.ndarray, gap: np.ndarray, normal: np.ndarray) -> None:
        if rows.size:
            velocity = velocities[rows]
            stop(velocity, normal, gap, BOX_FRICTION)
            velocities[rows] = velocity


def _over_floor(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return (np.abs(x) <= FLOOR_HALF) & (np.abs(z - FLOOR_Z) <= FLOOR_HALF)
