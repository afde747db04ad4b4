"""A player that is started again when it fails, as one BaseEnv.

There is no gap in its steps: when a player fails, a new one takes its place, and the result holds a terminal
step (interrupted, reward 0, last observation) for every agent whose episode was cut off, beside the new
player's first decisions.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.protocol.client import MakePlayer, UnityPlayer
from mappo_unity.protocol.player_failures import PlayerFailure
from mappo_unity.scenes.contract.statistics import Statistics, join_statistics

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Pause before the second try in a row (before the first there is none), doubled with every further one."""
STEADY_STEPS = 50
"""Good steps after which earlier failures no longer lengthen the pause."""
SEED_STRIDE = 10_000_019
"""A restarted player plays on with another seed, this much further (modulo 2^31)."""

logger = logging.getLogger(__name__)


class RestartingPlayer(BaseEnv):
    """Step a player, and start another when it fails.

    Args:
        make_player: called with a seed, starts a player.
        seed: of the first one.
        max_restarts: restarts allowed over its life; one more failure is an EnvironmentFailure.
        name: for messages.

    Raises:
        ConfigError: the first player cannot be started.

    Attributes: `restarts`, how often a player was started again; `crashed_agents`, for every behavior the ids
    (int32) of the agents whose episodes crashed with the last result, empty nearly always.
    """

    def __init__(
        self, make_player: MakePlayer, seed: int, max_restarts: int = 0, name: str = "the environment"
    ) -> None:
        self._make_player, self._seed, self._name = make_player, seed, name
        self.max_restarts = max_restarts
        self.restarts = 0
        self.crashed_agents: dict[str, np.ndarray] = {}

        self._failures_in_a_row = self._good_steps = 0
        self._last: dict[str, dict[int, DecisionSteps]] = {}  # newest decision of every agent that plays
        self._crashed_steps: dict[str, TerminalSteps] = {}
        self._parameters: dict[str, Value] = {}  # set since the first player was started
        self._specs = BehaviorMapping({})
        self._statistics: Statistics = {}  # of players that failed

        try:
            self.player: UnityPlayer = make_player(seed)
        except PlayerFailure as error:
            raise self._mistake(error) from error

    def connect(self) -> None:
        """Wait for the first player; raises ConfigError if it does not come (see `UnityPlayer.connect`)."""
        try:
            self.player.connect()
        except PlayerFailure as error:
            raise self._mistake(error) from error

    def send_step(self) -> None:
        """Hand the actions over; `receive` waits for the result."""
        self.player.send_step()

    def send_reset(self) -> None:
        """Tell the player to reset its scene."""
        self.player.send_reset()
        self._last.clear()

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter of the player, with its next step, and of those that follow it."""
        self._parameters[name] = value
        self.player.set_parameter(name, value)

    def receive(self) -> None:
        """Wait for the result.

        Raises:
            ConfigError: the first player gave no first result.
            EnvironmentFailure: the restarts are used up.
        """
        self.crashed_agents, self._crashed_steps = {}, {}

        try:
            self.player.receive()
        except PlayerFailure as failure:
            if not self._specs:
                raise self._mistake(failure) from failure

            # Before the new player's agents take the places of those that were cut off.
            self._crashed_steps = self._end_crashed_episodes()
            self.crashed_agents = {name: steps.agent_id for name, steps in self._crashed_steps.items()}
            self._last.clear()
            self._statistics = self.pop_statistics()
            self._start_another(failure)

        self._took_steps()

    def pop_statistics(self) -> Statistics:
        """Return what the game reported of itself since the last call."""
        out = join_statistics([self._statistics, self.player.pop_statistics()])
        self._statistics = {}
        return out

    # ---- BaseEnv ------------------------------------------------------------------------------------------

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """Return the specs of the behaviors that have shown up so far."""
        return self._specs

    def reset(self) -> None:
        """Reset the scene."""
        self.send_reset()
        self.receive()

    def step(self) -> None:
        """Advance until some agent reports."""
        self.send_step()
        self.receive()

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of the last result."""
        if behavior_name in self.player.behavior_specs or behavior_name not in self._specs:
            decision, terminal = self.player.get_steps(behavior_name)
        else:  # the new player has not shown it yet
            spec = self._specs[behavior_name]
            decision, terminal = DecisionSteps.empty(spec), TerminalSteps.empty(spec)
        return decision, self._crashed_steps.get(behavior_name, terminal)

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents in the last decision steps, in their order."""
        if behavior_name in self._specs and behavior_name not in self.player.behavior_specs:
            # the new player has not shown it yet: none of its agents has requested a decision
            self._specs[behavior_name].action_spec._validate_action(action, 0, behavior_name)
            return

        self.player.set_actions(behavior_name, action)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent in the last decision steps."""
        self.player.set_action_for_agent(behavior_name, agent_id, action)

    def close(self) -> None:
        """Close the player."""
        self.player.close()

    # ---- below --------------------------------------------------------------------------------------------

    def _mistake(self, failure: PlayerFailure) -> ConfigError:
        """Return the error of a first player that never worked."""
        return ConfigError(f"{self._name} cannot be started: {failure}")

    def _took_steps(self) -> None:
        """Remember who plays, and that this went well."""
        self._good_steps += 1
        if self._good_steps >= STEADY_STEPS:
            self._failures_in_a_row = 0

        specs = self.player.behavior_specs
        if any(name not in self._specs for name in specs):
            self._specs = BehaviorMapping({**self._specs, **specs})

        for name in specs:
            decision, terminal = self.player.get_steps(name)
            # by agent: not every agent is in every result
            playing = self._last.setdefault(name, {})

            # The ended ones first: an id that is in both plays on.
            for agent in terminal.agent_id.tolist():
                playing.pop(agent, None)

            if len(decision):
                playing.update(dict.fromkeys(decision.agent_id.tolist(), decision))

    def _end_crashed_episodes(self) -> dict[str, TerminalSteps]:
        """Return a terminal step for every agent whose episode the failure cuts off."""
        return {name: _interrupted(playing) for name, playing in self._last.items() if playing}

    def _start_another(self, failure: PlayerFailure) -> None:
        while True:
            if self.restarts >= self.max_restarts:
                raise EnvironmentFailure(
                    f"{self._name} failed: {failure}. It was restarted {self.restarts} times, and "
                    f"env.max_restarts={self.max_restarts} allows no more"
                ) from failure

            self.restarts += 1
            pause_s = _pause_s(self._failures_in_a_row)
            self._failures_in_a_row += 1
            self._good_steps = 0

            logger.warning(
                "%s failed: %s; restart %d of at most %d%s",
                *(self._name, failure, self.restarts, self.max_restarts),
                f" in {pause_s:g} s" if pause_s else "",
            )

            time.sleep(pause_s)
            try:
                # the failed player needs no `close`: `UnityPlayer` ends itself before it raises
                self.player = self._make_player((self._seed + SEED_STRIDE * self.restarts) % 2**31)
                self.player.connect()
                for name, value in self._parameters.items():
                    self.player.set_parameter(name, value)
                self.player.reset()
            except PlayerFailure as error:
                failure = error
                continue

            # Known only now: behaviors show up with the first result.
            return self._check_same(self.player.behavior_specs)

    def _check_same(self, specs: BehaviorMapping) -> None:
        for name in specs:
            if name in self._specs and specs[name] != self._specs[name]:
                self.player.close()
                raise EnvironmentFailure(
                    f"{self._name} came back with another behavior {name!r}: {specs[name]}, before "
                    f"{self._specs[name]}"
                )


def _pause_s(failures_in_a_row: int) -> float:
    """Return the pause before a restart after that many failures in a row, seconds."""
    return min(LONGEST_PAUSE_S, FIRST_PAUSE_S * 2.0 ** (failures_in_a_row - 1)) if failures_in_a_row else 0.0


def _interrupted(playing: Mapping[int, DecisionSteps]) -> TerminalSteps:
    """Return interrupted terminal steps with the agents' last observations."""
    rows = [(steps, steps.agent_id_to_index[agent]) for agent, steps in playing.items()]
    sensors = range(len(rows[0][0].obs))
    zeros = np.zeros(len(rows), np.float32)

    return TerminalSteps(
        obs=[np.stack([steps.obs[i][row] for steps, row in rows]) for i in sensors],
        reward=zeros,
        interrupted=np.ones(len(rows), bool),
        agent_id=np.array(list(playing), np.int32),
        group_id=np.array([steps.group_id[row] for steps, row in rows], np.int32),
        group_reward=zeros.copy(),
    )
