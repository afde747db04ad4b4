"""Options that had another name before: the old one keeps working, with a note."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

RENAMED = {"log.backends": "log.loggers"}
"""Old name to today's name."""


def rename_lines(lines: list[str], note: Callable[[str], None] = lambda text: None) -> list[str]:
    """Return override lines with today's names; `note` is told of each that had an old one."""
    out = []

    for line in lines:
        prefix = line[: len(line) - len(line.lstrip("+~"))]
        key, equals, value = line[len(prefix) :].partition("=")
        if key in RENAMED:
            note(f"note: {key} is called {RENAMED[key]} now")
        out.append(f"{prefix}{RENAMED.get(key, key)}{equals}{value}")

    return out


def rename_keys(options: dict[Any, Any]) -> dict[Any, Any]:
    """Return a file's options, nested (log: {backends: ...}) or dotted (log.backends), with today's names."""
    for old, new in RENAMED.items():
        if old in options:
            # in front: where both names stand, today's wins, dotted or nested
            options = {new: options[old]} | {key: value for key, value in options.items() if key != old}

        section, _, name = old.partition(".")
        inside = options.get(section)
        if isinstance(inside, dict) and name in inside:
            # where both names stand, today's wins
            kept = {key: value for key, value in inside.items() if key != name}
            options = options | {section: {new.partition(".")[2]: inside[name]} | kept}

    return options
