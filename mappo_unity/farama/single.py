"""An environment with one agent as a `gymnasium.Env`."""

from __future__ import annotations

from typing import Any

import gymnasium

from mappo_unity.errors import ConfigError
from mappo_unity.farama.parallel import AgentsEnv


class SingleAgentEnv(gymnasium.Env):
    """The one agent of an environment; see `AgentsEnv`, which it plays through.

    The agent may begin an episode with another behavior (WallJump), if all have the same spaces; its name
    stands in `info["agent"]`.
    """

    def __init__(self, agents: AgentsEnv) -> None:
        self._agents = agents
        name = agents.metadata["name"]
        self.observation_space = agents.observation_space(agents.possible_agents[0])
        self.action_space = agents.action_space(agents.possible_agents[0])
        self.metadata = {"render_modes": [], "name": name}

        spaces = {
            (str(agents.observation_space(a)), str(agents.action_space(a))) for a in agents.possible_agents
        }
        if len(spaces) > 1:
            agents.close()
            raise ConfigError(f"{name}: its behaviors have different spaces; use parallel_env")

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        observations, infos = self._agents.reset(seed, options)
        agent = self._agent()
        return observations[agent], {"agent": agent, **infos[agent]}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step until the agent requests a decision or its episode ends.

        Raises:
            ConfigError: no episode is running, or the action is not in its space.
        """
        agent = self._agent()
        observations, rewards, terminated, truncated, infos = self._agents.step({agent: action})
        info = {"agent": agent, **infos[agent]}
        return observations[agent], rewards[agent], terminated[agent], truncated[agent], info

    def close(self) -> None:
        """Close the environment."""
        self._agents.close()

    def _agent(self) -> str:
        """Return the name of the agent that plays."""
        names = self._agents.agents
        if not names:
            raise ConfigError(f"{self.metadata['name']}: no episode is running: call reset() before step()")
        if len(names) > 1:
            raise ConfigError(
                f"{self.metadata['name']}: gym_env plays one agent, but {len(names)} begin: "
                f"{', '.join(names)}; use parallel_env or vector_env"
            )
        return names[0]
