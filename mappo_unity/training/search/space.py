"""Spaces to search, from YAML files: a range or a list of choices for each option.

ppo.lr: {low: 1e-4, high: 1e-2, log: true}
ppo.epochs: {low: 2, high: 8}
model.hidden: [[64, 64], [128, 128]]
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mappo_unity.config.option_table import did_you_mean, find_option, option_table, show_value, without_none
from mappo_unity.config.options_file import read_yaml
from mappo_unity.config.overrides import check_value
from mappo_unity.config.presets import conf_dir, group_choices
from mappo_unity.config.schema import Config
from mappo_unity.config.text_lines import literal_lines
from mappo_unity.errors import ConfigError

_FIXED = {
    "seed": "seeds=N averages over several",
    "max_steps": "it is the budget of all trials",
    "stop_at_return": "goal=N sets it",
    "output_dir": "out=FOLDER is the place of all trials",
    "resume": "trials are new runs",
}
"""What no space may vary, and why."""
_RANGE_KEYS = ("low", "high", "log")


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included; `log`: evenly in their logarithms; `whole`: integers."""

    low: float
    high: float
    log: bool
    whole: bool

    def written(self, value: Any) -> Any:
        """Return a value as a space has it: a number itself."""
        return value

    def holds(self, value: Any) -> bool:
        """Return whether a value lies in the range."""
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return is_number and self.low <= value <= self.high and not (self.whole and value != int(value))

    def ends(self) -> tuple[Any, Any]:
        """Return the first and the last value."""
        return self.low, self.high


@dataclass(frozen=True)
class Choices:
    """Values one of which is chosen, each as it is written on the command line."""

    values: tuple[str, ...]

    def written(self, value: Any) -> str:
        """Return a value as the list writes it, where it has it: 1 and 1.0 are one number."""
        text = show_value(value)
        if text not in self.values and isinstance(value, float):
            return next((own for own in self.values if _number(own) == value), text)
        return text

    def holds(self, value: Any) -> bool:
        """Return whether a value, as it is written, is one of them."""
        return value in self.values

    def ends(self) -> tuple[Any, Any]:
        """Return the first and the last value."""
        return self.values[0], self.values[-1]


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


Space = dict[str, "Range | Choices"]
"""The options that a search varies, and what each may be."""


def spaces() -> list[str]:
    """Return the names of the spaces in conf/search."""
    return sorted(path.stem for path in (conf_dir() / "search").glob("*.yaml"))


def read_space(name: str) -> Space:
    """Return the space of that name in conf/search, or the one in a YAML file.

    Raises:
        ConfigError: there is none, or it says something that cannot be searched.
    """
    path = Path(name)
    if path.suffix.lower() not in (".yaml", ".yml"):
        if name not in spaces():
            raise ConfigError(
                f"search={name} does not exist{did_you_mean(name, spaces())}; choices: {', '.join(spaces())}"
                ", or a file of your own: search=my_space.yaml"
            )
        path = conf_dir() / "search" / f"{name}.yaml"

    raw = read_yaml(path, missing=f"search={name}: there is no such file")
    if not isinstance(raw, dict) or not raw:
        raise ConfigError(f"{path} holds no options to search, such as ppo.epochs: {{low: 2, high: 8}}")
    try:
        return {str(key): _entry(str(key), value) for key, value in raw.items()}
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def to_line(key: str, value: Any) -> str:
    """Return an option's value, which a space gave, as a line of the command line."""
    return literal_lines([f"{key}={value if isinstance(value, str) else show_value(value)}"], Config)[0]


def _entry(key: str, raw: Any) -> Range | Choices:
    if key in _FIXED:
        raise ConfigError(f"{key} cannot be searched: {_FIXED[key]}")
    if key in group_choices():
        raise ConfigError(f"{key} chooses presets, which are not searched: give one on the command line")

    option = find_option(option_table(Config), key)
    if option is None:
        check_value(key, raw, Config)  # says which options there are
        raise AssertionError(key)
    if option.is_section:
        raise ConfigError(f"{key} is a section: name its options, {key}.NAME: {{low: 1, high: 2}}")

    if isinstance(raw, list):
        return _choices(key, raw)
    if isinstance(raw, dict):
        return _range(key, raw, without_none(option.type))
    raise ConfigError(
        f"{key}: {show_value(raw)} is neither a range, {{low: 1, high: 2}}, nor a list of choices, [1, 2]; "
        "one value belongs on the command line"
    )


def _choices(key: str, raw: list[Any]) -> Choices:
    for value in raw:
        check_value(key, value, Config)

    values = tuple(show_value(value) for value in raw)
    if len(values) < 2:
        raise ConfigError(
            f"{key}: {show_value(raw)} leaves nothing to choose: give two values or more; one value belongs "
            "on the command line"
        )
    if len(set(values)) < len(values):
        raise ConfigError(f"{key}: {show_value(raw)} names a value twice")
    return Choices(values)


def _range(key: str, raw: dict[Any, Any], kind: Any) -> Range:
    text = f"{key}: {show_value(raw)}"
    if kind not in (int, float) and not key.startswith(("env.params.", "behaviors.")):
        raise ConfigError(f"{text}: {key} is no number and has no range; give a list of choices")

    unknown = [str(name) for name in raw if name not in _RANGE_KEYS]
    if unknown or "low" not in raw or "high" not in raw:
        what = f"{unknown[0]} is unknown" if unknown else "low and high must be given"
        raise ConfigError(f"{text}: {what}; a range is written {{low: 1, high: 2, log: false}}")

    low, high, log = raw["low"], raw["high"], raw.get("log", False)
    for end in (low, high):
        is_number = isinstance(end, (int, float)) and not isinstance(end, bool)
        if not is_number or not abs(end) <= sys.float_info.max:
            raise ConfigError(f"{text}: {show_value(end)} is not a finite number")
        check_value(key, end, Config)

    if not isinstance(log, bool):
        raise ConfigError(f"{text}: log must be true or false")
    if low >= high:
        raise ConfigError(f"{text}: low must be less than high")
    if log and low <= 0:
        raise ConfigError(f"{text}: with log: true low must be > 0")

    whole = kind is int or (kind is not float and isinstance(low, int) and isinstance(high, int))
    return Range(low, high, log, whole) if whole else Range(float(low), float(high), log, whole)
