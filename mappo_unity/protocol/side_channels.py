"""Side channels: environment parameters as a trainer sends them, and what a player reads of them.

The layout of the messages is that of the outgoing side in mlagents_envs.side_channel.
"""

from __future__ import annotations

import struct
import uuid
from collections.abc import Iterator
from typing import Any

from mlagents_envs.side_channel import IncomingMessage
from mlagents_envs.side_channel.environment_parameters_channel import EnvironmentParametersChannel

from mappo_unity.config.parameters.samplers import KINDS, SAMPLER, Sampler, Value, read_value

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


class ParametersChannel(EnvironmentParametersChannel):
    """Environment parameters on their way to a player; sent with its next step, the newest last."""

    def send(self, name: str, value: Value, seed: int) -> None:
        """Send a number, or a sampler from which the player draws; `seed`: the player's."""
        if not isinstance(value, Sampler):
            self.set_float_parameter(name, value)
            return

        own_seed = value.seed_within(seed)
        if value.kind == "uniform":
            self.set_uniform_sampler_parameters(name, *value.numbers, own_seed)
        elif value.kind == "gaussian":
            self.set_gaussian_sampler_parameters(name, *value.numbers, own_seed)
        else:
            intervals = list(zip(value.numbers[::2], value.numbers[1::2]))
            self.set_multirangeuniform_sampler_parameters(name, intervals, own_seed)


def read_parameter(message: IncomingMessage) -> tuple[str, Value]:
    """Return name and value of an environment parameter; raise ConfigError for a sampler that is none."""
    name = message.read_string()
    if message.read_int32() == 0:
        return name, message.read_float32()

    # a sampler: its seed, its kind, its numbers
    raw: dict[str, Any] = {"seed": message.read_int32() & 0x7FFFFFFF}
    kind = message.read_int32()
    raw[SAMPLER] = KINDS[kind] if 0 <= kind < len(KINDS) else kind

    if raw[SAMPLER] == "uniform":
        raw |= {"min": message.read_float32(), "max": message.read_float32()}
    elif raw[SAMPLER] == "gaussian":
        raw |= {"mean": message.read_float32(), "st_dev": message.read_float32()}
    elif raw[SAMPLER] == "multirangeuniform":
        ends = message.read_float32_list()
        raw["intervals"] = [ends[first : first + 2] for first in range(0, len(ends), 2)]
    return name, read_value(f"environment parameter {name}", raw)


def read_engine_setting(message: IncomingMessage) -> str:
    """Return an engine setting in words, for the log."""
    kind = message.read_int32()
    values: dict[int, Any] = {0: lambda: f"{message.read_int32()} x {message.read_int32()}"}
    value = values.get(kind, message.read_float32 if kind == 2 else message.read_int32)()

    name = _ENGINE_SETTINGS[kind] if kind < len(_ENGINE_SETTINGS) else f"setting {kind}"
    return f"{name} {value}"
