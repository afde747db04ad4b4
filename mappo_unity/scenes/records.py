"""Records as Python sees them: terminal steps that wait for an exchange, and steps as plain arrays.

In: arrays of one event. Out: one `TerminalSteps` a behavior at an exchange. Knows nothing of rules.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from mlagents_envs.base_env import BehaviorSpec, DecisionSteps, TerminalSteps

Steps: TypeAlias = DecisionSteps | TerminalSteps


class TerminalQueue:
    """Hold terminal records in the order of their events until the next exchange."""

    def __init__(self, specs: list[BehaviorSpec]) -> None:
        self._empty = [TerminalSteps.empty(spec) for spec in specs]
        self._waiting: list[list[TerminalSteps]] = [[] for _ in specs]
        self._num_waiting = 0

    def __len__(self) -> int:
        return self._num_waiting

    def add(self, behavior: int, steps: TerminalSteps) -> None:
        """Queue the terminal records of one event under the behavior of that index."""
        self._waiting[behavior].append(steps)
        self._num_waiting += 1

    def take(self, behavior: int) -> TerminalSteps:
        """Return and forget everything queued under a behavior."""
        parts = self._waiting[behavior]
        if not parts:
            return self._empty[behavior]
        self._waiting[behavior] = []
        self._num_waiting -= len(parts)
        return parts[0] if len(parts) == 1 else _joined(parts)

    def clear(self) -> None:
        """Forget everything queued."""
        self._waiting = [[] for _ in self._waiting]
        self._num_waiting = 0


def steps_state(steps: Steps) -> dict[str, Any]:
    """Return decision or terminal steps as a dict of array copies and lists of them."""
    state: dict[str, Any] = {
        "obs": [obs.copy() for obs in steps.obs],
        "reward": steps.reward.copy(),
        "agent_id": steps.agent_id.copy(),
        "group_id": steps.group_id.copy(),
        "group_reward": steps.group_reward.copy(),
    }
    if isinstance(steps, TerminalSteps):
        state["interrupted"] = steps.interrupted.copy()
    else:
        mask: list[np.ndarray] | None = steps.action_mask
        state["action_mask"] = None if mask is None else [part.copy() for part in mask]
    return state


def steps_from_state(state: dict[str, Any]) -> Steps:
    """Rebuild decision or terminal steps from `steps_state`'s dict."""
    copied = {
        key: [part.copy() for part in value] if isinstance(value, list) else value
        for key, value in state.items()
    }
    copied = {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in copied.items()}
    return TerminalSteps(**copied) if "interrupted" in copied else DecisionSteps(**copied)


def _joined(parts: list[TerminalSteps]) -> TerminalSteps:
    return TerminalSteps(
        obs=[np.concatenate(obs) for obs in zip(*(part.obs for part in parts), strict=True)],
        reward=np.concatenate([part.reward for part in parts]),
        interrupted=np.concatenate([part.interrupted for part in parts]),
        agent_id=np.concatenate([part.agent_id for part in parts]),
        group_id=np.concatenate([part.group_id for part in parts]),
        group_reward=np.concatenate([part.group_reward for part in parts]),
    )
