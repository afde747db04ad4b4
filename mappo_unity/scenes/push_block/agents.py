"""What the agents of both scenes with blocks have in common: size, mass, and what their actions do."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.seven_actions import ACTIONS

AGENT_HALF = (0.5, 0.5, 0.5)
AGENT_MASS, AGENT_DRAG = 10.0, 4.0  # kg, 1/s
BLOCK_HALF_Y = 0.375
BLOCK_DRAG = 0.5  # 1/s


def drives(action: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gained velocities [..., 2] (x, z; m/s) and the new headings [...] for actions [...]."""
    chosen = ACTIONS[action]
    ahead, right = chosen[..., 0], chosen[..., 1]
    # An agent never turns and drives at once: the order is free.
    sin, cos = np.sin(yaw), np.cos(yaw)
    drive = np.empty((*yaw.shape, 2))
    drive[..., 0], drive[..., 1] = ahead * sin + right * cos, ahead * cos - right * sin
    return drive, yaw + chosen[..., 2]
