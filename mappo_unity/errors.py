"""The errors that a user sees as one line; the exit code follows from their type."""

from __future__ import annotations


class ConfigError(ValueError):
    """A mistake in the options; the message names the option, its value and the rule.

    `details`: lines to print below it, such as a traceback of the user's code.
    """

    details: tuple[str, ...] = ()


class EnvironmentFailure(RuntimeError):
    """An environment that ran has failed for good; the message says how, and where its log is.

    `details`: lines to print below it, such as a traceback of the user's code.
    """

    details: tuple[str, ...] = ()
