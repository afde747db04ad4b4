"""All environment parameters of a run: what its options say, and what is in force at a lesson."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.parameters.curriculum import Curriculum, is_curriculum, read_curriculum
from mappo_unity.config.parameters.samplers import (
    KINDS,
    Sampler,
    Value,
    is_sampler,
    read_number,
    read_value,
    respelled,
)
from mappo_unity.errors import ConfigError

PLAYERS, SCENE, FACTORY = "players", "scene", "factory"
"""What takes the parameters; `read_parameters` looks at each differently."""
LARGEST_FLOAT32 = (2 - 2**-23) * 2.0**127
"""Players take numbers of 32 bits."""


def read_parameters(params: Mapping[str, Any], taker: str) -> dict[str, Any]:
    """Return each parameter's number, `Sampler` or `Curriculum`, its samplers in order.

    What players take must be one of these. A scene and a factory get other values as they stand, since they
    check or explain them themselves; a factory draws its own numbers and takes no sampler.

    Raises:
        ConfigError: a mistake in one of them.
    """
    read = {name: _read(f"env.params.{name}", raw, taker) for name, raw in params.items()}
    if taker == PLAYERS:
        for name, value in read.items():
            _check_sendable(name, value)

    orders = iter(range(len(params) + sum(len(c.lessons) for c in read.values() if _is_curriculum(c))))
    return {name: _ordered(value, orders) for name, value in read.items()}


def curricula(parameters: Mapping[str, Any]) -> dict[str, Curriculum]:
    """Return the curricula among parameters that `read_parameters` returned."""
    return {name: value for name, value in parameters.items() if _is_curriculum(value)}


def values_at(parameters: Mapping[str, Any], lessons: Mapping[str, int], missing: int = 0) -> dict[str, Any]:
    """Return the values in force.

    Args:
        parameters: as `read_parameters` returned them.
        lessons: number of the lesson of each curriculum, from 0; one too large is the last.
        missing: the lesson of curricula that `lessons` does not name; -1: the last.
    """
    out = dict(parameters)
    for name, curriculum in curricula(parameters).items():
        out[name] = curriculum.lessons[_within(curriculum, lessons.get(name, missing))].value
    return out


def params_at(params: Mapping[str, Any], lessons: Mapping[str, int], missing: int = 0) -> dict[str, Any]:
    """Return `EnvConfig.params` with each curriculum's value at a lesson in its place; see `values_at`."""
    out = dict(params)
    for name, raw in params.items():
        if is_curriculum(raw):
            (own,) = respelled(raw, {"curriculum": "lessons"}).values()
            number = _within(read_curriculum(f"env.params.{name}", raw), lessons.get(name, missing))
            out[name] = own[number]["value"]
    return out


def later_values(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of every lesson but the first, to be checked before any is in force."""
    for name, curriculum in curricula(parameters).items():
        yield from ((name, lesson.value) for lesson in curriculum.lessons[1:])


def is_whole(raw: Any) -> bool:
    """Return whether what options say of a parameter is all of it, rather than some of its keys."""
    return not isinstance(raw, dict) or is_sampler(raw) or is_curriculum(raw)


def show_parameter(value: Any) -> str:
    """Return a value for reading: ``2``, ``uniform 0.5 to 10``."""
    return f"{value:g}" if isinstance(value, float) else str(value)


def _is_curriculum(value: Any) -> bool:
    return isinstance(value, Curriculum)


def _within(curriculum: Curriculum, number: int) -> int:
    last = len(curriculum.lessons) - 1
    return last if number < 0 else min(number, last)


def _read(where: str, raw: Any, taker: str) -> Any:
    if is_curriculum(raw):
        curriculum = read_curriculum(where, raw)
        if taker == FACTORY and any(isinstance(lesson.value, Sampler) for lesson in curriculum.lessons):
            raise ConfigError(f"{where}: {_NO_SAMPLER}: give lessons with numbers")
        return curriculum

    if is_sampler(raw):
        # a factory may have an argument of its own that looks alike
        kind = respelled(raw, {"sampler_type": "sampler"})["sampler"]
        if taker == FACTORY and kind in KINDS:
            raise ConfigError(f"{where}={show_value(raw)}: {_NO_SAMPLER}")
        return raw if taker == FACTORY else read_value(where, raw)

    if taker == PLAYERS:
        return read_number(where, raw, _WANTED)
    return raw


def _check_sendable(name: str, value: Value | Curriculum) -> None:
    """Raise ConfigError for what the side channel to players cannot carry: ASCII and float32."""
    if not name.isascii():
        raise ConfigError(
            f"env.params.{name}: players only know names of ASCII characters, that is of letters without "
            "accents, digits and signs"
        )

    values = [lesson.value for lesson in value.lessons] if isinstance(value, Curriculum) else [value]
    for each in values:
        numbers = each.numbers if isinstance(each, Sampler) else [each]
        for number in numbers:
            if abs(number) > LARGEST_FLOAT32:
                raise ConfigError(
                    f"env.params.{name}: {number:g} is out of range: players take numbers (float32) from "
                    f"-{LARGEST_FLOAT32:.3g} to {LARGEST_FLOAT32:.3g}"
                )


_WANTED = "a number, a sampler {sampler: ...} or a curriculum {lessons: [...]}: players take no others"
_NO_SAMPLER = "env.factory takes no sampler, it draws numbers of its own"


def _ordered(value: Any, orders: Iterator[int]) -> Any:
    """Return a value whose samplers have their place among all."""
    if isinstance(value, Sampler):
        return replace(value, order=next(orders))
    if isinstance(value, Curriculum):
        lessons = [replace(lesson, value=_ordered(lesson.value, orders)) for lesson in value.lessons]
        return Curriculum(tuple(lessons))
    return value
