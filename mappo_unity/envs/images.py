"""Observations in the types in which slots and batches hold them: images of bytes as bytes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mlagents_envs.base_env import BehaviorSpec

from mappo_unity.scenes.contract.images import ByteImage, from_bytes, to_bytes
from mappo_unity.scenes.contract.rules import EnvironmentDataError, sensor_name


def stored_types(spec: BehaviorSpec) -> list[type]:
    """Return the type of each sensor's arrays: uint8 of a `ByteImage`, float32 of all others."""
    return [np.uint8 if isinstance(sensor, ByteImage) else np.float32 for sensor in spec.observation_specs]


def as_stored(behavior: str, spec: BehaviorSpec, observations: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return observations of all sensors in their types, also those that were stored in the other one.

    Raises:
        EnvironmentDataError: a `ByteImage` holds numbers that bytes do not.
    """
    out = []
    for index, (values, kind) in enumerate(zip(observations, stored_types(spec), strict=True)):
        if values.dtype != kind:
            try:
                values = to_bytes(values) if kind is np.uint8 else from_bytes(values)
            except ValueError as error:
                raise EnvironmentDataError(
                    f"behavior {behavior!r}: sensor {sensor_name(spec, index)} is a ByteImage, but {error}"
                ) from error
        out.append(values)
    return out
