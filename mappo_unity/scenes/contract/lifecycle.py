"""The life of agents as a BaseEnv's records tell it: requested, ended, requested again, under one behavior.

It takes checked decision and terminal steps, result by result; shapes and numbers are checked in `records`.
"""

from __future__ import annotations

from dataclasses import dataclass

from mlagents_envs.base_env import DecisionSteps, TerminalSteps

from mappo_unity.scenes.contract.rules import ContractError


@dataclass
class _Agent:
    behavior: str
    group_id: int
    ended: bool = False


class Lives:
    """Follow every agent from its first decision to its ends."""

    def __init__(self) -> None:
        self._agents: dict[int, _Agent] = {}
        self._asked: dict[int, str] = {}  # in this result: agent -> behavior

    def begin_result(self) -> None:
        """Begin a result; its terminal steps of all behaviors come before its decision steps."""
        self._asked = {}

    def end(self, name: str, steps: TerminalSteps) -> None:
        """Take in the ends of a behavior's agents."""
        for agent, group_id in zip(steps.agent_id.tolist(), steps.group_id.tolist(), strict=True):
            known = self._agents.get(agent)
            if known is None:
                # It ended before its first request.
                self._agents[agent] = _Agent(name, group_id, ended=True)
                continue

            require(
                not known.ended, f"{name}, agent {agent}: two terminal records without a decision between"
            )
            require(
                known.behavior == name,
                f"{name}, agent {agent}: ended here, but its last decision was in {known.behavior}",
            )
            # Unity's UnregisterAgent takes an agent out of its group before it ends
            require(
                group_id in (known.group_id, 0),
                f"{name}, agent {agent}: ended in group {group_id}, but its decisions were in "
                f"{known.group_id}",
            )

            known.ended = True

    def ask(self, name: str, steps: DecisionSteps) -> None:
        """Take in the decisions that a behavior's agents request."""
        for agent, group_id in zip(steps.agent_id.tolist(), steps.group_id.tolist(), strict=True):
            require(
                agent not in self._asked,
                f"{name}, agent {agent}: asks under two behaviors at once, here and in "
                f"{self._asked.get(agent)}",
            )
            self._asked[agent] = name

            # Once it has ended, an agent may come back under another behavior.
            known = self._agents.get(agent)
            if known is not None and not known.ended:
                require(
                    known.behavior == name,
                    f"{name}, agent {agent}: came from {known.behavior} without a terminal record",
                )

            self._agents[agent] = _Agent(name, group_id)


def require(holds: bool, message: str) -> None:
    """Raise ContractError with a message unless a rule holds."""
    if not holds:
        raise ContractError(message)
