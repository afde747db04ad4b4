"""A value of an environment parameter: a number, or the distribution that an episode's number is drawn from.

The distributions, their names and their defaults are ML-Agents' (trainers/settings.py,
ParameterRandomizationSettings); its longer keys are read too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from mappo_unity.config.option_table import did_you_mean, show_value
from mappo_unity.errors import ConfigError

KINDS = ("uniform", "gaussian", "multirangeuniform")
"""The distributions, in the order of their numbers on ML-Agents' side channel."""
SAMPLER = "sampler"

_DEFAULTS: dict[str, dict[str, Any]] = {
    "uniform": {"min": 0.0, "max": 1.0},
    "gaussian": {"mean": 1.0, "st_dev": 1.0},
    "multirangeuniform": {"intervals": [[0.0, 1.0]]},
    "constant": {"value": 0.0},
}
_SPELLINGS = {"sampler_type": SAMPLER, "min_value": "min", "max_value": "max"}
_EXAMPLE = "{sampler: uniform, min: 0.5, max: 10}"
_LARGEST_SEED = 2**31 - 1


@dataclass(frozen=True)
class Sampler:
    """A distribution of numbers.

    `numbers`: min and max (uniform), mean and standard deviation (gaussian), or the ends of the intervals one
    after another (multirangeuniform: the wider an interval, the likelier). `seed`: of its draws; None: the
    environment's, plus `order`, the sampler's place among those of the options.
    """

    kind: str
    numbers: tuple[float, ...]
    seed: int | None = None
    order: int = 0

    def seed_within(self, env_seed: int) -> int:
        """Return the seed of its draws in an environment of this seed, 0 to 2^31 - 1."""
        return (env_seed + self.order) % 2**31 if self.seed is None else self.seed

    @property
    def lowest(self) -> float:
        """The least number that is drawn; of a Gaussian its mean, as the draws below a bound are repeated."""
        return min(self.numbers) if self.kind != "gaussian" else self.numbers[0]

    def __str__(self) -> str:
        if self.kind == "gaussian":
            return "gaussian, mean {:g}, st_dev {:g}".format(*self.numbers)
        ends = zip(self.numbers[::2], self.numbers[1::2])
        return f"{self.kind} " + ", ".join(f"{low:g} to {high:g}" for low, high in ends)


Value = float | Sampler
"""What a parameter has at a time."""


def is_sampler(raw: Any) -> bool:
    """Return whether an option's value is meant as a sampler."""
    return isinstance(raw, dict) and any(_SPELLINGS.get(str(key), key) == SAMPLER for key in raw)


def read_value(where: str, raw: Any) -> Value:
    """Return a number or a sampler as its option writes it.

    Raises:
        ConfigError: it is neither; begins with `where`.
    """
    if isinstance(raw, dict):
        return _sampler(where, raw)
    return read_number(where, raw, f"a number, or a sampler such as {_EXAMPLE}")


def read_number(where: str, raw: Any, wanted: str = "a number") -> float:
    """Return a finite number; raise ConfigError, which says what is `wanted`."""
    if isinstance(raw, bool) or not isinstance(raw, (int, float)):
        raise ConfigError(f"{where}={show_value(raw)} must be {wanted}")
    try:
        number = float(raw)
    except OverflowError:  # a whole number of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ConfigError(f"{where}={show_value(raw)} must be finite")
    return number


def check_keys(where: str, raw: dict[Any, Any], known: Iterable[str]) -> None:
    """Raise ConfigError for a key that is not known."""
    for key in raw:
        if key not in known:
            hint = did_you_mean(str(key), known)
            raise ConfigError(f"{where}.{key}: there is no such key{hint}; keys: {', '.join(known)}")


def respelled(raw: dict[Any, Any], spellings: dict[str, str]) -> dict[Any, Any]:
    """Return a dictionary with our keys in place of ML-Agents'."""
    return {spellings.get(str(key), key): item for key, item in raw.items()}


def _sampler(where: str, raw: dict[Any, Any]) -> Value:
    inside = raw.get("sampler_parameters") or {}
    if not isinstance(inside, dict):
        raise ConfigError(f"{where}.sampler_parameters={show_value(inside)} must be named values")
    rest = {key: item for key, item in raw.items() if key != "sampler_parameters"}
    raw = respelled(rest | inside, _SPELLINGS)

    kind = raw.get(SAMPLER)
    if kind is None:
        raise ConfigError(f"{where}={show_value(raw)} names no sampler: write {_EXAMPLE}")
    if not isinstance(kind, str) or kind not in _DEFAULTS:
        hint = did_you_mean(str(kind), _DEFAULTS)
        choices = ", ".join(_DEFAULTS)
        raise ConfigError(f"{where}.sampler={show_value(kind)} does not exist{hint}; choices: {choices}")

    check_keys(where, raw, [SAMPLER, *_DEFAULTS[kind], "seed"])
    given = _DEFAULTS[kind] | raw
    seed = _seed(where, raw.get("seed"))

    if kind == "multirangeuniform":
        return Sampler(kind, _intervals(f"{where}.intervals", given["intervals"]), seed)

    numbers = tuple(read_number(f"{where}.{key}", given[key]) for key in _DEFAULTS[kind])
    if kind == "constant":
        return numbers[0]
    if kind == "uniform" and numbers[0] > numbers[1]:
        raise ConfigError(f"{where}.min={numbers[0]:g} must not be above max={numbers[1]:g}")
    if kind == "gaussian" and numbers[1] < 0:
        raise ConfigError(f"{where}.st_dev={numbers[1]:g} is out of range: it must be >= 0")
    return Sampler(kind, numbers, seed)


def _seed(where: str, raw: Any) -> int | None:
    # -1 is how ML-Agents writes that no seed is given
    if raw is None or (raw == -1 and not isinstance(raw, bool)):
        return None
    if isinstance(raw, bool) or not isinstance(raw, int) or not 0 <= raw <= _LARGEST_SEED:
        raise ConfigError(
            f"{where}.seed={show_value(raw)} must be a whole number from 0 to {_LARGEST_SEED}, or -1: none"
        )
    return raw


def _intervals(where: str, raw: Any) -> tuple[float, ...]:
    is_pairs = isinstance(raw, list) and all(isinstance(item, list) and len(item) == 2 for item in raw)
    if not raw or not is_pairs:
        raise ConfigError(
            f"{where}={show_value(raw)} must be a list of intervals [min, max], for example [[1, 2], [5, 8]]"
        )

    ends = tuple(read_number(where, end) for interval in raw for end in interval)
    for low, high in zip(ends[::2], ends[1::2]):
        if low > high:
            raise ConfigError(f"{where}: in [{low:g}, {high:g}] the first end must not be above the second")
    if all(low == high for low, high in zip(ends[::2], ends[1::2])):
        raise ConfigError(f"{where}={show_value(raw)} has no interval that is wider than 0")
    return ends
