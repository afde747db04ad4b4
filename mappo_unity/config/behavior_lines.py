"""Overrides of behaviors whose names Hydra's grammar does not take: ``behaviors.3DBall.ppo.lr=1e-4``.

In: override lines. Out: the same with one dictionary, ``behaviors={3DBall: {ppo: {lr: 1e-4}}}``, which Hydra
reads and merges with what is there; and back, for tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString

from mappo_unity.config.option_table import show_value
from mappo_unity.config.schema import ConfigError

_LINE = re.compile(r"(\+\+|\+)?behaviors(?P<inside>(\.[^.=]+)*)=(?P<value>.*)", re.DOTALL)
_READABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*|\d+")


def readable_line(line: str) -> str:
    """Return an override in a form that Hydra reads; most are returned as they are.

    Raises:
        HydraException: its value cannot be read.
        ConfigError: an interval below such a name.
    """
    return readable_lines([line])[0]


def readable_lines(lines: list[str]) -> list[str]:
    """Return overrides in a form that Hydra reads, with one dictionary for all such behaviors.

    One, since Hydra's sweepers keep a single override of a key. Several values make all combinations.

    Raises:
        HydraException: a value cannot be read.
        ConfigError: an interval below such a name.
    """
    if not any(_is_unreadable(line) for line in lines):
        return lines
    others = [line for line in lines if not _is_merged(line)]
    first = next(number for number, line in enumerate(lines) if _is_merged(line))
    trees: list[dict[str, Any]] = [{}]
    for line in filter(_is_merged, lines):
        choices = _trees(line)
        trees = [_merged(tree, choice) for tree in trees for choice in choices]
    return [*others[:first], f"++behaviors={','.join(map(_written, trees))}", *others[first:]]


def dotted_options(line: str) -> dict[str, str]:
    """Return the option that an override sets, by its name; those in a dictionary of behaviors each."""
    key, _, value = line.partition("=")
    if key != "behaviors":
        return {key: value}
    return dict(_leaves(key, OverridesParser.create().parse_override(line).value()))


def _is_unreadable(line: str) -> bool:
    match = _LINE.fullmatch(line)
    return bool(match and match["inside"] and not _READABLE.fullmatch(match["inside"].split(".")[1]))


def _is_merged(line: str) -> bool:
    match = _LINE.fullmatch(line)
    return match is not None and (not match["inside"] or _is_unreadable(line))


def _trees(line: str) -> list[dict[str, Any]]:
    match = _LINE.fullmatch(line)
    assert match is not None
    override = OverridesParser.create().parse_override(f"behaviors={match['value']}")
    if not override.is_sweep_override():
        values: list[Any] = [override.value()]
    elif override.is_choice_sweep() or override.is_range_sweep():
        values = list(override.sweep_iterator())
    else:
        raise ConfigError(f"{line}: an interval is not taken for this behavior's name; give values: a,b,c")
    for key in reversed(match["inside"].split(".")[1:]):
        values = [{key: value} for value in values]
    trees = [value for value in values if isinstance(value, dict)]
    if len(trees) < len(values):
        raise ConfigError(f"{line}: behaviors must be named values, for example behaviors.Goalie.ppo.lr=1e-4")
    return trees


def _merged(tree: Any, other: Any) -> Any:
    if not (isinstance(tree, dict) and isinstance(other, dict)):
        return other
    return {**tree, **{key: _merged(tree.get(key), value) for key, value in other.items()}}


def _written(value: Any) -> str:
    if isinstance(value, QuotedString):
        return str(value.with_quotes())
    if isinstance(value, str):
        return str(QuotedString(value, Quote.double).with_quotes())
    if isinstance(value, list):
        return "[" + ",".join(map(_written, value)) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{key}:{_written(item)}" for key, item in value.items()) + "}"
    return show_value(value)


def _leaves(key: str, value: Any) -> Iterator[tuple[str, str]]:
    if not isinstance(value, dict):
        yield key, show_value(value)
        return
    for name, item in value.items():
        yield from _leaves(f"{key}.{name}", item)
