"""Hydra's override grammar, and the checks of single overrides such as ``ppo.lr=1e-4``."""

from __future__ import annotations

import importlib.util
import math
import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, IntervalSweep, Override, RangeSweep
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mappo_unity.config.behavior_lines import to_hydra_syntax
from mappo_unity.config.extras import SWEEP_EXTRA, install_command
from mappo_unity.config.option_table import Option, did_you_mean, find_option, option_table, show_value
from mappo_unity.config.presets import describe_choices, hint_of_installed_scene, hint_of_word
from mappo_unity.config.schema import Config
from mappo_unity.config.text_lines import LINE, parse_or_none, quoted_path
from mappo_unity.errors import ConfigError

LARGEST = 2**63 - 1
"""The largest whole number that files and tensors hold."""


def last_value(lines: list[str], key: str) -> Any:
    """Return the value that the overrides give to a key (the last one), or None."""
    values = [item.value() for item in parse(lines) if item.key_or_group == key and not item.is_delete()]
    return _unescaped(values[-1]) if values else None


def _unescaped(value: Any) -> Any:
    """Return a text without the backslashes that keep ``${`` from being an interpolation."""
    is_escaped = isinstance(value, str) and re.search(r"\\\$\{", value)
    return OmegaConf.create({"text": value})["text"] if is_escaped else value


def given_options(lines: list[str]) -> list[str]:
    """Return the full names of the options that the overrides set."""
    return list(dict.fromkeys(item.key_or_group for item in parse(lines) if not item.is_delete()))


def parse(lines: list[str]) -> list[Override]:
    """Parse overrides in Hydra's grammar; raise ConfigError for a line that is not one."""
    return [_parse_line(line) for line in lines]


def add_plus_prefix(line: str) -> str:
    """Let new names below an open option do without Hydra's plus signs: ``env.params.mass=2``."""
    line = to_hydra_syntax(line)
    match = LINE.fullmatch(line)
    option = find_option(option_table(Config), match["key"]) if match else None
    is_new = match is not None and match["prefix"] is None and option is not None and option.is_open
    return f"++{line}" if is_new else line


def check_overrides(
    lines: list[str], schema: type, groups: dict[str, list[str]], sweep: bool = False
) -> None:
    """Check names, grammar, choices and types of overrides; `sweep` allows several values.

    Raises ConfigError at the first mistake.
    """
    for line in lines:
        override = _parse_line(line)
        key = override.key_or_group

        if isinstance(override.value(), Glob):
            raise ConfigError(f"{line}: glob chooses presets (env, recipe); give {key}'s values: {key}=a,b,c")
        if override.is_sweep_override() and not groups:
            raise ConfigError(f"{line}: {key} takes one value here; only mappo-train -m takes several")
        if override.is_sweep_override() and not sweep:
            raise ConfigError(
                f"{line}: several values for {key} make a sweep, which needs -m "
                f"(mappo-train -m {shell_word(line)})"
            )

        # Hydra's own options are not in our table: only a few rules of theirs are checked
        if key.startswith(("hydra.", "hydra/")) and groups:
            _check_hydra(override, line)
            continue
        if key in groups:
            _check_choice(override, groups[key])
            continue
        _check_option(override, line, schema, groups)


def range_length(override: Override) -> int:
    """Return how many values a range has; raise ConfigError for one without end."""
    value = override.value()
    assert isinstance(value, RangeSweep) and value.start is not None and value.stop is not None

    if not value.step or not all(map(math.isfinite, (value.start, value.stop, value.step))):
        steps = f"from {value.start} to {value.stop} in steps of {value.step}"
        raise ConfigError(f"{override.input_line}: the range has no end ({steps})")

    # stop is not one of the values, as in Python's range
    return max(0, math.ceil((value.stop - value.start) / value.step))


def check_value(key: str, value: Any, schema: type) -> None:
    """Check the name and the type of an option's value, or of all in a section; raise ConfigError."""
    table = option_table(schema)
    option = find_option(table, key)
    if option is None:
        raise ConfigError(_unknown(key, table, {}))

    if option.is_section:
        if not isinstance(value, dict):
            inside = ", ".join(_inside(key, table))
            raise ConfigError(f"{key}={show_value(value)}: {key} is a section; its options: {inside}")
        for name, item in value.items():
            check_value(f"{key}.{name}", item, schema)
    # an interpolation has no value before it is composed
    elif not (isinstance(value, str) and "${" in value):
        _check_type(key, value, option, schema)


def shell_argument(key: str, value: str | Path) -> str:
    """Return ``key=value`` as it is typed into a shell: quoted for Hydra and for the shell, where needed."""
    line = f"{key}={value}"
    override = parse_or_none(line)
    is_plain = override is not None and override.value() == str(value) and "${" not in line
    return shell_word(line if is_plain else f"{key}={quoted_path(value)}")


def shell_word(text: str | Path) -> str:
    """Return a text as one word of the system's shell."""
    return subprocess.list2cmdline([str(text)]) if os.name == "nt" else shlex.quote(str(text))


def _parse_line(line: str) -> Override:
    if line.partition("=")[0] in ("-sc", "--shell-completion"):  # Hydra's
        raise ConfigError(
            f"{line} is not an option: --completion bash (or zsh, fish) prints a script for the shell"
        )
    if line.startswith("-"):
        raise ConfigError(
            f"{line} is not an option: settings are written option=value (seed=1); --help lists the few "
            "switches there are"
        )

    key = line.partition("=")[0].lstrip("+~")
    try:
        text = to_hydra_syntax(line)
        _check_form(text, line)
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        if not key.isascii():  # names of the user's own are readable by now
            raise ConfigError(f"{key} is not an option (--help describes them)") from error
        reason = str(error).splitlines()[0]
        raise ConfigError(
            f"{line} cannot be read ({reason}): a list is written [1,2], and a text with spaces or any of "
            f"=,:()[]{{}} stands in quotes inside quotes, {key}='\"like, this\"'"
        ) from error


def _check_form(text: str, line: str) -> None:
    match = LINE.fullmatch(text)
    if match is None:
        raise ConfigError(f"{line!r} is not of the form option=value (such as seed=1){hint_of_word(line)}")
    if match["rest"] is None and match["prefix"] != "~":
        raise ConfigError(f"{line} has no value: write {match['key']}=value{hint_of_word(line)}")


def _check_hydra(override: Override, line: str) -> None:
    key = override.key_or_group
    if override.is_sweep_override() and not key.startswith("hydra.sweeper.params"):
        raise ConfigError(f"{line}: {key} belongs to the sweep itself and has one value")
    if key.startswith("hydra/") and not isinstance(override.value(), str):
        choices = ", ".join(describe_choices(key)) or "see its documentation"
        raise ConfigError(f"{key}={show_value(override.value())} does not exist; choices: {choices}")

    if key == "hydra/sweeper" and override.value() != "basic":
        was = "hydra/sweeper=optuna was replaced by mappo-search" if "optuna" in line else "a sweep is a grid"
        raise ConfigError(f"{line}: {was}; type mappo-search search=ppo and the options of all trials")
    package, extra = SWEEP_EXTRA.get(line, ("", ""))
    if package and not is_installed(f"hydra_plugins.{package}"):
        raise ConfigError(
            f"{line} needs the package {package.replace('_', '-')}, which is not installed: "
            f"{install_command(extra)}"
        )


def is_installed(module: str) -> bool:
    """Return whether a module can be found, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # its parent package is missing
        return False


def _check_choice(override: Override, choices: list[str]) -> None:
    group = override.key_or_group
    if override.is_add() or override.is_force_add() or override.is_delete():
        name = override.value() if override.value() in choices else choices[-1]
        raise ConfigError(f"{override.input_line}: {group} is chosen without signs: {group}={name}")

    for value in _values(override):
        if isinstance(value, str) and value in choices or (value is None and group != "env"):
            continue
        name = show_value(value)
        hint = hint_of_installed_scene(group, name) or did_you_mean(name, choices)
        raise ConfigError(f"{group}={name} does not exist{hint}; choices: {', '.join(choices)}")


def _check_option(override: Override, line: str, schema: type, groups: dict[str, list[str]]) -> None:
    table, key = option_table(schema), override.key_or_group
    option = find_option(table, key)
    if option is None or override.package is not None:
        raise ConfigError(_unknown(key, table, groups))

    if override.is_delete():
        if not option.is_open or key == option.key:
            raise ConfigError(f"{line}: {key} cannot be deleted, only set: {key}=value")
        return
    for value in _values(override):
        check_value(key, value, schema)


def _check_type(key: str, value: Any, option: Option, schema: type) -> None:
    _check_size(key, value, option)
    # OmegaConf by itself takes numbers and words such as yes for true and false
    fits = not (option.type is bool and not isinstance(value, bool))
    # a name of the user's may be a number in one line and named values in the next
    tree = OmegaConf.structured(schema) if option.is_open else _scratch(schema)
    try:
        OmegaConf.update(tree, key, value, merge=True, force_add=option.is_open)
    except (OmegaConfBaseException, ValueError, OverflowError):
        fits = False
    if fits:
        return

    whole = isinstance(value, float) and value.is_integer()
    hint = f"; write {int(value)}" if whole and "whole number" in option.accepts else ""
    raise ConfigError(
        f"{key}={show_value(value)} does not fit: {key} must be {option.accepts}{hint} ({option.description})"
    )


def _check_size(key: str, value: Any, option: Option) -> None:
    """Refuse whole numbers that no counter holds; elsewhere they would end in a traceback."""
    for number in value if isinstance(value, list) else [value]:
        is_number = isinstance(number, (int, float)) and not isinstance(number, bool)
        if is_number and "whole number" in option.accepts and LARGEST < abs(number) < math.inf:
            raise ConfigError(
                f"{key}={show_value(value)} is out of range: whole numbers are at most {LARGEST} "
                f"({option.description})"
            )


@cache
def _scratch(schema: type) -> DictConfig:
    """Return a tree to try values on; what stands in it means nothing. Making one takes 10 ms."""
    return OmegaConf.structured(schema)


def _unknown(key: str, table: dict[str, Option], groups: dict[str, list[str]]) -> str:
    if key == "search":
        return f"{key} is not an option of this command: mappo-search takes it (mappo-search --help)"

    names = [name for name, option in table.items() if not option.is_section] + list(groups)
    sections = [f"{name}.*" for name, option in table.items() if option.is_section]
    inside = _inside(key.rpartition(".")[0], table)
    choices = ", ".join(inside or [name for name in names if "." not in name] + sections)
    return f"{key} is not an option{did_you_mean(key, names)}; choices: {choices} (--help describes them)"


def _inside(section: str, table: dict[str, Option]) -> list[str]:
    begin = f"{section}."
    return [name for name, option in table.items() if name.startswith(begin) and not option.is_section]


def _values(override: Override) -> Iterator[Any]:
    """Yield the values to check: all, but only the ends of an interval and of a range."""
    value = override.value()
    if isinstance(value, IntervalSweep):
        yield value.start
        yield value.end
    elif isinstance(value, RangeSweep):
        # a long range is not walked through: its ends have the type and the size of all
        number = range_length(override)
        if number:
            first: Any = value.start
            kind = int if all(isinstance(end, int) for end in (first, value.stop, value.step)) else float
            yield kind(first)
            yield kind(first + (number - 1) * value.step)
    elif override.is_sweep_override():
        yield from override.sweep_iterator()
    else:
        yield value
