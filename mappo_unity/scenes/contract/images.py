"""What an image or grid says of itself: where its channels stand, and whether bytes hold it.

``C, H, W`` or ``H, W, C``: ML-Agents marks height and width in a sensor's `dimension_property`
(TRANSLATIONAL_EQUIVARIANCE); what is left are the channels. Sensors that mark nothing have their channels
first, as in Unity's packages from 3.0 on; what older packages send is marked where it arrives
(`protocol.decode`).

Pictures that arrive as PNG, and grids of 0 and 1, hold multiples of 1 / 255 alone. A sensor whose spec is a
`ByteImage` is stored as bytes; networks and files read the floats that they stand for.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from mlagents_envs.base_env import BehaviorSpec, DimensionProperty, ObservationSpec

FIRST, LAST = 0, 2
"""The dimension of the channels."""

_FLAT = DimensionProperty.TRANSLATIONAL_EQUIVARIANCE


class ByteImage(ObservationSpec):
    """The spec of an image or grid whose numbers are all ``k / 255`` in float32, k a whole number to 255."""

    __slots__ = ()


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Return the uint8 ``k`` of numbers ``k / 255``, images ``[n, ...]``.

    Raises:
        ValueError: a number is none of these.
    """
    out = np.empty(image.shape, np.uint8)

    # row by row: what is worked on stays in the processor's cache
    with np.errstate(invalid="ignore"):
        for levels, row in zip(out, image):
            levels[...] = np.rint(row * np.float32(255))
            if not np.array_equal(from_bytes(levels), row):
                raise ValueError("its numbers are not all multiples of 1 / 255 from 0 to 1")
    return out


def from_bytes(image: np.ndarray) -> np.ndarray:
    """Return the float32 numbers that bytes stand for."""
    return np.divide(image, np.float32(255), dtype=np.float32)


def channel_dim(sensor: ObservationSpec) -> int | None:
    """Return the dimension of a sensor's channels, `FIRST` or `LAST`; None: it is no image."""
    if len(sensor.shape) != 3:
        return None
    flat = [bool(flag & _FLAT) for flag in sensor.dimension_property or ()]
    return LAST if flat == [True, True, False] else FIRST


def guessed_channel_dim(shape: tuple[int, ...] | list[int]) -> int | None:
    """Return what older versions took for it: the smaller of the first and the last dimension."""
    if len(shape) != 3:
        return None
    return LAST if shape[2] < shape[0] else FIRST


def looks_unmarked(sensor: ObservationSpec) -> bool:
    """Tell whether a sensor that marks nothing has the shape of an image with its channels last."""
    marked = any(flag & _FLAT for flag in sensor.dimension_property or ())
    return not marked and guessed_channel_dim(sensor.shape) == LAST


def sends_channels_last(handshake: Any) -> bool:
    """Tell whether a player lays unmarked images out as ``H, W, C``: Unity's packages before 3.0 did.

    Args:
        handshake: its UnityRLInitializationOutputProto, with the versions of protocol and package.
    """
    # protocol 1.5 came with package 2.0, and 3.0 kept it: then only the package tells
    numbers = [int(number) for number in re.findall(r"\d+", handshake.communication_version)[:2]]
    major = re.match(r"\d+", handshake.package_version)
    return numbers < [1, 5] or (major is not None and int(major.group()) in (1, 2))


def mark_channels_last(spec: BehaviorSpec) -> BehaviorSpec:
    """Return the spec with every image that marks no dimension marked as ``H, W, C``."""
    sensors = [
        sensor._replace(dimension_property=(_FLAT, _FLAT, DimensionProperty.NONE))
        if len(sensor.shape) == 3 and not any(sensor.dimension_property)
        else sensor
        for sensor in spec.observation_specs
    ]
    return spec._replace(observation_specs=sensors)
