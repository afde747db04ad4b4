"""Override lines as people type them, turned into lines that Hydra's grammar reads; and back, for tables.

``recipe=null`` becomes ``recipe=none``, and foreign letters get quotes. Names of behaviors and parameters
that the grammar does not take as keys (``behaviors.3DBall.ppo.lr=1e-4``) become one dictionary,
``behaviors={3DBall: {ppo: {lr: 1e-4}}}``, which Hydra merges with what is there.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, QuotedString

from mappo_unity.config.option_table import show_value
from mappo_unity.config.presets import NO_CHOICE, group_choices
from mappo_unity.config.text_lines import key_name, key_spelling, parse_or_none, quote_words, quoted
from mappo_unity.errors import ConfigError

OPEN = {"behaviors": "behaviors.Goalie.ppo.lr=1e-4", "env.params": "env.params.mass=2"}
"""The options that take names of the user's own below them, each with an example."""

_LINE = re.compile(
    r"(\+\+|\+)?(?P<root>behaviors|env\.params)(?P<inside>(\.[^.=]+)*)=(?P<value>.*)", re.DOTALL
)
_READABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*|0|[1-9][0-9]*")
_NULL = re.compile(r"(?<![\w.-])null(?![\w.-])", re.IGNORECASE)


def to_hydra_syntax(line: str) -> str:
    """Return an override in a form that Hydra reads; most are returned as they are.

    Raises:
        HydraException: its value cannot be read.
        ConfigError: an interval below such a name.
    """
    return all_to_hydra_syntax([line])[0]


def all_to_hydra_syntax(lines: list[str]) -> list[str]:
    """Return overrides in a form that Hydra reads, with one dictionary for all names of an option if need be.

    One, since Hydra's sweepers keep a single override of a key. Several values make all combinations.

    Raises:
        HydraException: a value cannot be read.
        ConfigError: an interval below such a name.
    """
    lines = [_value_to_hydra_syntax(line) for line in lines]
    for root in OPEN:
        lines = _with_one_dictionary(lines, root)
    return lines


def _value_to_hydra_syntax(line: str) -> str:
    key, equals, value = line.partition("=")
    choices = group_choices().get(key, [])

    if NO_CHOICE in choices:
        value = _NULL.sub(NO_CHOICE, value)

    override = parse_or_none(line) if choices and "glob" in value else None
    names: Any = None if override is None else override.value()
    if isinstance(names, Glob):  # which only Hydra's loader could expand
        value = ",".join(names.filter(choices))

    return f"{key}{equals}{quote_words(value)}"


def _with_one_dictionary(lines: list[str], root: str) -> list[str]:
    if not any(_is_unreadable(line, root) for line in lines):
        return lines

    others = [line for line in lines if not _is_merged(line, root)]
    first = next(number for number, line in enumerate(lines) if _is_merged(line, root))

    # several values of one line go with each of the others': all combinations
    trees: list[dict[str, Any]] = [{}]
    for line in lines:
        if _is_merged(line, root):
            choices = _trees(line)
            trees = [_merged(tree, choice) for tree in trees for choice in choices]

    # the dictionary stands where the first of its lines stood
    return [*others[:first], f"++{root}={','.join(map(written, trees))}", *others[first:]]


def dotted_options(line: str) -> dict[str, str]:
    """Return the option that an override sets, by its name, as typed; those in a dictionary each."""
    key, _, text = line.partition("=")
    override = parse_or_none(line)
    value = None if override is None else override.value()

    if key in OPEN and isinstance(value, dict):
        return dict(_leaves(key, value))

    return {key: value if isinstance(value, str) else text}


def _is_unreadable(line: str, root: str) -> bool:
    match = _LINE.fullmatch(line)
    names = match["inside"].split(".")[1:] if match and match["root"] == root else []
    return not all(_READABLE.fullmatch(name) for name in names)


def _is_merged(line: str, root: str) -> bool:
    match = _LINE.fullmatch(line)
    return match is not None and match["root"] == root and (not match["inside"] or _is_unreadable(line, root))


def _trees(line: str) -> list[dict[str, Any]]:
    match = _LINE.fullmatch(line)
    assert match is not None

    # the value alone: names that Hydra cannot read stand in the key
    override = OverridesParser.create().parse_override(f"{match['root']}={match['value']}")
    if not override.is_sweep_override():
        values: list[Any] = [override.value()]
    elif override.is_choice_sweep() or override.is_range_sweep():
        values = list(override.sweep_iterator())
    else:
        raise ConfigError(f"{line}: an interval is not taken for this name; give values: a,b,c")

    # the last name is the innermost
    for key in reversed(match["inside"].split(".")[1:]):
        values = [{key: value} for value in values]

    # a line without names below the option must bring them in its value
    trees = [value for value in values if isinstance(value, dict)]
    if len(trees) < len(values):
        root = match["root"]
        raise ConfigError(f"{line}: {root} must be named values, for example {OPEN[root]}")

    return trees


def _merged(tree: Any, other: Any) -> Any:
    if not (isinstance(tree, dict) and isinstance(other, dict)):
        return other
    return {**tree, **{key: _merged(tree.get(key), value) for key, value in other.items()}}


def written(value: Any) -> str:
    """Return a value in Hydra's grammar."""
    if isinstance(value, QuotedString):
        return str(value.with_quotes())
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, list):
        return "[" + ",".join(map(written, value)) + "]"
    if isinstance(value, dict):
        return (
            "{" + ",".join(f"{key_spelling(str(key))}:{written(item)}" for key, item in value.items()) + "}"
        )

    return show_value(value)


def _leaves(key: str, value: Any) -> Iterator[tuple[str, str]]:
    if not isinstance(value, dict):
        yield key, show_value(value)
        return

    for name, item in value.items():
        yield from _leaves(f"{key}.{key_name(str(name))}", item)
