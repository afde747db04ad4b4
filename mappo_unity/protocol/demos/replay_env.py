"""Demonstrations played back as an environment, whatever actions it is given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.demos.demonstration import Demonstration

AGENTS = 16  # side by side at most, each with episodes of its own


class ReplayEnv(BaseEnv):
    """Agents that see and earn what experts did, episode after episode, again and again.

    Args:
        demos: what each behavior's agents live through.
    """

    def __init__(self, demos: Mapping[str, Demonstration]) -> None:
        self._replays = {name: _Replay(demo) for name, demo in demos.items()}
        self._specs = BehaviorMapping({name: demo.spec for name, demo in demos.items()})

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """The demonstrations' behaviors."""
        return self._specs

    def reset(self) -> None:
        """Begin with the first episode of each agent."""
        for replay in self._replays.values():
            replay.reset()

    def step(self) -> None:
        """Go on to every agent's next decision."""
        for replay in self._replays.values():
            replay.step()

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decisions that are due, and the ends."""
        return self._replays[behavior_name].steps

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Take actions, which change nothing."""

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Take an action, which changes nothing."""

    def close(self) -> None:
        """There is nothing to close."""

    def get_state(self) -> dict[str, Any]:
        """Return where every agent stands."""
        return {name: replay.at.copy() for name, replay in self._replays.items()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Go on from where `get_state` stood; raise ConfigError where it played back other recordings."""
        for name, at in state.items():
            replay = self._replays.get(name)
            if replay is None or not replay.can_stand(np.asarray(at)):
                raise ConfigError(f"the demonstrations of {name} that were played back are others than here")
            replay.stand(np.asarray(at))


class _Replay:
    """One behavior's agents; agent n lives through the episodes n, n + agents, n + 2 agents ..."""

    def __init__(self, demo: Demonstration) -> None:
        self._demo = demo
        starts = np.flatnonzero(demo.first)
        count = min(AGENTS, len(starts))
        self._begin = starts[:count]

        # the decision that each one is followed by, in the agent's life
        self._next = np.arange(1, len(demo) + 1)
        ends = np.append(starts[1:], len(demo)) - 1
        for agent in range(count):
            own = np.arange(agent, len(starts), count)
            self._next[ends[own]] = starts[np.roll(own, -1)]
        # a recording may end in the middle of an episode, which is then cut off
        self._ends = np.zeros(len(demo), bool)
        self._ends[ends] = True
        self._cut = demo.interrupted | ~demo.done
        self.reset()

    def reset(self) -> None:
        self.stand(self._begin.copy())

    def can_stand(self, at: np.ndarray) -> bool:
        return len(at) == len(self._begin) and bool((at < len(self._demo)).all())

    def stand(self, at: np.ndarray) -> None:
        self.at = at
        nothing = np.zeros(len(at), np.float32)
        self.steps = self._decisions(nothing, nothing), TerminalSteps.empty(self._demo.spec)

    def step(self) -> None:
        demo, before = self._demo, self.at
        over = np.flatnonzero(self._ends[before])
        ended = before[over]
        ids = over.astype(np.int32)
        terminal = TerminalSteps(
            demo.next_obs(ended),
            demo.reward[ended],
            self._cut[ended],
            ids,
            np.zeros_like(ids),
            demo.group_reward[ended],
        )

        self.at = self._next[before]
        # what an episode ended with belongs to its terminal step
        earned = [np.where(self._ends[before], 0, x[before]) for x in (demo.reward, demo.group_reward)]
        self.steps = self._decisions(*earned), terminal

    def _decisions(self, reward: np.ndarray, group_reward: np.ndarray) -> DecisionSteps:
        ids = np.arange(len(self.at), dtype=np.int32)
        return DecisionSteps(
            self._demo.obs(self.at),
            reward.astype(np.float32),
            ids,
            self._mask(),
            np.zeros_like(ids),
            group_reward.astype(np.float32),
        )

    def _mask(self) -> list[np.ndarray] | None:
        branches = self._demo.spec.action_spec.discrete_branches
        if not branches:
            return None
        allowed = np.ones((len(self.at), sum(branches)), bool)
        if self._demo.mask is not None:
            allowed = self._demo.mask[self.at]
        # Unity's sense: True = forbidden
        return np.split(~allowed, np.cumsum(branches)[:-1], axis=1)
