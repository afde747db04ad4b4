"""Side channels: what a player reads (environment parameters, engine settings) and sends (statistics).

The layout of the messages is that of the other end in mlagents_envs.side_channel.
"""

from __future__ import annotations

import logging
import struct
import uuid
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from mlagents_envs.side_channel import IncomingMessage, OutgoingMessage, SideChannel
from mlagents_envs.side_channel.engine_configuration_channel import EngineConfigurationChannel
from mlagents_envs.side_channel.environment_parameters_channel import EnvironmentParametersChannel
from mlagents_envs.side_channel.side_channel_manager import SideChannelManager
from mlagents_envs.side_channel.stats_side_channel import StatsSideChannel

from mappo_unity.scenes.contract.statistics import AGGREGATIONS, Statistics

PARAMETERS = uuid.UUID("534c891e-810f-11ea-a9d0-822485860400")
"""EnvironmentParametersChannel."""
ENGINE = uuid.UUID("e951342c-4f7e-11ea-b238-784f4387d1f7")
"""EngineConfigurationChannel."""
ANALYTICS = uuid.UUID("b664a4a9-d86f-5a5f-95cb-e8353a7e8356")
"""DefaultTrainingAnalyticsSideChannel: says what trains; nothing to do."""
STATISTICS = uuid.UUID("a1d8f7b7-cec8-50f9-b78b-d3e165a78520")
"""StatsSideChannel."""

_ENGINE_SETTINGS = ("screen size", "quality level", "time scale", "target frame rate", "capture frame rate")
_said_unknown: set[uuid.UUID] = set()

logger = logging.getLogger(__name__)


class TrainerChannels(SideChannelManager):
    """The trainer's end of the channels; a message on another one is said once, and passed over.

    Args:
        parameters: environment parameters, sent with the first message.
        settings: of the engine, likewise; see `EngineConfigurationChannel.set_configuration_parameters`.
        more: further channels.
    """

    def __init__(
        self, parameters: Mapping[str, float], settings: Mapping[str, Any], more: Sequence[SideChannel]
    ) -> None:
        self.engine, self._statistics = EngineConfigurationChannel(), StatsSideChannel()
        self.engine.set_configuration_parameters(**settings)

        values = EnvironmentParametersChannel()
        for name, value in parameters.items():
            values.set_float_parameter(name, value)
        super().__init__([values, self.engine, self._statistics, *more])

    def pop_statistics(self) -> Statistics:
        """Return what the game reported of itself (StatsRecorder) since the last call."""
        reported = self._statistics.get_and_reset_stats()
        return {
            name: [(value, AGGREGATIONS[method.value]) for value, method in values]
            for name, values in reported.items()
        }

    def process_side_channel_message(self, data: bytes) -> None:
        """Hand the messages packed in `data` to their channels; raises ValueError for broken ones."""
        for channel, message in split(data):
            if channel in self._side_channels_dict:
                self._side_channels_dict[channel].on_message_received(message)
            elif channel != ANALYTICS and channel not in _said_unknown:
                _said_unknown.add(channel)
                logger.warning(
                    "the game sends messages on the side channel %s, which the trainer does not know: they "
                    "are passed over (said once)",
                    channel,
                )


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


def statistics_messages(statistics: Statistics) -> bytes:
    """Return the messages that report statistics: each value by itself, as StatsSideChannel.cs does."""
    out = bytearray()
    for name, values in statistics.items():
        for value, method in values:
            message = OutgoingMessage()
            # like Unity, which knows ASCII only here
            message.write_string(name.encode("ascii", "replace").decode())
            message.write_float32(value)
            message.write_int32(AGGREGATIONS.index(method))
            out += STATISTICS.bytes_le + struct.pack("<i", len(message.buffer)) + message.buffer
    return bytes(out)
