"""Side channels: environment parameters, engine settings and statistics, at both ends.

The layout of the messages is that of the other end in mlagents_envs.side_channel.
"""

from __future__ import annotations

import logging
import struct
import uuid
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mlagents_envs.side_channel import IncomingMessage, OutgoingMessage, SideChannel
from mlagents_envs.side_channel.engine_configuration_channel import EngineConfigurationChannel
from mlagents_envs.side_channel.environment_parameters_channel import EnvironmentParametersChannel
from mlagents_envs.side_channel.side_channel_manager import SideChannelManager
from mlagents_envs.side_channel.stats_side_channel import StatsSideChannel

from mappo_unity.config.parameters.samplers import KINDS, SAMPLER, Sampler, Value, read_value
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
        seed: the player's.
    """

    def __init__(
        self,
        parameters: Mapping[str, Value],
        settings: Mapping[str, Any],
        more: Sequence[SideChannel],
        seed: int,
    ) -> None:
        self.parameters, self._statistics = ParametersChannel(), StatsSideChannel()
        self.engine = EngineConfigurationChannel()
        self.engine.set_configuration_parameters(**settings)
        for name, value in parameters.items():
            self.parameters.send(name, value, seed)
        super().__init__([self.parameters, self.engine, self._statistics, *more])

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
