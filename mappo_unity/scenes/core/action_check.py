"""What an action must be: its shape, finite numbers, indices within their branches."""

from __future__ import annotations

import numpy as np
from mlagents_envs.base_env import ActionTuple
from mlagents_envs.exception import UnityActionException

from mappo_unity.scenes.core.specs import Behavior


class ActionCheck:
    """Check actions against one behavior."""

    def __init__(self, behavior: Behavior) -> None:
        self._behavior = behavior
        self._spec = behavior.spec().action_spec
        self._sizes = np.array([behavior.branches], np.uint32)

    def __call__(self, action: ActionTuple, agent_ids: np.ndarray) -> None:
        """Raise `UnityActionException` if `action` does not suit the agents, one row each."""
        behavior = self._behavior
        self._spec._validate_action(action, len(agent_ids), behavior.name)

        if behavior.continuous:
            finite = np.isfinite(action.continuous)
            if np.count_nonzero(finite) < finite.size:
                self._refuse(action, agent_ids, ~finite)

        if behavior.branches:
            outside = action.discrete.view(np.uint32) >= self._sizes  # negative ones are large here
            if np.count_nonzero(outside):
                self._refuse(action, agent_ids, outside)

    def _refuse(self, action: ActionTuple, agent_ids: np.ndarray, bad: np.ndarray) -> None:
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        raise UnityActionException(
            f"action of agent {int(agent_ids[row])} of {self._behavior.name} is invalid: "
            f"continuous {action.continuous[row].tolist()} must be finite, "
            f"discrete {action.discrete[row].tolist()} within branches {list(self._behavior.branches)}"
        )
