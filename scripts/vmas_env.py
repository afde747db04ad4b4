"""VMAS scenarios as a `BaseEnv`: many copies of one scenario, each a team of its own.

In: a scenario's name and parameters. Out: records as ML-Agents sends them: every agent is asked in
every step; continuous actions in [-1, 1] are scaled to the scenario's range; agent ids count through
the environments, group ids are the environments from 1. An episode ends for the whole team at once: for good
when the scenario says so, interrupted after `max_steps` decisions, and the next one's first decisions come in
the same result. Not part of the package: a bench, and an example of ``env.factory``.

    PYTHONPATH=scripts mappo-train env=custom env.factory=vmas_env:make env.params.scenario=navigation

VMAS: Bettini et al., A Vectorized Multi-Agent Simulator for Collective Robot Learning, DARS 2022.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mlagents_envs.base_env import (
    ActionSpec,
    ActionTuple,
    BaseEnv,
    BehaviorMapping,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
    TerminalSteps,
)
from mlagents_envs.exception import UnityActionException
from torch import Tensor

from mappo_unity.errors import ConfigError

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # gym, which vmas needs, warns of its age
    import vmas
    from vmas.simulator.environment import Environment
    from vmas_holders import holders_of, items_of


def make(seed: int, scenario: str, num_envs: int = 60, max_steps: int = 100, **kwargs: Any) -> BaseEnv:
    """Build a VMAS scenario by name (for env.factory).

    Args:
        seed: seed of the scenario's random numbers.
        scenario: its name in VMAS, for example navigation.
        num_envs: copies of it.
        max_steps: decisions after which an episode is interrupted.
        kwargs: parameters of the scenario itself.

    Raises:
        ConfigError: VMAS has no such scenario, or it does not fit (see `VmasEnv`).
    """
    names = scenario_names()
    if scenario not in names:
        raise ConfigError(
            f"env.params.scenario={scenario!r} is no scenario of VMAS; it has {', '.join(names)}"
        )
    return VmasEnv(scenario, int(num_envs), int(max_steps), int(seed), kwargs)


def scenario_names() -> list[str]:
    """Return the names of VMAS' scenarios."""
    folder = Path(vmas.__file__).parent / "scenarios"
    return sorted(path.stem for path in folder.rglob("*.py") if not path.stem.startswith("_"))


class VmasEnv(BaseEnv):
    """Play ``num_envs`` copies of a VMAS scenario.

    Args:
        scenario: its name.
        num_envs: copies E; each is a team of the scenario's n agents.
        max_steps: decisions after which an episode is interrupted.
        seed: seed of this environment's own random numbers (VMAS itself has one stream for all).
        kwargs: parameters of the scenario.

    Raises:
        ConfigError: a number is out of range, or the scenario's agents differ in sensors or actions.
    """

    def __init__(
        self, scenario: str, num_envs: int, max_steps: int, seed: int, kwargs: dict[str, Any]
    ) -> None:
        for option, value in (("num_envs", num_envs), ("max_steps", max_steps)):
            if value < 1:
                raise ConfigError(f"env.params.{option}={value} is out of range: it must be >= 1")

        self._rng: list[Any] = list(Environment.vmas_random_state)
        with self._own_rng():
            self.vmas = vmas.make_env(scenario, num_envs, seed=seed, terminated_truncated=True, **kwargs)
        self.num_envs, self.num_agents, self.max_steps = num_envs, self.vmas.n_agents, max_steps

        self._name = f"{scenario}?team=0"
        self._spec = self._read_spec(scenario)
        self._ids = np.arange(num_envs * self.num_agents, dtype=np.int32)
        self._groups = np.repeat(np.arange(1, num_envs + 1, dtype=np.int32), self.num_agents)
        self._zeros = np.zeros(len(self._ids), np.float32)

        self.reset()
        self.step()  # some attributes of VMAS' objects begin with the first step; `set_state` wants them
        self.reset()

    # --- BaseEnv

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """The one behavior, ``scenario?team=0``."""
        return BehaviorMapping({self._name: self._spec})

    def reset(self) -> None:
        """Begin new episodes everywhere."""
        with self._own_rng():
            obs = self.vmas.reset()
        self._clock = np.zeros(self.num_envs, np.int64)
        self._ask(self._rows(obs), self._zeros, TerminalSteps.empty(self._spec))

    def step(self) -> None:
        """Play one step of all environments with the actions set (zeros if none were)."""
        actions = torch.from_numpy(self._action).view(self.num_envs, self.num_agents, -1)
        scaled = torch.clamp(self._middle + actions * self._half, self._low, self._high)
        with self._own_rng():
            obs, rewards, terminated, _, _ = self.vmas.step(list(scaled.unbind(1)))
        self._clock += 1

        reward = torch.stack(rewards, 1).flatten().numpy()
        rows, real = self._rows(obs), terminated.numpy()
        over = real | (self._clock >= self.max_steps)
        if not over.any():
            self._ask(rows, reward, TerminalSteps.empty(self._spec))
            return

        ended = np.repeat(over, self.num_agents)
        cut = np.repeat(~real, self.num_agents)[ended]
        ids, groups, nothing = self._ids[ended], self._groups[ended], self._zeros[ended]
        terminals = TerminalSteps([rows[ended]], reward[ended], cut, ids, groups, nothing)

        # the next episode begins in the same result
        self._renew(torch.from_numpy(over))
        self._clock[over] = 0
        self._ask(self._rows(self._observe()), np.where(ended, self._zeros, reward), terminals)

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the records of the last step."""
        self._check_name(behavior_name)
        return self._records

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents, ``[E * n, C]`` in [-1, 1] (clipped)."""
        self._action = self._checked(behavior_name, action, len(self._ids))

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent."""
        checked = self._checked(behavior_name, action, 1)
        if not 0 <= agent_id < len(self._ids):
            raise IndexError(f"agent {agent_id} of {behavior_name} did not request a decision")
        self._action[agent_id] = checked[0]

    def close(self) -> None:
        """Do nothing: VMAS holds nothing open."""

    # --- snapshots

    def get_state(self) -> dict[str, Any]:
        """Return a snapshot of everything: each tensor of the scenario, the clocks, the random numbers.

        VMAS has no snapshots of its own; this holds every tensor with a row for each environment that its
        objects keep. A scenario that remembers anything else is not restored to the bit.
        """
        decisions, terminals = self._records
        generator, (kind, words, *rest), (version, internal, gauss) = self._rng
        rng = [generator.numpy().copy(), kind, np.array(words), *rest, version, np.array(internal), gauss]
        return {
            "tensors": {name: holder[key].numpy().copy() for name, holder, key in self._tensors()},
            "clock": self._clock.copy(),
            "rng": rng,
            "obs": decisions.obs[0].copy(),
            "reward": decisions.reward.copy(),
            "ended": terminals.agent_id.copy(),
            "end_obs": terminals.obs[0].copy(),
            "end_reward": terminals.reward.copy(),
            "interrupted": terminals.interrupted.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go back to a snapshot that `get_state` returned here or in an environment made the same way."""
        holders = holders_of(self.vmas)
        for name, value in state["tensors"].items():
            path, _, key = name.rpartition("/")
            holder = holders[path]
            holder[key if isinstance(holder, dict) else int(key)] = torch.from_numpy(np.array(value))

        generator, kind, words, *rest, version, internal, gauss = state["rng"]
        self._rng = [
            torch.from_numpy(np.array(generator)),
            (kind, np.array(words), *rest),
            (version, tuple(int(word) for word in internal), gauss),
        ]
        self._clock = np.array(state["clock"])

        ended = np.array(state["ended"])
        terminals = TerminalSteps(
            [np.array(state["end_obs"])],
            np.array(state["end_reward"]),
            np.array(state["interrupted"]),
            ended,
            self._groups[ended],
            self._zeros[ended],
        )
        self._ask(np.array(state["obs"]), np.array(state["reward"]), terminals)

    # --- helpers

    def _read_spec(self, scenario: str) -> BehaviorSpec:
        spaces = list(self.vmas.action_space)
        sizes = {tuple(space.shape) for space in self.vmas.observation_space}
        ranges = {(tuple(space.low.tolist()), tuple(space.high.tolist())) for space in spaces}
        if len(sizes) > 1 or len(ranges) > 1:
            raise ConfigError(
                f"env.params.scenario={scenario}: its agents differ in observations {sorted(sizes)} or "
                f"actions {sorted(ranges)}; this wrapper plays scenarios whose agents are all alike"
            )

        low, high = ranges.pop()
        self._low, self._high = torch.tensor(low), torch.tensor(high)
        self._middle, self._half = (self._low + self._high) / 2, (self._high - self._low) / 2
        sensor = ObservationSpec(sizes.pop(), (DimensionProperty.NONE,), ObservationType.DEFAULT, "vmas")
        return BehaviorSpec([sensor], ActionSpec(len(low), ()))

    def _rows(self, obs: list[Tensor]) -> np.ndarray:
        """Return observations ``n x [E, O]`` as rows ``[E * n, O]``."""
        return torch.stack(obs, 1).flatten(0, 1).numpy()

    def _observe(self) -> list[Tensor]:
        with self._own_rng():
            (obs,) = self.vmas.get_from_scenario(True, False, False, False)
        return obs

    def _ask(self, rows: np.ndarray, reward: np.ndarray, terminals: TerminalSteps) -> None:
        """Keep a result in which all agents decide."""
        decisions = DecisionSteps([rows], reward, self._ids, None, self._groups, self._zeros)
        self._records = decisions, terminals
        self._action = np.zeros((len(self._ids), self._spec.action_spec.continuous_size), np.float32)

    def _renew(self, over: Tensor) -> None:
        """Begin new episodes in these environments, bool [E].

        Resetting all and putting back the others costs one reset; VMAS' own `reset_at` costs nearly
        that for each environment.
        """
        before = [(holder, key, holder[key].clone()) for _, holder, key in self._tensors()]
        with self._own_rng():
            self.vmas.reset(return_observations=False)
        if over.all():
            return

        for holder, key, old in before:
            new = holder[key]
            holder[key] = torch.where(over.view(-1, *[1] * (new.ndim - 1)), new, old)

    def _tensors(self) -> Iterator[tuple[str, Any, Any]]:
        """Go through the tensors ``[E, ...]`` that VMAS' objects keep: (name, dict or list, key in it)."""
        for path, holder in holders_of(self.vmas).items():
            for key, value in items_of(holder):
                if isinstance(value, Tensor) and value.ndim and len(value) == self.num_envs:
                    yield f"{path}/{key}", holder, key

    @contextmanager
    def _own_rng(self) -> Iterator[None]:
        """Let VMAS, whose random state is one list for all its environments, use ours for a while."""
        shared = list(Environment.vmas_random_state)
        Environment.vmas_random_state[:] = self._rng
        try:
            yield
        finally:
            self._rng = list(Environment.vmas_random_state)
            Environment.vmas_random_state[:] = shared

    def _checked(self, behavior_name: str, action: ActionTuple, count: int) -> np.ndarray:
        self._check_name(behavior_name)
        checked = self._spec.action_spec._validate_action(action, count, behavior_name)
        if not np.isfinite(checked.continuous).all():
            raise UnityActionException(f"an action of {behavior_name} is not finite")
        return np.clip(checked.continuous, -1, 1)

    def _check_name(self, behavior_name: str) -> None:
        if behavior_name != self._name:
            raise UnityActionException(
                f"there is no behavior {behavior_name!r}; this environment has {self._name!r}"
            )
