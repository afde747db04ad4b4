"""The seven actions of the agents of DungeonEscape, PushBlock and CooperativePushBlock."""

from __future__ import annotations

import numpy as np

from mappo_unity.scenes.core.ground import TICK_S

RUN_SPEED = 3.0  # m/s gained in a tick
STRAFE_SPEED = 0.75 * RUN_SPEED
TURN_RAD = np.radians(200.0) * TICK_S  # in a tick

# One row an action: gained speed ahead and to the right (m/s), turn to the right (rad), in a tick.
ACTIONS = np.array(
    [
        [0.0, 0.0, 0.0],
        [RUN_SPEED, 0.0, 0.0],
        [-RUN_SPEED, 0.0, 0.0],
        [0.0, 0.0, TURN_RAD],
        [0.0, 0.0, -TURN_RAD],
        [0.0, -STRAFE_SPEED, 0.0],
        [0.0, STRAFE_SPEED, 0.0],
    ]
)
