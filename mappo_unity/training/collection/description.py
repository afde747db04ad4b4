"""What workers' environments have: all that learners are built for, without the environments themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mlagents_envs.base_env import BehaviorSpec

from mappo_unity import keys
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError
from mappo_unity.training.collection.batches import count_present


@dataclass(frozen=True)
class Slots:
    """How many teams a behavior has, and how many members a team (as `SlotTable` says it)."""

    num_teams: int  # G
    team_size: int  # A


@dataclass(frozen=True)
class Behavior:
    """A behavior's sensors, actions and slots."""

    spec: BehaviorSpec
    slots: Slots


@dataclass(frozen=True)
class Description:
    """An environment as a `UnityEnv` shows it after opening; what both have has the same name.

    Attributes:
        behaviors: by full name.
        sides: behaviors of every policy name.
        takes_parameters: whether environment parameters can be set while it plays.
        present: agents that were there at the start.
        round_bytes: of what the agents see in one round.
        float_bytes: of those images, as floats, that are bytes in a round.
    """

    behaviors: dict[str, Behavior]
    sides: dict[str, list[str]]
    takes_parameters: bool
    present: int
    round_bytes: int
    float_bytes: int

    def teams(self, name: str) -> int:
        """Return G of a policy name."""
        return self.behaviors[self.sides[name][0]].slots.num_teams


Played = UnityEnv | Description
"""An environment of this process, or what is known of those of workers."""


def describe(env: Played) -> Description:
    """Return the description of an environment that was just opened."""
    if isinstance(env, Description):
        return env

    root = env.root()
    as_floats = sum(4 * entry.nbytes for entry in root.values(True, True) if entry.dtype == torch.uint8)
    behaviors = {
        name: Behavior(behavior.spec, Slots(behavior.slots.num_teams, behavior.slots.team_size))
        for name, behavior in env.behaviors.items()
    }
    return Description(
        behaviors,
        {name: list(sides) for name, sides in env.sides.items()},
        env.takes_parameters,
        count_present(env),
        int(root.bytes()),
        as_floats,
    )


def join_descriptions(parts: Sequence[Description]) -> Description:
    """Return what workers have together: their teams side by side.

    Raises:
        ConfigError: their environments differ in more than the number of teams.
    """
    first = parts[0]
    for number, part in enumerate(parts):
        _check_same(first, part, number)

    behaviors = {
        name: Behavior(
            behavior.spec,
            Slots(sum(part.behaviors[name].slots.num_teams for part in parts), behavior.slots.team_size),
        )
        for name, behavior in first.behaviors.items()
    }
    return Description(
        behaviors,
        first.sides,
        all(part.takes_parameters for part in parts),
        sum(part.present for part in parts),
        sum(part.round_bytes for part in parts),
        sum(part.float_bytes for part in parts),
    )


def _check_same(first: Description, other: Description, number: int) -> None:
    if list(first.behaviors) != list(other.behaviors):
        raise ConfigError(
            f"the workers' environments differ: worker 0 shows the behaviors {', '.join(first.behaviors)}, "
            f"worker {number} {', '.join(other.behaviors)}; collect.workers needs the same from every seed"
        )
    for name, behavior in first.behaviors.items():
        same = other.behaviors[name]
        if behavior.spec != same.spec:
            raise ConfigError(
                f"the workers' environments differ: {name} has other sensors or actions in worker {number} "
                "than in worker 0; collect.workers needs the same from every seed"
            )
        if behavior.slots.team_size != same.slots.team_size:
            raise ConfigError(
                f"the workers' environments differ: the largest team of {keys.policy_name(name)} has "
                f"{behavior.slots.team_size} agents in worker 0 and {same.slots.team_size} in worker "
                f"{number}; give env.max_team_size"
            )
