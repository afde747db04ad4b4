"""Command lines with switches (mappo-player, mappo-doctor): argparse with our errors.

A mistake is a `ConfigError` of one line, which names the switch that is most like the one given.
"""

from __future__ import annotations

import argparse
import difflib
from typing import Any

from mappo_unity.errors import ConfigError


class Parser(argparse.ArgumentParser):
    """Parse switches; every mistake is a ConfigError, unknown switches with the names that are like them."""

    def error(self, message: str) -> Any:
        """Raise ConfigError: one line, without the usage."""
        raise ConfigError(f"{message.removeprefix('argument ')}; {self.prog} --help lists the options")

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Return the values; what is left over is a mistake."""
        values, rest = self.parse_known_args(args, namespace)
        if rest:
            self.error(f"{rest[0]} is not an option of {self.prog}{self.near(rest[0])}")
        return values

    def near(self, word: str) -> str:
        """Return " (did you mean --port?)" for a switch that is like one or two of ours, or an empty text."""
        names = [name for action in self._actions for name in action.option_strings if len(name) > 2]
        hits = difflib.get_close_matches(word.partition("=")[0], names, 2, 0.75)
        return f" (did you mean {' or '.join(hits)}?)" if hits else ""


class Once(argparse.Action):
    """Store a value; a second one is a mistake."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Store the value."""
        # a record of our own, since the namespace holds the defaults before anything is given
        given = vars(namespace).setdefault("given", {})
        if self.dest in given:
            parser.error(f"{option_string} is given twice, {given[self.dest]} and {values}: give it once")

        given[self.dest] = values
        setattr(namespace, self.dest, values)


def whole_number(text: str) -> int:
    """Return a text as a whole number; argparse tells the mistake."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def number(text: str) -> float:
    """Return a text as a number; argparse tells the mistake."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
