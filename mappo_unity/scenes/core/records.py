"""Records as Python sees them: decision steps, terminal steps that wait for an exchange, arrays of both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from mlagents_envs.base_env import BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.scenes.core.agents import Agents
from mappo_unity.scenes.core.specs import Behavior
from mappo_unity.scenes.core.stacks import Stacks

Steps: TypeAlias = DecisionSteps | TerminalSteps


class Records:
    """Make the records of a scene's agents; behaviors are named by their index.

    Args:
        behaviors: the scene's.
        agents: read, and told what a record ends: rewards, and that an agent has ended.
    """

    def __init__(self, behaviors: Sequence[Behavior], agents: Agents) -> None:
        specs = [behavior.spec() for behavior in behaviors]
        self._behaviors = behaviors
        self._agents = agents
        self._stacks = Stacks((sensor for b in behaviors for sensor in b.sensors), len(agents.enabled))
        self._is_stacked = [any(sensor.stack > 1 for sensor in b.sensors) for b in behaviors]
        self._no_decisions = [DecisionSteps.empty(spec) for spec in specs]
        self._queue = TerminalQueue(specs)

    def __len__(self) -> int:
        """Return how many events have terminal records that wait."""
        return len(self._queue)

    def decisions(
        self, behavior: int, slots: np.ndarray, frames: list[np.ndarray], mask: list[np.ndarray] | None
    ) -> DecisionSteps:
        """Return the decision steps of `slots` [n]: a new frame [n, *shape] a sensor; rewards start anew."""
        if not slots.size:
            return self._no_decisions[behavior]
        agents = self._agents
        steps = DecisionSteps(
            self._shown(behavior, slots, frames),
            agents.reward[slots],
            agents.agent_id[slots],
            mask,
            agents.group_id[slots],
            agents.group_reward[slots],
        )

        # The record has copies of them.
        agents.reward[slots] = 0
        agents.group_reward[slots] = 0
        agents.done[slots] = False
        return steps

    def end(self, behavior: int, slots: np.ndarray, frames: list[np.ndarray], interrupted: bool) -> None:
        """Queue the terminal records of `slots` [n], which have not ended since their last decision."""
        agents = self._agents
        steps = TerminalSteps(
            self._shown(behavior, slots, frames),
            agents.reward[slots],
            np.full(slots.size, interrupted),
            agents.agent_id[slots],
            agents.group_id[slots],
            agents.group_reward[slots],
        )

        # Only now: the record shows the frames of the episode that has ended.
        self._queue.add(behavior, steps)
        self._stacks.clear(slots)
        agents.finish(slots)

    def take_terminals(self, behavior: int) -> TerminalSteps:
        """Return and forget all terminal records that wait."""
        return self._queue.take(behavior)

    def clear_stacks(self, slots: np.ndarray) -> None:
        """Forget the frames of `slots`."""
        self._stacks.clear(slots)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of the frames; between two steps no terminal record waits."""
        return self._stacks.get_state()

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `get_state` returned."""
        self._stacks.set_state(state)
        self._queue.clear()

    def _shown(self, behavior: int, slots: np.ndarray, frames: list[np.ndarray]) -> list[np.ndarray]:
        """Put new frames on the stacks and return what the sensors show."""
        if not self._is_stacked[behavior]:
            return frames
        sensors = self._behaviors[behavior].sensors
        push = self._stacks.push
        return [push(sensor, slots, frame) for sensor, frame in zip(sensors, frames, strict=True)]


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
