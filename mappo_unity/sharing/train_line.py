"""A run's options as the command line that trains the same again."""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter
from typing import Any

from mappo_unity.config.behavior_lines import OPEN
from mappo_unity.config.compose import compose_config
from mappo_unity.config.option_table import option_table, show_value
from mappo_unity.config.overrides import shell_argument, shell_word
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Backend, Config
from mappo_unity.config.text_lines import quoted_path

_PLACE = ("output_dir", "resume")
"""Options about a place on somebody's machine; as are log.*"""
_BACKENDS = {"unity": Backend.player, "custom": Backend.custom}
"""Of the presets that are no embedded scenes."""
_SOURCE = ("env.backend", "env.file_name", "env.factory")
"""Options that say what is opened, without which some presets do not compose."""


def train_line(config: Config) -> str:
    """Return `mappo-train` with the options that differ from those of the environment's preset."""
    choices = group_choices()["env"]
    fallback = "custom" if config.env.factory is not None else "unity"
    preset = config.env.name if config.env.name in choices else fallback

    source = {key: attrgetter(key)(config) for key in _SOURCE}
    given = [_line(key, value) for key, value in source.items() if value is not None]
    base = compose_config([f"env={quoted_path(preset)}", *given]).config

    words = [shell_argument("env", preset), *(_word(key, source[key]) for key in _SOURCE[1:] if source[key])]
    if config.env.backend is not _BACKENDS.get(preset, Backend.embedded):
        words.append(_word("env.backend", config.env.backend))

    for key, option in option_table(Config).items():
        if option.is_section or key in (*_PLACE, *_SOURCE) or key.startswith("log."):
            continue
        value, usual = attrgetter(key)(config), attrgetter(key)(base)
        if key in OPEN:
            words += [_word(name, item) for name, item in _changes(key, usual, value)]
        elif value != usual:
            words.append(_word(key, value))
    return " ".join(["mappo-train", *words])


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


def _line(key: str, value: Any) -> str:
    return f"{key}={quoted_path(value) if isinstance(value, str) else show_value(value)}"
