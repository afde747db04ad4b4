"""What the agents of both scenes with blocks have in common: size, mass, and what their actions do."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.seven_actions import ACTIONS
from mappo_unity.scenes.push_block.contacts import turns_of

AGENT_HALF = (0.5, 0.5, 0.5)
AGENT_MASS, AGENT_DRAG = 10.0, 4.0  # kg, 1/s
BLOCK_HALF_Y = 0.375
BLOCK_DRAG = 0.5  # 1/s

# What an action gives in a tick: speed to the right + i ahead (m/s), turn to the right (rad).
_PUSH, _TURN = ACTIONS[:, 1] + 1j * ACTIONS[:, 0], ACTIONS[:, 2]


def drives(action: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gained velocities complex [...] (x + iz, m/s) and the new headings [...] for actions."""
    # An agent never turns and drives at once: the order is free.
    return _PUSH.take(action) * turns_of(yaw), yaw + _TURN.take(action)
