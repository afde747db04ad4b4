"""An environment of any backend as a `pettingzoo.ParallelEnv`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from gymnasium import spaces
from mlagents_envs.base_env import DecisionSteps, TerminalSteps
from pettingzoo import ParallelEnv

from mappo_unity.errors import ConfigError
from mappo_unity.farama.session import Session
from mappo_unity.farama.spaces import BehaviorSpaces
from mappo_unity.keys import policy_name
from mappo_unity.scenes.contract.rules import MAX_SILENT_STEPS, check_silence

Result = tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict]]


class Seat(NamedTuple):
    """A name of PettingZoo's that an agent of the environment plays under."""

    name: str
    behavior: str


class AgentsEnv(ParallelEnv):
    """All agents of an environment, each by a name: `SoccerTwos_team0_0`, or `Basic_0` where no sides are.

    An episode ends when every agent in it has ended. Until then whoever ended stays away: what it begins anew
    in the environment is played with idle actions and seen by nobody, and `reset` begins all areas anew. So
    one area is one episode; for many areas there is `vector_env`. Agents that appear in mid-episode, and
    those that change their behavior, get a name that was not used in it.

    A step lasts until an agent requests a decision or ends. Who does not request one stands in the result
    with what it saw last, the reward 0 and `infos[name]["decision_requested"]` False; its action is ignored.
    """

    metadata: dict[str, Any] = {"name": "mappo_unity", "render_modes": []}
    render_mode = None

    def __init__(self, session: Session, add_group_rewards: bool, max_agents: int | None) -> None:
        self._session, self._adds = session, add_group_rewards
        self.metadata = {**type(self).metadata, "name": session.name}
        self._spaces = {name: BehaviorSpaces(name, first.spec) for name, first in session.first.items()}

        self._names = {
            behavior: [
                f"{label}_{n}" for n in range(max_agents or max(1, len(session.first[behavior].decision)))
            ]
            for behavior, label in _labels(list(session.first)).items()
        }
        self.possible_agents = [name for names in self._names.values() for name in names]
        self._behavior_of = {name: b for b, names in self._names.items() for name in names}
        self.observation_spaces = {a: self._spaces[b].observation for a, b in self._behavior_of.items()}
        self.action_spaces = {a: self._spaces[b].action for a, b in self._behavior_of.items()}

        self.agents: list[str] = []
        self._seats: dict[int, Seat] = {}  # of living agents, by id
        self._used: set[str] = set()
        self._ended_ids: set[int] = set()  # in the running episode
        self._requests: dict[str, DecisionSteps] = {}
        self._seen: dict[str, Any] = {}  # what living agents saw last
        self._masks: dict[str, Any] = {}

    def observation_space(self, agent: str) -> spaces.Space:
        """Return an agent's observation space."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Return an agent's action space."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict | None = None
    ) -> tuple[dict[str, Any], dict[str, dict]]:
        """Begin an episode, all areas anew; with a seed the environment is opened for it.

        Raises:
            ConfigError: more agents of a behavior begin than there are names, or the seed cannot be taken.
            EnvironmentDataError: a behavior shows that was not there when the environment was opened.
        """
        self.agents, self._seats, self._used = [], {}, set()
        self._requests = {}  # of an episode that was broken off
        self._seen, self._masks, self._ended_ids = {}, {}, set()

        tick = _Tick()
        for behavior, first in self._session.begin(seed).items():
            self._requests[behavior] = first.decision
            if len(first.decision) > len(self._names[behavior]):
                raise ConfigError(
                    f"{self._session.name}: {len(first.decision)} agents of {behavior} begin, but there are "
                    f"names for {len(self._names[behavior])}; give max_agents={len(first.decision)}"
                )
            self._request(behavior, first.decision, tick)

        return {a: self._seen[a] for a in self.agents}, {a: self._info(a, tick) for a in self.agents}

    def step(self, actions: Mapping[str, Any]) -> Result:
        """Step until an agent requests a decision or ends.

        Args:
            actions: of the agents that requested a decision, by name; without one an agent is idle.

        Raises:
            ConfigError: an action is not in its space.
        """
        tick = _Tick()
        silent = 0
        while self.agents and not (tick.ended or tick.asked):
            check_silence(silent, MAX_SILENT_STEPS)
            silent += 1
            records = self._session.step(self._actions(actions))
            actions = {}  # for the first of these steps only

            for behavior, (_, terminal) in records.items():
                self._end(behavior, terminal, tick)

            for behavior, (decision, _) in records.items():
                self._requests[behavior] = decision
                if any(agent not in tick.ended for agent in self.agents):
                    self._request(behavior, decision, tick)

        names = list(self.agents)  # with those that have just ended
        self.agents = [agent for agent in names if agent not in tick.ended]
        rewards = {a: tick.reward.get(a, 0.0) + self._adds * tick.group_reward.get(a, 0.0) for a in names}
        return (
            {a: self._seen[a] for a in names},
            rewards,
            {a: a in tick.ended and not tick.ended[a] for a in names},
            {a: a in tick.ended and tick.ended[a] for a in names},
            {a: self._info(a, tick) for a in names},
        )

    def close(self) -> None:
        """Close the environment."""
        self._session.close()

    def _actions(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return the rows of all agents that requested a decision: what is given, else idle."""
        out = {}
        for behavior, decision in self._requests.items():
            if not len(decision):
                continue

            action = self._spaces[behavior].idle(decision)
            for row, seat in self._rows(decision):
                if seat is not None and seat.name in given:
                    self._spaces[behavior].fill(action, row, given[seat.name])
            out[behavior] = action
        return out

    def _rows(self, steps: DecisionSteps | TerminalSteps) -> Iterator[tuple[int, Seat | None]]:
        for row, agent in enumerate(steps.agent_id.tolist()):
            yield row, self._seats.get(agent)

    def _end(self, behavior: str, terminal: TerminalSteps, tick: _Tick) -> None:
        for row, seat in self._rows(terminal):
            # who plays on under another name, or not at all, has no end here
            if seat is None or seat.behavior != behavior:
                continue
            tick.add(seat.name, terminal, row)
            agent = int(terminal.agent_id[row])
            self._ended_ids.add(agent)
            self._stop(agent, seat, bool(terminal.interrupted[row]), tick)
            self._seen[seat.name] = self._spaces[behavior].observe(terminal, row)

    def _stop(self, agent: int, seat: Seat, interrupted: bool, tick: _Tick) -> None:
        tick.ended[seat.name] = interrupted
        self._masks.pop(seat.name, None)
        del self._seats[agent]

    def _request(self, behavior: str, decision: DecisionSteps, tick: _Tick) -> None:
        for row, seat in list(self._rows(decision)):
            agent = int(decision.agent_id[row])

            if seat is not None and seat.behavior != behavior:
                # it has changed its behavior: cut off under its old name, with what it saw last there
                tick.add(seat.name, decision, row)
                self._stop(agent, seat, True, tick)
                seat = None
            elif seat is not None:
                tick.add(seat.name, decision, row)

            if seat is None:
                free = [name for name in self._names[behavior] if name not in self._used]
                if not free or agent in self._ended_ids:
                    continue
                seat = self._seats[agent] = Seat(free[0], behavior)
                self._used.add(seat.name)
                self.agents.append(seat.name)

            tick.asked.add(seat.name)
            self._seen[seat.name] = self._spaces[behavior].observe(decision, row)
            self._masks[seat.name] = self._spaces[behavior].allowed(decision, row)

    def _info(self, agent: str, tick: _Tick) -> dict[str, Any]:
        info = {
            "decision_requested": agent in tick.asked,
            "group_reward": tick.group_reward.get(agent, 0.0),
        }
        mask = self._masks.get(agent)
        return info if mask is None else {**info, "action_mask": mask}


class _Tick:
    """What happened in a step."""

    def __init__(self) -> None:
        self.reward: dict[str, float] = {}
        self.group_reward: dict[str, float] = {}
        self.ended: dict[str, bool] = {}  # and whether it was cut off
        self.asked: set[str] = set()

    def add(self, agent: str, steps: DecisionSteps | TerminalSteps, row: int) -> None:
        """Add up an agent's rewards."""
        self.reward[agent] = self.reward.get(agent, 0.0) + float(steps.reward[row])
        self.group_reward[agent] = self.group_reward.get(agent, 0.0) + float(steps.group_reward[row])


def _labels(behaviors: list[str]) -> dict[str, str]:
    """Return what each behavior's agents are called: its policy's name, with the side if it has several."""
    policies = [policy_name(behavior) for behavior in behaviors]
    return {
        behavior: f"{policy}_team{behavior.partition('?team=')[2]}" if policies.count(policy) > 1 else policy
        for behavior, policy in zip(behaviors, policies)
    }
