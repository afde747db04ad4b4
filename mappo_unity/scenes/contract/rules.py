"""What a BaseEnv must show before it can be played: behaviors with sensors and actions, agents that request.

What breaks a rule is an `EnvironmentDataError` that names the behavior and the rule. `records` looks at what
the agents send.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionSpec, BehaviorSpec, ObservationSpec

from mappo_unity import keys
from mappo_unity.errors import ConfigError

MAX_SILENT_STEPS = 100_000  # BaseEnv steps in a row without a request before that is an error
SILENCE_NOTED = 1_000  # steps in a row after which it is said
LISTS = (tuple, list)

logger = logging.getLogger(__name__)


class EnvironmentDataError(ConfigError):
    """An environment sent what nobody can learn from."""


class ContractError(AssertionError):
    """A broken rule of the BaseEnv contract, found by the checker (`scenes.check`).

    `details`: lines to print below it, such as a traceback of the user's code.
    """

    details: tuple[str, ...] = ()


def has_snapshots(env: Any) -> bool:
    """Return whether a BaseEnv can be brought back to where it was: by `get_state` and `set_state`."""
    return hasattr(env, "get_state") and hasattr(env, "set_state")


def check_specs(specs: Any) -> None:
    """Check the behaviors that an environment shows; there may be none yet.

    Raises:
        EnvironmentDataError: names the behavior that nobody can play, and why.
    """
    if not isinstance(specs, Mapping):
        raise EnvironmentDataError(
            f"behavior_specs is {show_kind(specs)}; it must be a mapping (a dict) of names to BehaviorSpec"
        )

    for name, spec in specs.items():
        if not isinstance(name, str) or not name:
            raise EnvironmentDataError(
                f"behavior_specs has a name {name!r}; names must be texts: Game?team=0"
            )

        _, query, team = name.partition("?team=")
        if query and not team.isdigit():
            raise EnvironmentDataError(
                f"behavior {name!r}: what follows ?team= must be a whole number: 0, 1 ..."
            )

        if not isinstance(spec, BehaviorSpec):
            raise EnvironmentDataError(
                f"behavior {name!r}: its spec is {show_kind(spec)}; it must be a BehaviorSpec"
            )
        _check_spec(name, spec)

    # A policy is named by what precedes the "?": Game and Game?team=0 would be mixed up.
    for name in specs:
        side = next((other for other in specs if other.startswith(f"{name}?")), None)
        if side is not None:
            raise EnvironmentDataError(
                f"behaviors {name!r} and {side!r} share the policy {name!r}: give each a side of its own, "
                f"{name}?team=0 and {name}?team=1"
            )

    # exported files and recordings have a policy's name, which some systems read without regard to case
    named: dict[str, str] = {}
    for policy in map(keys.policy_name, specs):
        other = named.setdefault(keys.file_stem(policy).casefold(), policy)
        if other != policy:
            raise EnvironmentDataError(
                f"behaviors {other!r} and {policy!r} would share the file {keys.file_stem(policy)}.onnx: "
                "give them names that differ in more than case, spaces and signs"
            )


def check_same_specs(specs: Any, first: Mapping[str, BehaviorSpec]) -> None:
    """Check that an environment still shows the behaviors that it showed at first.

    Raises:
        EnvironmentDataError: one has vanished, has changed or is new (its networks cannot be made any more).
    """
    if _are_same(specs, first):
        return

    # Not the same objects: they may still be equal.
    check_specs(specs)

    for name, spec in first.items():
        if name not in specs:
            raise EnvironmentDataError(
                f"behavior {name!r} has vanished: behavior_specs has {list(specs)} now, at the start "
                f"{list(first)}; a behavior without agents stays in behavior_specs"
            )
        if specs[name] != spec:
            raise EnvironmentDataError(
                f"behavior {name!r} has changed its spec: {specs[name]} now, {spec} at the start"
            )

    for name in specs:
        if name not in first:
            raise late_behavior(name, first, "its networks cannot be made any more")


def late_behavior(name: str, first: Iterable[str], reason: str) -> EnvironmentDataError:
    """Return the error of a behavior that was not among the `first` ones, and why nobody can play it."""
    return EnvironmentDataError(
        f"behavior {name!r} appeared after the start, when there were {list(first)}: {reason}; "
        "every behavior must request a decision in the first step after the reset, or be in behavior_specs "
        "from then on"
    )


def check_plain(value: Any, where: str) -> None:
    """Check that a snapshot holds nothing but dicts, lists, arrays and plain values.

    Raises:
        EnvironmentDataError: it holds what no checkpoint gives back, named by its place below `where`.
    """
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise EnvironmentDataError(f"{where} has a key {key!r} that is no string")
            check_plain(item, f"{where}[{key!r}]")
    elif isinstance(value, list):
        for number, item in enumerate(value):
            check_plain(item, f"{where}[{number}]")
    else:
        # Exact types, and arrays of numbers: a checkpoint opens without running any class's code.
        is_array = isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biuf"
        if not is_array and type(value) not in (int, float, str, bool, type(None)):
            raise EnvironmentDataError(
                f"{where} is {type(value).__name__}, not an array of numbers or a plain value; checkpoints "
                "hold dicts, lists, NumPy arrays of numbers, numbers, texts, True, False and None"
            )


def note_silence(steps: int, limit: int) -> None:
    """Say once, after some steps without a request, how many more are allowed."""
    if steps == SILENCE_NOTED:
        logger.warning(
            "no agent has requested a decision for %d environment steps in a row; after %d that is an error",
            *(steps, limit),
        )


def check_silence(steps: int, limit: int) -> None:
    """Say once that nobody has anything to do for so many steps; raise EnvironmentDataError at the limit."""
    note_silence(steps, limit)
    if steps >= limit:
        raise silence_error(steps)


def silence_error(steps: int) -> EnvironmentDataError:
    """Return the error of an environment in which nobody requests a decision any more."""
    return EnvironmentDataError(
        f"no agent asked for a decision in {steps} environment steps in a row: get_steps gave no "
        "DecisionSteps. In Unity every agent needs a DecisionRequester; step() of an environment of your own "
        "goes on until some agent asks"
    )


def sensor_name(spec: BehaviorSpec, index: int) -> str:
    """Return what messages call a sensor."""
    return f"obs_{index} ({spec.observation_specs[index].name})"


def show_kind(value: Any) -> str:
    """Return what a message calls a value that is not what it should be."""
    return "None" if value is None else f"a {type(value).__name__}"


def _are_same(specs: Any, first: Mapping[str, BehaviorSpec]) -> bool:
    """Whether these are the very same specs; quick, since every round calls it."""
    try:
        return len(specs) == len(first) and all(specs[name] is spec for name, spec in first.items())
    except (KeyError, TypeError):
        return False


def _check_spec(name: str, spec: BehaviorSpec) -> None:
    sensors, actions = spec.observation_specs, spec.action_spec
    if not isinstance(sensors, LISTS) or not all(isinstance(sensor, ObservationSpec) for sensor in sensors):
        raise EnvironmentDataError(
            f"behavior {name!r}: observation_specs is {sensors!r}; it must be a list of ObservationSpec"
        )
    if not sensors:
        raise EnvironmentDataError(f"behavior {name!r} has no observation: observation_specs is empty")

    for index, sensor in enumerate(sensors):
        shape = sensor.shape
        if not isinstance(shape, LISTS) or not shape or not all(_is_size(size) for size in shape):
            raise EnvironmentDataError(
                f"behavior {name!r}: sensor {sensor_name(spec, index)} has shape {shape!r}; it must be a "
                "tuple of whole numbers >= 1, such as (8,)"
            )
        flags = sensor.dimension_property
        if flags is not None and not isinstance(flags, LISTS):
            raise EnvironmentDataError(
                f"behavior {name!r}: sensor {sensor_name(spec, index)} has dimension_property {flags!r}; it "
                "must be a tuple with a DimensionProperty for each dimension of its shape"
            )

    if not isinstance(actions, ActionSpec):
        raise EnvironmentDataError(
            f"behavior {name!r}: action_spec is {show_kind(actions)}; it must be an ActionSpec"
        )

    continuous, branches = actions
    if not _is_size(continuous, 0) or not isinstance(branches, LISTS) or not all(map(_is_size, branches)):
        raise EnvironmentDataError(
            f"behavior {name!r}: continuous_size {continuous!r} must be a whole number >= 0, "
            f"discrete_branches {branches!r} a tuple of whole numbers >= 1"
        )
    if not continuous and not branches:
        raise EnvironmentDataError(
            f"behavior {name!r} has no action: ActionSpec(0, ()) leaves nothing to choose"
        )


def _is_size(value: Any, low: int = 1) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= low)
