"""ML-Agents' settings as they were given: values in their types, each with its place."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mappo_unity.config.mlagents.keys import FLAG, NUMBER, TEXT, WHOLE, Key
from mappo_unity.config.option_table import did_you_mean, show_value
from mappo_unity.errors import ConfigError


@dataclass(frozen=True)
class Given:
    """A value that somebody gave, and where: ``my.yaml, line 5: behaviors.Ball.max_steps``."""

    value: Any
    where: str


@dataclass
class Section:
    """Dotted keys that are given, above the defaults of a table."""

    table: Mapping[str, Key]
    given: dict[str, Given] = field(default_factory=dict)
    place: str = ""
    """Where the section itself stands, where it is one of a file."""

    def __getitem__(self, key: str) -> Any:
        return self.given[key].value if key in self.given else self.table[key].default

    def has(self, prefix: str) -> bool:
        """Return whether a section, or anything in it, is given and not null."""
        if prefix in self.given:
            return self.given[prefix].value is not None
        return any(key.startswith(f"{prefix}.") for key in self.given)

    def where(self, key: str) -> str:
        """Return where a key is given, or its name."""
        return self.given[key].where if key in self.given else key


@dataclass
class Settings:
    """A whole configuration; `behaviors` are merged with default_settings."""

    behaviors: dict[str, Section]
    default: Section | None
    """What behaviors have that the file does not name; None: there may be none."""
    run: Section
    parameters: dict[str, Given]
    """As the file has them, by name."""
    places: Callable[[str, str], str]
    """Where a parameter's key stands that an error names: ``places("mass", ".max=1 must be ...")``."""
    warnings: list[str]


def checked(value: Any, key: Key, where: str) -> Any:
    """Return a key's value in its type; raise ConfigError, which begins with `where`."""
    if value is None and key.optional:
        return None

    if key.kind == FLAG:
        fits = isinstance(value, bool)
    elif key.kind in (WHOLE, NUMBER):
        number = as_number(value)
        fits = number is not None and (key.kind == NUMBER or number.is_integer())
        if fits and number is not None:
            value = number if key.kind == NUMBER else int(number)
    elif key.kind == TEXT:
        fits = isinstance(value, (str, int, float)) and not isinstance(value, bool)
        value = str(value) if fits else value
    else:
        value = value.split() if isinstance(value, str) else value
        fits = isinstance(value, list)
        value = [str(item) for item in value] if fits else value

    if not fits:
        raise ConfigError(f"{where} must be {key.kind}, and is {_shown(value)}")
    if key.choices and value not in key.choices:
        hint = did_you_mean(value, key.choices)
        raise ConfigError(f"{where}: {value} does not exist{hint}; choices: {', '.join(key.choices)}")
    return value


def as_number(value: Any) -> float | None:
    """Return a number or a text that is one as a finite number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    try:
        number = float(value)  # YAML takes 5e5 for a text
    except (ValueError, OverflowError):  # of a whole number of hundreds of digits
        return None
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, str) else show_value(value)
