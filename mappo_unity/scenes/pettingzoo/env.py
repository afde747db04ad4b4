"""Copies of a PettingZoo parallel environment, side by side, as one `mlagents_envs.base_env.BaseEnv`."""

from __future__ import annotations

from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorSpec, DecisionSteps, TerminalSteps
from mlagents_envs.exception import UnityActionException

from mappo_unity.scenes.contract.rules import EnvironmentDataError
from mappo_unity.scenes.pettingzoo.roles import Role
from mappo_unity.scenes.pettingzoo.spaces import MASK

SEED_RANGE = 2**31 - 1


class ParallelCopies(BaseEnv):
    """Play copies of one parallel environment; each begins a new episode when all its agents have ended.

    Agent n of copy k has the id ``k * agents + n``, its team the group ``k * teams + team``. In every step
    all living agents request a decision. An agent that ends for good while others play on stays away until
    its copy begins anew; one that appears in mid-episode requests its first decision then.

    Args:
        copies: the environments, all alike.
        roles: of every possible agent.
        specs: the behaviors by name.
        seed: every reset of a copy gets a seed that follows from it.
        name: what messages call the environment.
    """

    def __init__(
        self, copies: list[Any], roles: dict[Any, Role], specs: dict[str, BehaviorSpec], seed: int, name: str
    ) -> None:
        self._specs = specs
        self._rng = np.random.default_rng(seed)
        self._copies = [Copy(env, roles, number, name) for number, env in enumerate(copies)]
        self._records = {name: _Records(spec) for name, spec in specs.items()}
        self._results: dict[str, tuple[DecisionSteps, TerminalSteps]] = {}

    @property
    def behavior_specs(self) -> dict[str, BehaviorSpec]:
        """All behaviors, by name."""
        return self._specs

    def reset(self) -> None:
        """Begin new episodes in all copies."""
        for copy in self._copies:
            copy.reset(self._seed(), self._records)
        self._finish()

    def step(self) -> None:
        """Step all copies with the actions that were set; agents without one do nothing (zeros)."""
        for copy in self._copies:
            copy.step(self._records)
            if copy.is_over:
                copy.reset(self._seed(), self._records)
        self._finish()

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return who requests a decision now, and who has ended since the last step."""
        self._check_name(behavior_name)
        return self._results[behavior_name]

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Take a row for each agent that requested a decision, in their order."""
        self._check_name(behavior_name)
        agents = self._results[behavior_name][0].agent_id
        checked = self._specs[behavior_name].action_spec._validate_action(action, len(agents), behavior_name)

        for row, agent_id in enumerate(agents.tolist()):
            self._set(agent_id, checked.continuous[row], checked.discrete[row])

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Take the action of one agent that requested a decision."""
        self._check_name(behavior_name)
        if agent_id not in self._results[behavior_name][0].agent_id:
            raise UnityActionException(f"agent {agent_id} did not request a decision")
        checked = self._specs[behavior_name].action_spec._validate_action(action, 1, behavior_name)
        self._set(agent_id, checked.continuous[0], checked.discrete[0])

    def close(self) -> None:
        """Close all copies."""
        for copy in self._copies:
            copy.env.close()

    def _set(self, agent_id: int, continuous: np.ndarray, discrete: np.ndarray) -> None:
        copy = self._copies[agent_id // len(self._copies[0].roles)]
        copy.set_action(agent_id, continuous, discrete)

    def _seed(self) -> int:
        # Each reset: an environment that is reset without a seed may draw one from the clock.
        return int(self._rng.integers(SEED_RANGE))

    def _finish(self) -> None:
        self._results = {name: records.pop() for name, records in self._records.items()}

    def _check_name(self, behavior_name: str) -> None:
        if behavior_name not in self._specs:
            raise UnityActionException(
                f"there is no behavior {behavior_name!r}; this environment has {', '.join(self._specs)}"
            )


class Copy:
    """One copy: its agents that live, and the actions that they are to take."""

    def __init__(self, env: Any, roles: dict[Any, Role], number: int, name: str) -> None:
        self.env, self.roles, self._name = env, roles, name
        self._names = list(roles)
        self._first_id = number * len(roles)
        self._first_group = number * max(role.team for role in roles.values())
        self._living: list[Any] = []
        self._actions: dict[Any, Any] = {}

    @property
    def is_over(self) -> bool:
        """Whether no agent is left."""
        return not self._living

    def reset(self, seed: int, records: dict[str, _Records]) -> None:
        """Begin an episode; its agents request their first decisions."""
        result = self.env.reset(seed=seed)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[0], dict)):
            self._refuse("reset", "the pair of dicts observations, infos")

        self._living = self._agents()
        if not self._living:
            raise EnvironmentDataError(f"{self._name}: after its reset its list agents is empty")
        self._request(result[0], result[1], {}, records)

    def set_action(self, agent_id: int, continuous: np.ndarray, discrete: np.ndarray) -> None:
        """Take the row of an agent that requested a decision."""
        agent = self._names[agent_id - self._first_id]
        self._actions[agent] = self.roles[agent].actions.decode(continuous, discrete)

    def step(self, records: dict[str, _Records]) -> None:
        """Step with the actions; note ends and requests."""
        for agent in self._living:
            if agent not in self._actions:
                size, branches = (
                    self.roles[agent].actions.spec.continuous_size,
                    self.roles[agent].actions.branches,
                )
                zeros = np.zeros(size, np.float32), np.zeros(len(branches), np.int32)
                self._actions[agent] = self.roles[agent].actions.decode(*zeros)

        result = self.env.step(self._actions)
        if not (isinstance(result, tuple) and len(result) == 5 and all(isinstance(d, dict) for d in result)):
            self._refuse("step", "five dicts: observations, rewards, terminations, truncations, infos")
        obs, rewards, terminations, truncations, infos = result

        for agent in self._living:
            terminated, truncated = bool(terminations.get(agent)), bool(truncations.get(agent))
            if terminated or truncated:
                role = self.roles[agent]
                sensors = self._observe(agent, obs)
                # an end for good counts more than a time limit in the same step
                flags = float(rewards.get(agent, 0)), not terminated
                records[role.behavior].end(*self._ids(role), sensors, *flags)

        ended = {a for a in self._living if terminations.get(a) or truncations.get(a)}
        now = [agent for agent in self._agents() if agent not in ended]
        gone = [agent for agent in self._living if agent not in ended and agent not in now]
        if gone:
            raise EnvironmentDataError(
                f"{self._name}: agent {gone[0]!r} left its list agents without a termination or truncation; "
                "an episode ends with one of them"
            )
        self._living = now
        self._request(obs, infos, rewards, records)

    def _request(self, obs: dict, infos: dict, rewards: dict, records: dict[str, _Records]) -> None:
        self._actions = {}
        for agent in self._living:
            role = self.roles[agent]
            mask = obs[agent].get(MASK) if isinstance(obs.get(agent), dict) else None
            if mask is None and isinstance(infos.get(agent), dict):
                mask = infos[agent].get(MASK)
            masks = None if mask is None or not role.actions.branches else role.actions.forbidden(mask)

            sensors = self._observe(agent, obs)
            reward = float(rewards.get(agent, 0))
            records[role.behavior].request(*self._ids(role), sensors, reward, masks)

    def _observe(self, agent: Any, obs: dict) -> list[np.ndarray]:
        if agent not in obs:
            raise EnvironmentDataError(f"{self._name}: its observations have none of agent {agent!r}")
        try:
            return [sensor.read(obs[agent]) for sensor in self.roles[agent].sensors]
        except (KeyError, IndexError, TypeError, ValueError) as error:
            space = self.env.observation_space(agent)
            raise EnvironmentDataError(
                f"{self._name}, agent {agent!r}: its observation does not fit its space {space}: {error}"
            ) from error

    def _agents(self) -> list[Any]:
        agents = list(self.env.agents)
        for agent in agents:
            if agent not in self.roles:
                known = ", ".join(map(str, self.roles))
                raise EnvironmentDataError(
                    f"{self._name}: agent {agent!r} is not one of its possible_agents: {known}"
                )
        return agents

    def _ids(self, role: Role) -> tuple[int, int]:
        return self._first_id + role.number, self._first_group + role.team if role.team else 0

    def _refuse(self, method: str, wanted: str) -> None:
        raise EnvironmentDataError(f"{self._name}: its {method} did not return {wanted}")


class _Records:
    """Rows of one behavior, until they are handed over as decision and terminal steps."""

    def __init__(self, spec: BehaviorSpec) -> None:
        self._spec = spec
        self._requests: list[tuple] = []
        self._ends: list[tuple] = []

    def request(self, agent: int, group: int, obs: list, reward: float, masks: list | None) -> None:
        """Note an agent that requests a decision."""
        self._requests.append((agent, group, obs, reward, masks))

    def end(self, agent: int, group: int, obs: list, reward: float, interrupted: bool) -> None:
        """Note an agent whose episode has ended."""
        self._ends.append((agent, group, obs, reward, interrupted))

    def pop(self) -> tuple[DecisionSteps, TerminalSteps]:
        """Return what was noted since the last call."""
        decision, terminal = DecisionSteps.empty(self._spec), TerminalSteps.empty(self._spec)

        if self._requests:
            ids, groups, obs, reward, zeros, masks = self._arrays(self._requests)
            decision = DecisionSteps(obs, reward, ids, self._masks(masks), groups, zeros)
        if self._ends:
            ids, groups, obs, reward, zeros, cut = self._arrays(self._ends)
            terminal = TerminalSteps(obs, reward, np.array(cut, bool), ids, groups, zeros)

        self._requests, self._ends = [], []
        return decision, terminal

    def _arrays(self, rows: list[tuple]) -> tuple:
        ids, groups, obs, reward, last = zip(*rows)
        sensors = [np.stack(values) for values in zip(*obs)]
        ints = np.array(ids, np.int32), np.array(groups, np.int32)
        return *ints, sensors, np.array(reward, np.float32), np.zeros(len(rows), np.float32), last

    def _masks(self, masks: tuple) -> list[np.ndarray] | None:
        branches = self._spec.action_spec.discrete_branches
        if not branches or all(mask is None for mask in masks):
            return None
        rows = [[np.zeros(n, bool) for n in branches] if mask is None else mask for mask in masks]
        return [np.stack(branch) for branch in zip(*rows)]
