"""Rules for the values of options; what breaks one raises ConfigError with option, value and rule."""

from __future__ import annotations

import math
from typing import Optional

from mappo_unity.errors import ConfigError


def rule(option: str, value: float | None, holds: bool, text: str) -> None:
    """Refuse a number for which a rule does not hold, or that is not finite; null is not looked at."""
    if value is not None and not (math.isfinite(value) and holds):
        if not math.isfinite(value) and "finite" not in text:
            text += ", and finite"
        raise ConfigError(f"{option}={value} is out of range: {option} {text}")


def at_least(option: str, value: float | None, low: float) -> None:
    """Refuse a number below a bound."""
    rule(option, value, value is None or value >= low, f"must be >= {low}")


def above(option: str, value: float | None, low: float) -> None:
    """Refuse a number that is not above a bound."""
    rule(option, value, value is None or value > low, f"must be > {low}")


def at_most(option: str, value: float | None, high: float) -> None:
    """Refuse a number above a bound."""
    rule(option, value, value is None or value <= high, f"must be <= {high:g}")


def within(option: str, value: float | None, low: float, high: float) -> None:
    """Refuse a number outside a range; both ends belong to it."""
    rule(option, value, value is None or low <= value <= high, f"must be from {low} to {high}")


def between(option: str, value: float, low: float, high: float) -> None:
    """Refuse a number outside a range to which its ends do not belong."""
    rule(option, value, low < value < high, f"must be between {low} and {high}, exclusive")


def widths(option: str, value: list[int]) -> None:
    """Refuse a list of layers' widths that is empty, or has a width below 1."""
    if not value or any(width < 1 for width in value):
        raise ConfigError(
            f"{option}={list(value)} must be a list of at least one width, each >= 1, "
            f"for example {option}=[128,128]"
        )


def not_empty(**options: Optional[str]) -> None:
    """Refuse texts, by option, that were given without anything in them."""
    for name, value in options.items():
        if value == "":
            raise ConfigError(f"{name}= is empty: give it a value, or leave it out")
