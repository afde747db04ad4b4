"""Checks of numbers on the command lines that take switches (mappo-player, mappo-doctor)."""

from __future__ import annotations

import math

from mappo_unity.errors import ConfigError


def check_range(name: str, value: int, low: int, high: int | None = None) -> None:
    """Raise ConfigError if the value of a command's option is out of range."""
    if value < low or (high is not None and value > high):
        rule = f"at least {low}" if high is None else f"from {low} to {high}"
        raise ConfigError(f"{name} {value} is out of range: it must be {rule}")


def check_duration(name: str, value_s: float) -> None:
    """Raise ConfigError if a number of seconds is not a finite one above 0."""
    if not 0 < value_s < math.inf:
        raise ConfigError(f"{name} {value_s:g} is out of range: it must be > 0 and finite")
