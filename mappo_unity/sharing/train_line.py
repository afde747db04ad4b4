"""A run's options as the command line that trains the same again."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mappo_unity.config.behavior_lines import OPEN
from mappo_unity.config.compose import compose_config
from mappo_unity.config.option_table import option_table, show_value
from mappo_unity.config.overrides import shell_argument, shell_word
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Config

_PLACE = ("env.name", "output_dir", "resume")
"""Options that the line says otherwise, or that are about a place on somebody's machine; as are log.*"""


def train_line(config: Config) -> str:
    """Return `mappo-train` with the options that differ from those of the environment's preset."""
    preset = config.env.name if config.env.name in group_choices()["env"] else config.env.backend.value
    preset = preset if preset in group_choices()["env"] else "unity"
    base = compose_config([f"env={preset}"]).config

    words = [shell_argument("env", preset)]
    for key, option in option_table(Config).items():
        if option.is_section or key in _PLACE or key.startswith("log."):
            continue
        value, usual = _value(config, key), _value(base, key)
        if key in OPEN:
            words += [_word(name, item) for name, item in _changes(key, usual, value)]
        elif value != usual:
            words.append(_word(key, value))
    return " ".join(["mappo-train", *words])


def _value(config: Config, key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part)
    return value


def _changes(key: str, usual: dict[str, Any], value: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the full name and the value of what stands otherwise below an open option."""
    for name, item in value.items():
        known = usual.get(name)
        if isinstance(item, dict) and isinstance(known, dict):
            yield from _changes(f"{key}.{name}", known, item)
        elif item != known or name not in usual:
            yield f"{key}.{name}", item


def _word(key: str, value: Any) -> str:
    return shell_argument(key, value) if isinstance(value, str) else shell_word(f"{key}={show_value(value)}")
