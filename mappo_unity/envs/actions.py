"""A policy's actions as ML-Agents wants them."""

from __future__ import annotations

import numpy as np
from mlagents_envs.base_env import ActionSpec, ActionTuple


def action_tuple(spec: ActionSpec, rows: np.ndarray, limit: float) -> ActionTuple:
    """Return the actions of agents in the order of their requests.

    Args:
        rows: ``[n, C + K]``: continuous columns first, then branch indices.
        limit: continuous columns are clipped to +-limit and divided by it.
    """
    size = spec.continuous_size
    out = ActionTuple()

    if size:
        clipped = np.minimum(np.maximum(rows[:, :size], -limit), limit)
        out.add_continuous(clipped.astype(np.float32, copy=False) / np.float32(limit))

    if spec.discrete_size:
        out.add_discrete(rows[:, size:].astype(np.int32))

    return out
