"""Parallel environments of PettingZoo's whose every number is known; needs pettingzoo."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

RUNNER = spaces.Box(-10, 10, (2,), np.float32)
MASKS = {"runner_0": [1, 0, 1], "runner_1": [1, 1, 0]}


class Script(ParallelEnv):
    """Two runners and a helper; the clock t is what they see.

    helper_0 appears at t = 1. runner_1 ends for good at t = 2, the others are cut off at t = 4. A runner
    earns ten times its choice plus t, the helper minus t.
    """

    metadata = {"name": "script"}

    def __init__(self, space: Any = RUNNER, action: Any = None, teams: Any = None) -> None:
        self.possible_agents = ["runner_0", "runner_1", "helper_0"]
        action = action or spaces.Discrete(3)
        helper = spaces.Dict({"observation": spaces.Discrete(5), "action_mask": spaces.MultiBinary(2)})
        self.spaces = {"runner_0": space, "runner_1": space, "helper_0": helper}
        self.actions = {"runner_0": action, "runner_1": action, "helper_0": spaces.Discrete(2, start=5)}
        self.agents: list[str] = []
        self.t = 0
        self.taken: list[dict] = []

    def observation_space(self, agent):
        return self.spaces[agent]

    def action_space(self, agent):
        return self.actions[agent]

    def observe(self, agents):
        seen = {}
        for number, agent in enumerate(self.possible_agents):
            if agent == "helper_0":
                seen[agent] = {"observation": self.t, "action_mask": np.array([0, 1], np.int8)}
            else:
                seen[agent] = np.array([self.t, number], np.float32)
        return {agent: seen[agent] for agent in agents}

    def infos(self, agents):
        return {a: {"action_mask": np.array(MASKS[a], np.int8)} if a in MASKS else {} for a in agents}

    def reset(self, seed=None, options=None):
        self.t, self.agents = 0, ["runner_0", "runner_1"]
        return self.observe(self.agents), self.infos(self.agents)

    def step(self, actions):
        self.t += 1
        self.taken.append(dict(actions))
        if self.t == 1:
            self.agents.append("helper_0")
        acting = list(self.agents)
        reward = {a: 10.0 * actions[a] + self.t if a in MASKS else -float(self.t) for a in acting}
        terminated = {a: a == "runner_1" and self.t == 2 for a in acting}
        truncated = dict.fromkeys(acting, self.t == 4)
        self.agents = [a for a in acting if not terminated[a] and not truncated[a]]
        return self.observe(acting), reward, terminated, truncated, self.infos(acting)


def make() -> Script:
    return Script()


def no_env() -> dict:
    return {}


def text_observation() -> Script:
    return Script(space=spaces.Dict({"news": spaces.Text(9)}))


def text_action() -> Script:
    return Script(action=spaces.Text(9))


def no_spaces() -> Script:
    env = Script()
    del env.spaces
    return env


def wrong_masks() -> Script:
    env = Script()
    env.infos = lambda agents: {a: {"action_mask": np.ones(4, np.int8)} for a in agents}
    return env


def no_agents() -> Script:
    env = Script()
    env.possible_agents = []
    return env


def raises() -> Script:
    raise ValueError("no licence")


def by_kind(agent: str) -> Any:
    return agent.partition("_")[0] if agent != "runner_1" else None


def team_list(agent: str) -> Any:
    return [agent]


def team_error(agent: str) -> Any:
    return {"blue": 1}[agent]
