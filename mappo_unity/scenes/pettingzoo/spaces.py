"""Gymnasium's spaces as ML-Agents' specs: observations as sensors, actions as numbers and branches.

An agent's observation space is read once, into a list of `Sensor`s; its action space into `Actions`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from mlagents_envs.base_env import ActionSpec, DimensionProperty, ObservationSpec, ObservationType

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.images import ByteImage, from_bytes

MASK = "action_mask"
"""In an observation that is a dict, and in infos: the actions that are allowed, which is no sensor."""

_FLAT = DimensionProperty.TRANSLATIONAL_EQUIVARIANCE
_NONE = DimensionProperty.NONE


@dataclass(frozen=True)
class Sensor:
    """One sensor of an agent, and how to read it from an observation."""

    spec: ObservationSpec
    path: tuple[Any, ...]  # keys of dicts and numbers of tuples that lead to it
    encode: Callable[[Any], np.ndarray]  # what stands there, as float32 of the sensor's shape

    def read(self, observation: Any) -> np.ndarray:
        """Return the sensor's numbers, float32 of its shape."""
        for key in self.path:
            observation = observation[key]
        return self.encode(observation).reshape(self.spec.shape)


def read_sensors(space: Any, where: str) -> list[Sensor]:
    """Return the sensors of an observation space; a dict's and a tuple's parts are sensors of their own.

    Raises:
        ConfigError: a part is of a kind that no sensor can hold; `where` begins the message.
    """
    sensors = [_sensor(part, path, where) for path, part in _parts(space, ())]
    if not sensors:
        raise ConfigError(f"{where}: its observation space {space} has no part to observe")
    return sensors


def _parts(space: Any, path: tuple[Any, ...]) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            if not (path == () and key == MASK):
                yield from _parts(part, (*path, key))
    elif isinstance(space, spaces.Tuple):
        for number, part in enumerate(space.spaces):
            yield from _parts(part, (*path, number))
    else:
        yield path, space


def _sensor(space: Any, path: tuple[Any, ...], where: str) -> Sensor:
    name = "/".join(map(str, path)) or "observation"

    if isinstance(space, spaces.Box):
        is_bytes = space.dtype == np.uint8
        spec = _box_spec(name, tuple(space.shape), is_bytes)
        return Sensor(spec, path, _encode_bytes if is_bytes else _encode_numbers)

    if isinstance(space, spaces.Discrete):
        first, size = int(space.start), int(space.n)
        return Sensor(_vector(name, size), path, lambda value: _one_hot([int(value) - first], [size]))

    if isinstance(space, spaces.MultiDiscrete):
        firsts, sizes = np.asarray(space.start).ravel(), [int(n) for n in np.asarray(space.nvec).ravel()]
        return Sensor(
            _vector(name, sum(sizes)), path, lambda value: _one_hot(np.asarray(value).ravel() - firsts, sizes)
        )

    if isinstance(space, spaces.MultiBinary):
        return Sensor(_vector(name, int(np.prod(space.shape))), path, _encode_numbers)

    raise ConfigError(
        f"{where}: its observation space has {name} = {space}, of which no sensor can be made; there are "
        "Box, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these"
    )


def _box_spec(name: str, shape: tuple[int, ...], is_bytes: bool) -> ObservationSpec:
    if is_bytes and len(shape) == 2:
        shape = (1, *shape)  # a picture in grey
    if len(shape) != 3:
        return _vector(name, int(np.prod(shape)))

    # Gymnasium's pictures mostly have their channels last: few of them, and more rows
    last = shape[2] < shape[0]
    marks = (_FLAT, _FLAT, _NONE) if last else (_NONE, _FLAT, _FLAT)
    return (ByteImage if is_bytes else ObservationSpec)(shape, marks, ObservationType.DEFAULT, name)


def _vector(name: str, size: int) -> ObservationSpec:
    return ObservationSpec((size,), (_NONE,), ObservationType.DEFAULT, name)


def _encode_numbers(value: Any) -> np.ndarray:
    return np.asarray(value, np.float32)


def _encode_bytes(value: Any) -> np.ndarray:
    given = np.asarray(value)
    levels = given.astype(np.uint8)
    if given.dtype != np.uint8 and not np.array_equal(levels, given):
        raise ValueError("it holds numbers other than 0, 1, ..., 255")
    return from_bytes(levels)


def _one_hot(numbers: Any, sizes: list[int]) -> np.ndarray:
    hot = np.zeros(sum(sizes), np.float32)
    start = 0
    for number, size in zip(numbers, sizes, strict=True):
        if not 0 <= number < size:
            raise ValueError(f"one of its numbers is none of the {size} that there are")
        hot[start + int(number)] = 1
        start += size
    return hot


class Actions:
    """An agent's action space: the ML-Agents spec of it, and its own actions from rows of that spec.

    Boxes become continuous numbers, -1 to 1 over a box's bounds (where it has none, the numbers themselves);
    each choice becomes a discrete branch. Dicts and tuples hold both.
    """

    def __init__(self, space: Any, where: str) -> None:
        self._space, self._where = space, where
        self._leaves = [part for _, part in _parts(space, ())]
        for part in self._leaves:
            self._check(part)

        boxes = [part for part in self._leaves if isinstance(part, spaces.Box)]
        self.branches = [size for part in self._leaves for size in _sizes(part)]
        self.spec = ActionSpec(sum(int(np.prod(box.shape)) for box in boxes), tuple(self.branches))
        if not self.spec.continuous_size and not self.branches:
            raise ConfigError(f"{where}: its action space {space} has nothing to choose")

    def _check(self, part: Any) -> None:
        kinds = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
        if not isinstance(part, kinds) or isinstance(part, spaces.Box) and part.dtype.kind != "f":
            raise ConfigError(
                f"{self._where}: its action space has {part}, of which no action can be made; there are Box "
                "of floats, Discrete, MultiDiscrete, MultiBinary, and Dict and Tuple of these"
            )

    def decode(self, continuous: np.ndarray, discrete: np.ndarray) -> Any:
        """Return the space's action of one agent's row: float32 ``[C]`` and int32 ``[B]``."""
        return self._take(self._space, [continuous, discrete])

    def _take(self, space: Any, rows: list[np.ndarray]) -> Any:
        """Return a part's action, and take its numbers off the rows."""
        if isinstance(space, spaces.Dict):
            return {key: self._take(part, rows) for key, part in space.spaces.items()}
        if isinstance(space, spaces.Tuple):
            return tuple(self._take(part, rows) for part in space.spaces)

        if isinstance(space, spaces.Box):
            size = int(np.prod(space.shape))
            own, rows[0] = rows[0][:size], rows[0][size:]
            return _scaled(space, own.reshape(space.shape))

        count = len(_sizes(space))
        own, rows[1] = rows[1][:count], rows[1][count:]
        if isinstance(space, spaces.Discrete):
            return space.dtype.type(own[0] + space.start)
        start = space.start if isinstance(space, spaces.MultiDiscrete) else 0
        return (own.reshape(space.shape) + start).astype(space.dtype)

    def forbidden(self, mask: Any) -> list[np.ndarray]:
        """Return a flag for each action of each branch, True = forbidden.

        Args:
            mask: as Gymnasium's `sample` takes it, 1 = allowed: an array for a `Discrete`, a tuple of arrays
                for a `MultiDiscrete`; or all branches' flags in one array.

        Raises:
            ConfigError: it does not fit the branches.
        """
        try:
            parts = mask if isinstance(mask, tuple | list) else [mask]
            flat = np.concatenate([np.asarray(part).ravel() for part in parts])
        except (TypeError, ValueError):
            flat = np.zeros(0)
        if flat.shape != (sum(self.branches),) or flat.dtype.kind not in "biu":
            raise ConfigError(
                f"{self._where}: its {MASK} is {mask!r}; it must hold a flag (1 = allowed) for each of the "
                f"{' + '.join(map(str, self.branches)) or 'no'} actions"
            )

        return np.split(flat == 0, np.cumsum(self.branches)[:-1])


def _sizes(space: Any) -> list[int]:
    """Return the branches of a part of an action space."""
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return [int(n) for n in np.asarray(space.nvec).ravel()]
    if isinstance(space, spaces.MultiBinary):
        return [2] * int(np.prod(space.shape))
    return []


def _scaled(box: spaces.Box, numbers: np.ndarray) -> np.ndarray:
    numbers = np.clip(numbers, -1, 1)
    bounded = np.isfinite(box.low) & np.isfinite(box.high)
    low, high = np.where(bounded, box.low, -1.0), np.where(bounded, box.high, 1.0)
    # a number without two bounds may have one
    scaled = low + (numbers + 1) / 2 * (high - low)
    return np.clip(scaled, box.low, box.high).astype(box.dtype)
