"""Scenarios of VMAS as a PettingZoo parallel environment: many copies of one, simulated as one batch.

VMAS steps all its copies together, as tensors. Here the agents of each copy have names of their own, so that
one parallel environment holds them all: `agent_1702` is agent 2 of copy 17. `copy_of` makes each copy a team.

In the folder of this file, with the extra [farama] and `pip install 'vmas>=1.5.2,<2'`:

    mappo-train env=pettingzoo env.factory=vmas_parallel:make env.teams=vmas_parallel:copy_of

`env.params.scenario`, `env.params.num_envs` and `env.params.max_steps` choose the scenario, how many copies
of it are played, and the length of an episode; other parameters are the scenario's (`env.params.n_agents=4`).
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # gym, which vmas imports, warns of its age
    import vmas

PER_COPY = 100
"""Numbers of names for each copy: agent 2 of copy 17 is 1702."""


def make(
    seed: int, scenario: str = "navigation", num_envs: int = 60, max_steps: int = 100, **params: Any
) -> ParallelEnv:
    """Return the environment: the function that env.factory names."""
    return VmasParallel(seed, scenario, num_envs, max_steps, params)


def copy_of(agent: str) -> int:
    """Return which copy an agent is in: the function that env.teams names."""
    return int(agent.rpartition("_")[2]) // PER_COPY


class VmasParallel(ParallelEnv):
    """Copies of a scenario with vectors as observations and continuous actions.

    The agents of a copy that the scenario ends leave; an episode is over when all copies have ended, at the
    latest after `max_steps` steps.
    """

    def __init__(
        self, seed: int, scenario: str, num_envs: int, max_steps: int, params: dict[str, Any]
    ) -> None:
        self.metadata = {"name": scenario, "render_modes": []}
        self.vmas = vmas.make_env(
            scenario, num_envs, seed=seed, max_steps=max_steps, terminated_truncated=True, **params
        )

        # where an agent is in VMAS' tensors: its place among the scenario's agents, and its copy
        kinds = [agent.name.rstrip("0123456789_") or "agent" for agent in self.vmas.agents]
        if len(kinds) > PER_COPY:
            raise ValueError(f"{scenario} has {len(kinds)} agents; at most {PER_COPY} have names here")
        self.places = {
            f"{kind}_{copy * PER_COPY + place}": (place, copy)
            for copy in range(num_envs)
            for place, kind in enumerate(kinds)
        }
        self.spaces = [
            (Box(-np.inf, np.inf, seen.shape, np.float32), Box(chosen.low, chosen.high, dtype=np.float32))
            for seen, chosen in zip(self.vmas.observation_space, self.vmas.action_space)
        ]
        self.possible_agents = list(self.places)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Box:
        """Return what an agent sees: a vector."""
        return self.spaces[self.places[agent][0]][0]

    def action_space(self, agent: str) -> Box:
        """Return what an agent chooses: a vector within the scenario's bounds."""
        return self.spaces[self.places[agent][0]][1]

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Begin all copies anew; without a seed VMAS goes on with its random numbers."""
        observations = self.vmas.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._of_each(observations), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, np.ndarray]) -> tuple[dict, dict, dict, dict, dict]:
        """Step all copies with a vector for each agent in `agents`."""
        chosen = [np.zeros((self.vmas.num_envs, *space.shape), np.float32) for _, space in self.spaces]
        for agent, action in actions.items():
            place, copy = self.places[agent]
            chosen[place][copy] = action

        seen, earned, terminated, truncated, _ = self.vmas.step([torch.from_numpy(rows) for rows in chosen])
        ends, cuts = (self._of_each([flags] * len(chosen)) for flags in (terminated, truncated))
        result = self._of_each(seen), self._of_each(earned), ends, cuts, {agent: {} for agent in self.agents}

        self.agents = [agent for agent in self.agents if not (ends[agent] or cuts[agent])]
        return result

    def _of_each(self, values: list[torch.Tensor]) -> dict[str, Any]:
        """Return each living agent's part of tensors, one for each place, with a row for each copy."""
        rows = [value.numpy() for value in values]
        return {agent: rows[place][copy] for agent in self.agents for place, copy in [self.places[agent]]}
