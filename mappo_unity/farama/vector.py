"""An environment of any backend as a `gymnasium.vector.VectorEnv`, whose sub-environments are its agents."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps

from mappo_unity.errors import ConfigError
from mappo_unity.farama.session import Session
from mappo_unity.farama.spaces import BehaviorSpaces
from mappo_unity.scenes.contract.rules import MAX_SILENT_STEPS, check_silence

Result = tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]


class AgentsVectorEnv(VectorEnv):
    """Agents as sub-environments: each plays episodes of its own, and begins anew by itself.

    An agent that ends begins anew in the same step (`AutoresetMode.SAME_STEP`): the observation is the first
    of its next episode, `infos["final_obs"]` and `infos["final_info"]` hold the last of the one before. Where
    it comes back later, its observation stays the last one until then. `infos["decision_requested"]` says
    whose actions count next; `infos["group_reward"]` what was earned as a team, `infos["action_mask"]` what
    is allowed (of several branches a tuple).
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}

    def __init__(self, session: Session, add_group_rewards: bool) -> None:
        self._session, self._adds = session, add_group_rewards
        self._spaces = {name: BehaviorSpaces(name, first.spec) for name, first in session.first.items()}
        own = next(iter(self._spaces.values()))
        if not all(own.is_like(other) for other in self._spaces.values()):
            session.close()
            raise ConfigError(
                f"{session.name}: its behaviors {', '.join(session.first)} have different spaces; use "
                "parallel_env"
            )

        spec = next(iter(session.first.values())).spec
        self._branches = list(spec.action_spec.discrete_branches)
        self.num_envs = sum(len(first.decision) for first in session.first.values())
        self.single_observation_space, self.single_action_space = own.observation, own.action
        self.observation_space = batch_space(own.observation, self.num_envs)
        self.action_space = batch_space(own.action, self.num_envs)

        shapes = [tuple(sensor.shape) for sensor in spec.observation_specs]
        self._obs = [np.zeros((self.num_envs, *shape), np.float32) for shape in shapes]
        self._masks = [np.ones((self.num_envs, size), np.int8) for size in self._branches]
        self._rows: dict[int, int] = {}  # of agents, by id
        self._requests: dict[str, DecisionSteps] = {}

    def reset(self, *, seed: Any = None, options: dict | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin all episodes anew; a list of seeds counts by its first."""
        if isinstance(seed, list | tuple):
            seed = seed[0]
        super().reset(seed=seed)

        self._rows, self._requests = {}, {}
        asked = np.zeros(self.num_envs, bool)
        for behavior, first in self._session.begin(seed).items():
            self._take(behavior, first.decision, asked)
        return self._observations(), self._infos(asked, np.zeros(self.num_envs, np.float32))

    def step(self, actions: Any) -> Result:
        """Step until an agent requests a decision.

        Args:
            actions: batched; rows of agents that did not request a decision are ignored.

        Raises:
            ConfigError: they do not fit the action space.
        """
        reward, group_reward = np.zeros((2, self.num_envs), np.float32)
        terminated, truncated, asked = np.zeros((3, self.num_envs), bool)
        final: dict[int, Any] = {}

        silent = 0
        while not asked.any():
            check_silence(silent, MAX_SILENT_STEPS)
            silent += 1
            sent = {name: self._rows_of(name, d, actions) for name, d in self._requests.items() if len(d)}
            records = self._session.step(sent)

            for behavior, (_, terminal) in records.items():
                rows, known = self._known(terminal)
                reward[rows] += terminal.reward[known]
                group_reward[rows] += terminal.group_reward[known]
                terminated[rows] = ~terminal.interrupted[known]
                truncated[rows] = terminal.interrupted[known]
                self._end(behavior, terminal, rows, known, final)

            for decision, _ in records.values():
                rows, known = self._known(decision)
                reward[rows] += decision.reward[known]
                group_reward[rows] += decision.group_reward[known]
            for behavior, (decision, _) in records.items():
                self._take(behavior, decision, asked)

        infos = self._infos(asked, group_reward)
        if final:
            infos |= self._final(final, group_reward)
        total = (reward + self._adds * group_reward).astype(np.float64)
        return self._observations(), total, terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self._session.close()

    def _known(self, steps: DecisionSteps | TerminalSteps) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of agents that play, and where they stand in the records."""
        known = [n for n, agent in enumerate(steps.agent_id.tolist()) if agent in self._rows]
        rows = [self._rows[agent] for agent in steps.agent_id[known].tolist()]
        return np.array(rows, np.int64), np.array(known, np.int64)

    def _end(self, behavior: str, terminal: TerminalSteps, rows: Any, known: Any, final: dict) -> None:
        observations = self._spaces[behavior].observe(terminal, known)
        for number, row in enumerate(rows.tolist()):
            own = observations
            final[row] = {k: v[number] for k, v in own.items()} if isinstance(own, dict) else own[number]

        for own_obs, seen in zip(self._obs, terminal.obs):
            own_obs[rows] = seen[known]  # until it begins anew
        for agent in terminal.agent_id[known].tolist():
            del self._rows[agent]

    def _take(self, behavior: str, decision: DecisionSteps, asked: np.ndarray) -> None:
        """Take in who requests a decision; new agents get the rows of those that ended."""
        self._requests[behavior] = decision
        if not len(decision):
            return

        free = sorted(set(range(self.num_envs)) - set(self._rows.values()), reverse=True)
        for agent in decision.agent_id.tolist():
            if agent not in self._rows:
                if not free:
                    raise ConfigError(
                        f"{self._session.name}: there are more agents than the {self.num_envs} of the start; "
                        "use parallel_env"
                    )
                self._rows[agent] = free.pop()

        rows = np.array([self._rows[agent] for agent in decision.agent_id.tolist()])
        everyone = np.arange(len(rows))
        asked[rows] = True
        for own, seen in zip(self._obs, decision.obs):
            own[rows] = seen
        allowed = self._spaces[behavior].allowed(decision, everyone)
        for own, mask in zip(self._masks, allowed if isinstance(allowed, tuple) else [allowed]):
            own[rows] = mask

    def _rows_of(self, behavior: str, decision: DecisionSteps, actions: Any) -> ActionTuple:
        """Return the actions of those that requested a decision, in their order."""
        rows = np.array([self._rows[agent] for agent in decision.agent_id.tolist()])
        space = self._spaces[behavior]
        action = space.idle(decision)
        try:
            own = {k: np.asarray(v)[rows] for k, v in actions.items()} if isinstance(actions, dict) else None
            given = np.asarray(actions)[rows] if own is None else own
        except IndexError:
            given = np.zeros(0)
        space.write(action, np.arange(len(rows)), given, "what step got", self.action_space)
        return action

    def _observations(self) -> Any:
        arrays = [own.copy() for own in self._obs]
        keys = next(iter(self._spaces.values())).keys
        return arrays[0] if len(arrays) == 1 else dict(zip(keys, arrays))

    def _infos(self, asked: np.ndarray, group_reward: np.ndarray) -> dict[str, Any]:
        infos: dict[str, Any] = {"decision_requested": asked, "group_reward": group_reward}
        if self._masks:
            masks = tuple(mask.copy() for mask in self._masks)
            infos["action_mask"] = masks[0] if len(masks) == 1 else masks
        return infos

    def _final(self, final: dict[int, Any], group_reward: np.ndarray) -> dict[str, Any]:
        """Return the last observations and infos of episodes that ended, as Gymnasium's own classes do."""
        obs = np.full(self.num_envs, None, object)
        ended = np.zeros(self.num_envs, bool)
        for row, seen in final.items():
            obs[row], ended[row] = seen, True

        info = {"group_reward": np.where(ended, group_reward, 0), "_group_reward": ended.copy()}
        return {"final_obs": obs, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}
