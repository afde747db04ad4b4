"""Which behavior and which team each agent of a parallel environment belongs to."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mlagents_envs.base_env import BehaviorSpec

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.pettingzoo.spaces import Actions, Sensor, read_sensors

TeamOf = Callable[[str], Any]
"""An agent's name to its team: a whole number or a text, or None for an agent alone."""


@dataclass(frozen=True)
class Role:
    """One agent: its place among all, and what it sees and does."""

    number: int  # among possible_agents
    behavior: str
    team: int  # from 1; 0 = alone
    sensors: list[Sensor]
    actions: Actions


def read_roles(
    env: Any, name: str, team_of: TeamOf | None
) -> tuple[dict[Any, Role], dict[str, BehaviorSpec]]:
    """Return the role of each possible agent, and the behaviors' specs by name.

    Agents whose names differ only in the number at their end (`speaker_0`, `speaker_1`) share a behavior
    (`speaker`), if their spaces are the same.

    Args:
        env: a PettingZoo parallel environment.
        name: what messages call it.
        team_of: None: all agents are one team.

    Raises:
        ConfigError: it has no agents, spaces that cannot be played, or teams of an unknown kind.
    """
    agents = list(getattr(env, "possible_agents", None) or [])
    if not agents:
        raise ConfigError(f"{name}: its possible_agents is empty; it must name every agent that may appear")

    specs: dict[str, BehaviorSpec] = {}
    spaces: dict[str, tuple[Any, Any]] = {}  # of a behavior's agents
    roles, teams = {}, {None: 0}
    for number, agent in enumerate(agents):
        where = f"{name}, agent {agent!r}"
        seen, done = env.observation_space(agent), env.action_space(agent)
        sensors, actions = read_sensors(seen, where), Actions(done, where)

        behavior = _behavior(str(agent), (seen, done), spaces)
        spaces[behavior] = seen, done
        specs[behavior] = BehaviorSpec([sensor.spec for sensor in sensors], actions.spec)
        team = teams.setdefault(_team(team_of, str(agent), where), len(teams))
        roles[agent] = Role(number, behavior, team, sensors, actions)

    return roles, specs


def _behavior(agent: str, own: tuple[Any, Any], spaces: dict[str, tuple[Any, Any]]) -> str:
    """Return the behavior of an agent with these spaces: one that is known, or a new name."""
    base = re.sub(r"[^\w.-]+", "_", re.sub(r"[_\-. ]?\d+$", "", agent)) or "agent"

    # agents of one name and several kinds: agent, agent_b, agent_c ...; a number at the end would be cut off
    for letter in range(26):
        name = f"{base}_{chr(ord('a') + letter)}" if letter else base
        if spaces.get(name, own) == own:
            return name
    raise ConfigError(f"agents called {base} have more than 26 different spaces; give them different names")


def _team(team_of: TeamOf | None, agent: str, where: str) -> Any:
    if team_of is None:
        return 1

    team = team_of(agent)
    if team is not None and (isinstance(team, bool) or not isinstance(team, int | str)):
        raise ConfigError(
            f"{where}: the function of env.teams returned {team!r}; it must return a whole number or a text, "
            "the same for the members of a team, or None for an agent alone"
        )
    return team
