"""What a policy was built for beside what an environment's behaviors are, and the sides that behaviors have.

Torch is not imported: what does not fit can be told before anything heavy is loaded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mappo_unity import keys
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.protobuf import install
from mappo_unity.scenes.contract.images import FIRST, LAST, channel_dim, guessed_channel_dim
from mappo_unity.scenes.contract.sensors import is_goal

# Before mlagents_envs: its messages do not load on a current protobuf without this.
install()

from mlagents_envs.base_env import BehaviorSpec  # noqa: E402

CHANNELS = "channel_dims"
"""The entry of a layout that says where each sensor's channels stand, None for what is no image."""
GOALS = "goals"
"""The entry of a layout that says of each sensor whether it is a goal signal."""


def describe_spec(spec: BehaviorSpec, team_size: int) -> dict[str, Any]:
    """Return what a network must fit: sensor shapes, actions, team size."""
    return {
        "team_size": team_size,
        # plain numbers, which a checkpoint gives back: a spec of one's own may hold NumPy's
        "sensors": [[int(n) for n in o.shape] for o in spec.observation_specs],
        CHANNELS: [channel_dim(o) for o in spec.observation_specs],
        GOALS: [is_goal(o) for o in spec.observation_specs],
        "continuous": int(spec.action_spec.continuous_size),
        "branches": [int(n) for n in spec.action_spec.discrete_branches],
    }


def guessed_otherwise(saved: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Tell whether an older checkpoint took other dimensions of an image for its channels than they are.

    Args:
        saved, found: layouts by policy name, of the checkpoint and of the environment.
    """
    return any(
        CHANNELS not in layout
        and [guessed_channel_dim(s) for s in layout["sensors"]] != found[name][CHANNELS]
        for name, layout in saved.items()
    )


def without_channels(layout: Mapping[str, Any]) -> dict[str, Any]:
    """Return the layouts, by policy name, as versions wrote them that did not know channels."""
    return {
        name: {key: value for key, value in policy.items() if key != CHANNELS}
        for name, policy in layout.items()
    }


def same_layout(saved: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    """Tell whether two layouts of a policy are the same; an older one tells neither channels nor goals."""
    untold = {CHANNELS, GOALS} - saved.keys()
    return saved == {key: value for key, value in found.items() if key not in untold}


def check_layout(owner: str, layout: Mapping[str, Any], behavior: str, spec: BehaviorSpec) -> None:
    """Raise ConfigError if policies of that layout (by policy name) cannot play a behavior.

    `owner`: what holds them, for the message.
    """
    name = keys.policy_name(behavior)
    if name not in layout:
        raise ConfigError(
            f"{owner} cannot play {behavior!r}: it holds {_names(layout)}, trained for another environment"
        )

    found = describe_spec(spec, layout[name]["team_size"])
    if not same_layout(layout[name], found):
        raise ConfigError(
            f"{owner} cannot play {behavior!r}: it was trained with {_words(layout[name])}, but the "
            f"environment has {_words(found)}"
        )


def sides_of(behaviors: Iterable[str]) -> dict[int, list[str]]:
    """Return the behaviors of each side by its team id; matches need two sides."""
    sides: dict[int, list[str]] = {}
    for name in behaviors:
        sides.setdefault(keys.team_id(name), []).append(name)
    return sides


def check_two_sides(behaviors: Iterable[str]) -> dict[int, list[str]]:
    """Return the behaviors of each of two sides; raise ConfigError if there are not two."""
    names = list(behaviors)
    sides = sides_of(names)
    if len(sides) != 2:
        raise ConfigError(
            f"matches need an environment with two sides (team ids), and this one has {len(sides)}: "
            f"{', '.join(names)}; mappo-eval without opponent=... plays episodes there"
        )
    return dict(sorted(sides.items()))


def _names(layout: Mapping[str, Any]) -> str:
    names = ", ".join(map(repr, layout))
    return f"the policy {names}" if len(layout) == 1 else f"the policies {names or 'of nobody'}"


def _words(layout: Mapping[str, Any]) -> str:
    shapes = [str(shape) for shape in layout["sensors"]]
    for index, dim in enumerate(layout.get(CHANNELS, ())):
        shapes[index] += {None: "", FIRST: " (channels first)", LAST: " (channels last)"}[dim]
    for index, goal in enumerate(layout.get(GOALS, ())):
        shapes[index] += " (goal)" if goal else ""
    sensors = " and ".join(shapes) or "nothing"
    actions = [f"{layout['continuous']} continuous"] if layout["continuous"] else []
    actions += [f"discrete {layout['branches']}"] if layout["branches"] else []
    return f"observations {sensors} and actions {' and '.join(actions) or 'of no kind'}"
