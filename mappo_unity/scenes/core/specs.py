"""What a scene declares: sensors, behaviors and environment parameters.

Declarations stand at the top of a scene's module; a `Behavior` makes the `BehaviorSpec` that ML-Agents shows.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from mlagents_envs.base_env import (
    ActionSpec,
    BehaviorSpec,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
)

from mappo_unity.config.option_table import show_value
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.images import ByteImage


@dataclass(frozen=True)
class Sensor:
    """Describe one sensor of a behavior; the order in `Behavior.sensors` is the order of `obs_i`.

    Sensors of one name share their frame stack, so an agent that moves between behaviors which list
    the same sensor keeps its frames.
    """

    name: str
    """Name without the stacking prefix, e.g. ``"RayPerceptionSensor"``."""
    shape: tuple[int, ...]
    """Shape of one frame, without agents and without stacking."""
    stack: int = 1
    """Frames shown at once, concatenated along the first axis, oldest first."""
    dimension_property: tuple[DimensionProperty, ...] | None = None
    """One flag a dimension; None: NONE for every dimension. Rows of varying number: (VARIABLE_SIZE, NONE)."""
    observation_type: ObservationType = ObservationType.DEFAULT
    """What is observed, or a goal signal."""
    in_bytes: bool = False
    """Whether every number is k / 255 for a byte k, as in a picture or a grid of 0 and 1: see `ByteImage`."""

    def spec(self) -> ObservationSpec:
        """Return the sensor as ML-Agents shows it, stacking included."""
        shape = (self.shape[0] * self.stack, *self.shape[1:])
        flags = self.dimension_property or (DimensionProperty.NONE,) * len(shape)
        name = self.name if self.stack == 1 else f"StackingSensor_size{self.stack}_{self.name}"
        kind = ByteImage if self.in_bytes else ObservationSpec
        return kind(shape, flags, self.observation_type, name)


@dataclass(frozen=True)
class Behavior:
    """Describe one behavior: its full name, its sensors and its actions."""

    name: str
    """Full name with the side, e.g. ``"SoccerTwos?team=1"``."""
    sensors: tuple[Sensor, ...]
    """Sensors in the order of the sheet (sorted by their full names)."""
    continuous: int = 0
    """Number of continuous actions."""
    branches: tuple[int, ...] = ()
    """Sizes of the discrete branches."""

    def spec(self) -> BehaviorSpec:
        """Return the behavior as ML-Agents shows it."""
        return BehaviorSpec(
            [sensor.spec() for sensor in self.sensors], ActionSpec(self.continuous, self.branches)
        )


@dataclass(frozen=True)
class Parameter:
    """Describe one float environment parameter: its default and its open lower bound."""

    default: float
    """Value used until another one is set."""
    above: float = -math.inf
    """Values must be greater than this."""
    at_once: bool = False
    """Whether the scene applies it at once, rather than reading it when an area is reset."""


def known_parameter(scene: str, known: Mapping[str, Parameter], name: str) -> Parameter:
    """Return a parameter, or raise `ConfigError` naming the parameters that `scene` has."""
    if name in known:
        return known[name]
    raise ConfigError(
        f"scene {scene} has no parameter {name!r}; choices: {', '.join(sorted(known)) or 'none'} "
        f"(besides num_areas and num_threads)"
    )


def _is_finite(value: numbers.Real) -> bool:
    try:
        return math.isfinite(float(value))
    except OverflowError:  # a whole number of hundreds of digits
        return False


def checked_parameter(scene: str, known: Mapping[str, Parameter], name: str, value: object) -> float:
    """Return `value` as a float; raise `ConfigError` unless it is a number that the parameter can have."""
    known_parameter(scene, known, name)
    if isinstance(value, bool) or not isinstance(value, numbers.Real) or not _is_finite(value):
        raise ConfigError(
            f"parameter {name}={show_value(value)} of scene {scene} must be a finite number (or, in options, "
            "a sampler {sampler: ...} or a curriculum {lessons: [...]})"
        )

    number = float(value)
    if number <= known[name].above:
        raise ConfigError(
            f"parameter {name}={value} of scene {scene} is out of range: it must be > {known[name].above:g}"
        )
    return number


def at_least_one(option: str, value: int, given: object) -> int:
    """Return `value` as an int, or raise `ConfigError` that shows what was `given`; 0 is no default."""
    if isinstance(given, bool) or not isinstance(value, (int, np.integer)) or value < 1 or given == 0:
        raise ConfigError(f"{option}={given!r} must be a whole number >= 1")
    return int(value)


def checked_seed(seed: int) -> int:
    """Return `seed` as an int, or raise `ConfigError`."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ConfigError(f"seed={seed!r} must be a whole number >= 0")
    return int(seed)
