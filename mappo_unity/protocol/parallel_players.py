"""Several players as one BaseEnv: their agents side by side in every result.

Actions go to all players before the first result is waited for, so they run at the same time. Agent n of
player p of P is agent n * P + p outward; groups likewise, and 0 stays 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps
from mlagents_envs.exception import UnityActionException

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.protocol.restarting_player import RestartingPlayer
from mappo_unity.scenes.contract.statistics import Statistics, join_statistics


class SeveralPlayers(BaseEnv):
    """Step players together; attributes as `RestartingPlayer` has them."""

    def __init__(self, players: Sequence[RestartingPlayer]) -> None:
        self.players = list(players)

    @property
    def restarts(self) -> int:
        """How often a player was started again."""
        return sum(player.restarts for player in self.players)

    @property
    def crashed_agents(self) -> dict[str, np.ndarray]:
        """Agent ids of every behavior whose episodes the last result cut off."""
        out: dict[str, np.ndarray] = {}
        for p, player in enumerate(self.players):
            for name, agents in player.crashed_agents.items():
                out[name] = np.concatenate([out.get(name, agents[:0]), self._outward(agents, p)])
        return out

    def pop_statistics(self) -> Statistics:
        """Return what the games reported of themselves since the last call.

        Player 0's values come last: as in ML-Agents, "the most recent" one is its.
        """
        return join_statistics(player.pop_statistics() for player in reversed(self.players))

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """Return the specs of the behaviors that have shown up so far."""
        specs: dict = {}
        for player in self.players:
            specs |= {name: spec for name, spec in player.behavior_specs.items() if name not in specs}
        return BehaviorMapping(specs)

    def reset(self) -> None:
        """Reset the scenes of all players."""
        for player in self.players:
            player.send_reset()
        self._receive()

    def step(self) -> None:
        """Let every player advance until some agent of its reports."""
        for player in self.players:
            player.send_step()
        self._receive()

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of the last results, player by player."""
        holders = self._holders(behavior_name)
        steps = [(p, self.players[p].get_steps(behavior_name)) for p in holders]

        return (
            self._decisions([(p, decision) for p, (decision, _) in steps]),
            self._terminals([(p, terminal) for p, (_, terminal) in steps]),
        )

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents in the last decision steps, in their order."""
        # The rows stand player by player, as `get_steps` joined them.
        start = 0
        for p in self._holders(behavior_name):
            count = len(self.players[p].get_steps(behavior_name)[0])

            part = ActionTuple()
            if action.continuous is not None:
                part.add_continuous(action.continuous[start : start + count])
            if action.discrete is not None:
                part.add_discrete(action.discrete[start : start + count])

            self.players[p].set_actions(behavior_name, part)
            start += count

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent in the last decision steps."""
        inner, p = divmod(agent_id, len(self.players))
        self.players[p].set_action_for_agent(behavior_name, inner, action)

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter of all players, with their next step."""
        for player in self.players:
            player.set_parameter(name, value)

    def close(self) -> None:
        """Close all players."""
        for player in self.players:
            player.close()

    def _receive(self) -> None:
        for player in self.players:
            player.receive()

    def _holders(self, name: str) -> list[int]:
        holders = [p for p, player in enumerate(self.players) if name in player.behavior_specs]
        if not holders:
            raise UnityActionException(
                f"there is no behavior {name!r}; there are {list(self.behavior_specs)}"
            )

        return holders

    def _outward(self, ids: np.ndarray, player: int) -> np.ndarray:
        return ids * len(self.players) + player

    def _groups(self, ids: np.ndarray, player: int) -> np.ndarray:
        # Groups are numbered from 1, agents from 0; group 0 holds those without a group.
        return np.where(ids > 0, (ids - 1) * len(self.players) + player + 1, 0).astype(np.int32)

    def _decisions(self, parts: list[tuple[int, DecisionSteps]]) -> DecisionSteps:
        obs, reward, agents, groups, group_reward = self._columns(parts)
        masks = [steps.action_mask for _, steps in parts if steps.action_mask is not None and len(steps)]
        mask = [np.concatenate(branch) for branch in zip(*masks)] if masks else None
        return DecisionSteps(obs, reward, agents, mask, groups, group_reward)

    def _terminals(self, parts: list[tuple[int, TerminalSteps]]) -> TerminalSteps:
        obs, reward, agents, groups, group_reward = self._columns(parts)
        interrupted = np.concatenate([steps.interrupted for _, steps in parts])
        return TerminalSteps(obs, reward, interrupted, agents, groups, group_reward)

    def _columns(
        self, parts: Sequence[tuple[int, DecisionSteps | TerminalSteps]]
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        steps = [part for _, part in parts]
        return (
            [np.concatenate(sensor) for sensor in zip(*(part.obs for part in steps))],
            np.concatenate([part.reward for part in steps]),
            np.concatenate([self._outward(part.agent_id, p) for p, part in parts]),
            np.concatenate([self._groups(np.asarray(part.group_id), p) for p, part in parts]),
            np.concatenate([part.group_reward for part in steps]),
        )
