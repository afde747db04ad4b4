"""From env.factory of a PettingZoo parallel environment to a BaseEnv of several copies."""

from __future__ import annotations

import importlib.util
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from mlagents_envs.base_env import BaseEnv

from mappo_unity.config.extras import install_command
from mappo_unity.config.option_table import with_article
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.factory import check_call, explained, load_factory

ALL, NONE = "all", "none"
"""Values of env.teams that are no function: one team, every agent alone."""


def check_package() -> None:
    """Raise ConfigError if PettingZoo or Gymnasium is not installed."""
    for package in ("pettingzoo", "gymnasium"):
        if importlib.util.find_spec(package) is None:
            raise ConfigError(
                f"env.backend=pettingzoo needs the package {package}: {install_command('farama')}"
            )


def open_copies(
    factory: Callable[..., Any], name: str, seed: int, params: Mapping[str, Any], count: int, teams: str
) -> BaseEnv:
    """Return `count` copies of the environment that a factory makes, as one BaseEnv.

    Args:
        factory: called with the parameters, and with a seed if it has an argument of this name.
        name: what messages call it.
        seed: all copies' episodes follow from it.
        params: env.params.
        count: env.num_areas.
        teams: env.teams: all, none, or package.module:function.

    Raises:
        ConfigError: the factory or what it returned cannot be played.
    """
    from mappo_unity.scenes.pettingzoo.env import ParallelCopies
    from mappo_unity.scenes.pettingzoo.roles import read_roles

    copies: list[Any] = []
    try:
        for number in range(count):
            copies.append(_make(factory, name, seed + number, params))
        with explained(f"{name}: what its agents and spaces are asked for"):
            roles, specs = read_roles(copies[0], name, _team_function(teams, name))
    except BaseException:
        for copy in copies:
            copy.close()
        raise

    return ParallelCopies(copies, roles, specs, seed, name)


def _make(factory: Callable[..., Any], name: str, seed: int, params: Mapping[str, Any]) -> Any:
    from pettingzoo import AECEnv, ParallelEnv

    has_seed = _takes_seed(factory)
    check_call(factory, name, params, has_seed)
    with explained(name):
        env = factory(**params, **({"seed": seed} if has_seed else {}))

    if not isinstance(env, ParallelEnv):
        turns = "; for one whose agents take turns: pettingzoo.utils.aec_to_parallel"
        raise ConfigError(
            f"{name} returned {with_article(type(env).__name__)}; with env.backend=pettingzoo it must return "
            f"a pettingzoo.ParallelEnv{turns if isinstance(env, AECEnv) else ''}"
        )
    return env


def _takes_seed(factory: Callable[..., Any]) -> bool:
    try:
        return "seed" in inspect.signature(factory).parameters
    except (TypeError, ValueError):
        return False  # a builtin without one


def _team_function(teams: str, name: str) -> Callable[[str], Any] | None:
    if teams == ALL:
        return None
    if teams == NONE:
        return lambda agent: None

    function = load_factory(teams, f"env.teams={teams}")

    def team_of(agent: str) -> Any:
        with explained(f"{name}: the function of env.teams={teams}"):
            return function(agent)

    return team_of
