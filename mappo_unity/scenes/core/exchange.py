"""What Python and a scene exchange between two steps: requests, records out, checked actions in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorMapping, DecisionSteps, TerminalSteps
from mlagents_envs.exception import UnityActionException

from mappo_unity.scenes.core.action_check import ActionCheck
from mappo_unity.scenes.core.agents import Agents
from mappo_unity.scenes.core.specs import Behavior


class Exchange:
    """Hold the last exchange of a scene with Python.

    Attributes: `specs`, of all behaviors; `asked`, slots of all agents that requested a decision;
    `asked_rows`, the same for each behavior, in the order of Python's rows; `results`, records of each
    behavior (empty before the first exchange).
    """

    def __init__(self, scene: str, behaviors: Sequence[Behavior], agents: Agents) -> None:
        self._scene = scene
        self._agents = agents
        self._index = {behavior.name: i for i, behavior in enumerate(behaviors)}
        self._checks = [ActionCheck(behavior) for behavior in behaviors]

        self.specs = BehaviorMapping({behavior.name: behavior.spec() for behavior in behaviors})
        self.asked = np.zeros(0, np.int64)
        self.asked_rows: list[np.ndarray] = [self.asked for _ in behaviors]
        self.results: list[tuple[DecisionSteps, TerminalSteps]] = []

    def ask(self, slots: np.ndarray) -> None:
        """Note who requests a decision; `slots` are in the order of Python's rows."""
        self.asked = slots

        # The first two cases are what nearly every tick is: everybody, nobody.
        if slots is self._agents.order:
            self.asked_rows = self._agents.members
        elif not slots.size:
            self.asked_rows = [slots] * len(self._index)
        else:
            behavior = self._agents.behavior[slots]
            self.asked_rows = [slots[behavior == i] for i in range(len(self._index))]

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return a behavior's records."""
        behavior = self._behavior(behavior_name)
        if not self.results:
            raise UnityActionException(f"behavior {behavior_name} has no steps yet: call reset() first")
        return self.results[behavior]

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Store the actions of all agents of a behavior that requested a decision."""
        behavior = self._behavior(behavior_name)
        slots = self.asked_rows[behavior]
        self._checks[behavior](action, self._agents.agent_id[slots])
        self._agents.store_actions(slots, action.continuous, action.discrete)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Store the action of one agent that requested a decision; raises IndexError for any other."""
        behavior = self._behavior(behavior_name)
        slots = self.asked_rows[behavior]
        slot = slots[self._agents.agent_id[slots] == agent_id]
        if not slot.size:
            raise IndexError(f"agent {agent_id} of {behavior_name} did not request a decision")

        self._checks[behavior](action, self._agents.agent_id[slot])
        self._agents.store_actions(slot, action.continuous, action.discrete)

    def _behavior(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            known = list(self._index)
            raise UnityActionException(
                f"scene {self._scene} has no behavior {name!r}; it has {known}"
            ) from None
