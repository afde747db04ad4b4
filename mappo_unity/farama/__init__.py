"""Environments of any backend as PettingZoo's and Gymnasium's (extra `[farama]`)."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

from mappo_unity.config.extras import install_command
from mappo_unity.errors import ConfigError

if TYPE_CHECKING:
    from mlagents_envs.base_env import BaseEnv

    from mappo_unity.farama.parallel import AgentsEnv
    from mappo_unity.farama.single import SingleAgentEnv
    from mappo_unity.farama.vector import AgentsVectorEnv

__all__ = ["gym_env", "parallel_env", "vector_env"]


def parallel_env(
    env: str | BaseEnv,
    *options: str,
    seed: int = 0,
    num_areas: int = 1,
    add_group_rewards: bool = False,
    max_agents: int | None = None,
) -> AgentsEnv:
    """Return an environment as a `pettingzoo.ParallelEnv`.

        env = parallel_env("SoccerTwos", seed=0)
        env = parallel_env("unity", "env.file_name=builds/Game")

    Args:
        env: a preset of conf/env; or an open environment, which then cannot be seeded.
        options: further options of `mappo-train` that concern the environment.
        seed: of the first episode; `reset(seed=...)` opens the environment anew for another one.
        num_areas: copies of the playing area, all of whose agents play one episode of PettingZoo.
        add_group_rewards: add what agents earn as a team to their rewards; it always stands in the infos.
        max_agents: agents of each behavior that may play in an episode; None: as many as at first.

    Raises:
        ConfigError: an option is wrong, or a package is missing.
    """
    _check_package("pettingzoo")
    from mappo_unity.farama.parallel import AgentsEnv
    from mappo_unity.farama.session import Session

    return AgentsEnv(Session(env, options, seed, num_areas), add_group_rewards, max_agents)


def vector_env(
    env: str | BaseEnv,
    *options: str,
    seed: int = 0,
    num_areas: int | None = None,
    add_group_rewards: bool = False,
) -> AgentsVectorEnv:
    """Return an environment as a `gymnasium.vector.VectorEnv` whose sub-environments are its agents.

    Args:
        env, options, seed, add_group_rewards: as for `parallel_env`. All behaviors must have the same spaces.
        num_areas: copies of the playing area; None: the preset's.

    Raises:
        ConfigError: an option is wrong, a package is missing, or behaviors differ.
    """
    _check_package("gymnasium")
    from mappo_unity.farama.session import Session
    from mappo_unity.farama.vector import AgentsVectorEnv

    return AgentsVectorEnv(Session(env, options, seed, num_areas), add_group_rewards)


def gym_env(
    env: str | BaseEnv, *options: str, seed: int = 0, add_group_rewards: bool = False
) -> SingleAgentEnv:
    """Return an environment with one agent as a `gymnasium.Env`; arguments as for `parallel_env`.

    Raises:
        ConfigError: an option is wrong, a package is missing, or there are several agents.
    """
    _check_package("pettingzoo")
    from mappo_unity.farama.single import SingleAgentEnv

    return SingleAgentEnv(parallel_env(env, *options, seed=seed, add_group_rewards=add_group_rewards))


def _check_package(needed: str) -> None:
    for package in dict.fromkeys((needed, "gymnasium")):
        if importlib.util.find_spec(package) is None:
            raise ConfigError(f"this needs the package {package}: {install_command('farama')}")
