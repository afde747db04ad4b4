"""A BaseEnv that plays a script: every awkward thing a Unity environment does, on demand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from mlagents_envs.base_env import (
    ActionSpec,
    ActionTuple,
    BaseEnv,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
    TerminalSteps,
)

CONTINUOUS_1 = ActionSpec(1, ())


def vector_spec(size: int, name: str = "vector") -> ObservationSpec:
    """Return the spec of a vector sensor."""
    return ObservationSpec((size,), (DimensionProperty.NONE,), ObservationType.DEFAULT, name)


def behavior_spec(size: int = 1, action: ActionSpec = CONTINUOUS_1) -> BehaviorSpec:
    """Return a behavior with one vector sensor."""
    return BehaviorSpec([vector_spec(size)], action)


@dataclass
class Record:
    """One row of a result: a decision, or a terminal if ``ends`` is given."""

    agent: int
    obs: float = 0.0
    reward: float = 0.0
    group: int = 0
    group_reward: float = 0.0
    ends: str | None = None  # "terminated" or "interrupted"
    mask: list[list[bool]] | None = None
    behavior: str = "Fake?team=0"


@dataclass
class ScriptedEnv(BaseEnv):
    """Return the results of ``script`` one after the other; reset starts at its beginning again."""

    script: Sequence[Sequence[Record]]
    specs: dict[str, BehaviorSpec] = field(default_factory=lambda: {"Fake?team=0": behavior_spec()})

    def __post_init__(self) -> None:
        self.resets = 0
        self.at = -1
        self.actions: list[tuple[str, np.ndarray, np.ndarray]] = []
        self.closed = False

    @property
    def behavior_specs(self):  # type: ignore[override]
        return self.specs

    def reset(self) -> None:
        self.resets += 1
        self.at = 0

    def step(self) -> None:
        self.at += 1
        assert self.at < len(self.script), "the script is over"

    def close(self) -> None:
        self.closed = True

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        asked = [r for r in self.script[self.at] if r.behavior == behavior_name and r.ends is None]
        assert len(action.continuous) == len(asked), "an action for every agent that asked, and no other"
        self.actions.append((behavior_name, action.continuous.copy(), action.discrete.copy()))

    def set_action_for_agent(self, behavior_name, agent_id, action):  # type: ignore[override]
        raise NotImplementedError

    def get_steps(self, behavior_name: str):  # type: ignore[override]
        spec = self.specs[behavior_name]
        rows = [r for r in self.script[self.at] if r.behavior == behavior_name]
        decisions = [r for r in rows if r.ends is None]
        terminals = [r for r in rows if r.ends is not None]
        return self._decision(spec, decisions), self._terminal(spec, terminals)

    def _columns(self, spec: BehaviorSpec, rows: list[Record]):
        obs = [
            np.stack([np.full(o.shape, r.obs, np.float32) for r in rows])
            if rows
            else np.zeros((0, *o.shape), np.float32)
            for o in spec.observation_specs
        ]
        ids = np.array([r.agent for r in rows], np.int32)
        groups = np.array([r.group for r in rows], np.int32)
        reward = np.array([r.reward for r in rows], np.float32)
        group_reward = np.array([r.group_reward for r in rows], np.float32)
        return obs, reward, ids, groups, group_reward

    def _decision(self, spec: BehaviorSpec, rows: list[Record]) -> DecisionSteps:
        obs, reward, ids, groups, group_reward = self._columns(spec, rows)
        mask = None
        if spec.action_spec.discrete_branches:
            free = [[False] * n for n in spec.action_spec.discrete_branches]
            per_agent = [r.mask or free for r in rows]
            mask = [
                np.array([m[b] for m in per_agent], bool).reshape(len(rows), n)
                for b, n in enumerate(spec.action_spec.discrete_branches)
            ]
        return DecisionSteps(obs, reward, ids, mask, groups, group_reward)

    def _terminal(self, spec: BehaviorSpec, rows: list[Record]) -> TerminalSteps:
        obs, reward, ids, groups, group_reward = self._columns(spec, rows)
        interrupted = np.array([r.ends == "interrupted" for r in rows], bool)
        return TerminalSteps(obs, reward, interrupted, ids, groups, group_reward)
