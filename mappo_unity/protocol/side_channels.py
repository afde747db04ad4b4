"""Side channels as a player reads them: environment parameters and engine settings.

The layout of the messages is that of the outgoing side in mlagents_envs.side_channel.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator
from typing import Any

import numpy as np
from mlagents_envs.side_channel import IncomingMessage

PARAMETERS = uuid.UUID("534c891e-810f-11ea-a9d0-822485860400")
"""EnvironmentParametersChannel."""
ENGINE = uuid.UUID("e951342c-4f7e-11ea-b238-784f4387d1f7")
"""EngineConfigurationChannel."""
ANALYTICS = uuid.UUID("b664a4a9-d86f-5a5f-95cb-e8353a7e8356")
"""DefaultTrainingAnalyticsSideChannel: says what trains; nothing to do."""

_ENGINE_SETTINGS = ("screen size", "quality level", "time scale", "target frame rate", "capture frame rate")


def split(data: bytes) -> Iterator[tuple[uuid.UUID, IncomingMessage]]:
    """Yield the messages packed in `data`, each with its channel; raises ValueError."""
    at = 0
    while at < len(data):
        if len(data) < at + 20:
            raise ValueError(f"{len(data) - at} bytes are left, a side-channel message has at least 20")

        # A .NET Guid, the length as an int32, the content.
        channel = uuid.UUID(bytes_le=data[at : at + 16])
        (size,) = struct.unpack_from("<i", data, at + 16)
        if size < 0 or len(data) < at + 20 + size:
            raise ValueError(
                f"a message of channel {channel} claims {size} bytes, {len(data) - at - 20} left"
            )

        yield channel, IncomingMessage(data[at + 20 : at + 20 + size])
        at += 20 + size


def read_parameter(message: IncomingMessage) -> tuple[str, float]:
    """Return name and value of an environment parameter; a sampler is drawn from once, with its seed."""
    name = message.read_string()
    if message.read_int32() == 0:
        return name, message.read_float32()

    # A sampler: its seed, its kind, its numbers.
    rng = np.random.default_rng(message.read_int32() & 0x7FFFFFFF)

    kind = message.read_int32()
    if kind == 0:
        return name, float(rng.uniform(message.read_float32(), message.read_float32()))
    if kind == 1:
        return name, float(rng.normal(message.read_float32(), message.read_float32()))

    # Several intervals: the wider one is, the likelier.
    ends = np.array(message.read_float32_list()).reshape(-1, 2)
    widths = ends[:, 1] - ends[:, 0]
    low, high = ends[rng.choice(len(ends), p=widths / widths.sum())]
    return name, float(rng.uniform(low, high))


def read_engine_setting(message: IncomingMessage) -> str:
    """Return an engine setting in words, for the log."""
    kind = message.read_int32()
    values: dict[int, Any] = {0: lambda: f"{message.read_int32()} x {message.read_int32()}"}
    value = values.get(kind, message.read_float32 if kind == 2 else message.read_int32)()

    name = _ENGINE_SETTINGS[kind] if kind < len(_ENGINE_SETTINGS) else f"setting {kind}"
    return f"{name} {value}"
