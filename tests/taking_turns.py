"""An environment without snapshots in which agents of even and odd numbers request decisions in turn."""

from __future__ import annotations

import numpy as np
from fakes import behavior_spec
from mlagents_envs.base_env import BaseEnv, DecisionSteps, TerminalSteps

NAME = "Turns?team=0"


class Turns(BaseEnv):
    """Every agent earns 1 between two of its decisions; episodes never end."""

    def __init__(self, num_agents: int) -> None:
        self.count, self.now = num_agents, 0

    @property
    def behavior_specs(self):  # type: ignore[override]
        return {NAME: behavior_spec()}

    def reset(self) -> None:
        self.now = 0

    def step(self) -> None:
        self.now += 1

    def get_steps(self, behavior_name: str):  # type: ignore[override]
        # all ask at first, so that the trainer sees how many there are
        ids = np.arange(self.count, dtype=np.int32)
        ids = ids if not self.now else ids[self.now % 2 :: 2]
        zeros, ones = np.zeros(len(ids), np.int32), np.ones(len(ids), np.float32)
        decision = DecisionSteps([ones[:, None]], ones, ids, None, zeros, 0 * ones)
        return decision, TerminalSteps.empty(behavior_spec())

    def set_actions(self, behavior_name: str, action: object) -> None:
        pass

    def set_action_for_agent(self, *arguments: object) -> None:
        raise NotImplementedError

    def close(self) -> None:
        pass


def make(seed: int, num_agents: int) -> Turns:
    """Return it, as env.factory does."""
    return Turns(num_agents)
