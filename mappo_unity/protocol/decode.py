"""The trainer's end of the messages: bytes to steps of a BaseEnv, actions to bytes.

No loop runs over numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from mlagents_envs.base_env import (
    ActionTuple,
    BehaviorSpec,
    DecisionSteps,
    TerminalSteps,
)

from mappo_unity.protocol.batch_encoding import VARINT_BYTES, Layout, float_columns, packed_varints
from mappo_unity.protocol.messages import API_VERSION, CAPABILITIES, PNG, delimited, map_entry, varint
from mappo_unity.scenes.contract.images import LAST, ByteImage, channel_dim, mark_channels_last


class MalformedMessage(Exception):
    """A player's message that cannot be what it should be."""


class BehaviorDecoder:
    """Read the agents of one behavior from a list of AgentInfoProto."""

    def __init__(self, name: str, spec: BehaviorSpec) -> None:
        self.name, self.spec = name, spec
        branches = spec.action_spec.discrete_branches
        self._cuts = list(np.cumsum(branches)[:-1])
        # zeros forbid nothing
        self._allowed = bytes(sum(branches))
        # bytes of each sensor's float32 numbers
        self._widths = [4 * int(np.prod(sensor.shape)) for sensor in spec.observation_specs]
        self._empty = DecisionSteps.empty(spec), TerminalSteps.empty(spec)

    def decode(self, infos: Sequence[Any]) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the steps of these agents, in their order.

        Raises:
            MalformedMessage: sizes differ from the behavior's, or a number is not finite.
        """
        asked = [info for info in infos if not info.done]
        ended = [info for info in infos if info.done] if len(asked) < len(infos) else []

        decision, terminal = self._empty
        if asked:
            mask = self._masks(asked) if self._allowed else None
            obs, reward, agents, groups, group_reward = self._columns(asked)
            decision = DecisionSteps(obs, reward, agents, mask, groups, group_reward)
        if ended:
            obs, reward, agents, groups, group_reward = self._columns(ended)
            interrupted = np.array([info.max_step_reached for info in ended], bool)
            terminal = TerminalSteps(obs, reward, interrupted, agents, groups, group_reward)

        return decision, terminal

    def _columns(
        self, infos: list[Any]
    ) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        rows = [info.observations for info in infos]
        if any(len(row) != len(self._widths) for row in rows):
            counts = sorted({len(row) for row in rows})
            raise MalformedMessage(f"{self.name} has {len(self._widths)} sensors, a message has {counts}")

        agents = np.array([info.id for info in infos], np.int32)
        obs = [self._sensor(i, [row[i] for row in rows], agents) for i in range(len(self._widths))]
        reward = np.array([info.reward for info in infos], np.float32)
        group_reward = np.array([info.group_reward for info in infos], np.float32)

        self._check_finite(reward, "reward", agents)
        self._check_finite(group_reward, "group reward", agents)

        return obs, reward, agents, np.array([info.group_id for info in infos], np.int32), group_reward

    def _sensor(self, index: int, observations: list[Any], agents: np.ndarray) -> np.ndarray:
        # as ML-Agents, agent by agent: not all cameras of a behavior need be compressed
        if len(self.spec.observation_specs[index].shape) == 3:
            packed = [observation.compression_type == PNG for observation in observations]
            if any(packed):
                return np.stack(
                    [
                        self._picture(index, o) if png else self._numbers(index, [o], agents[i : i + 1])[0]
                        for i, (o, png) in enumerate(zip(observations, packed, strict=True))
                    ]
                )

        return self._numbers(index, observations, agents)

    def _numbers(self, index: int, observations: list[Any], agents: np.ndarray) -> np.ndarray:
        shape = self.spec.observation_specs[index].shape
        data = [o.float_data.data for o in observations]
        width = self._widths[index]
        if any(len(row) != width for row in data):
            sizes = sorted({len(row) // 4 for row in data})
            raise MalformedMessage(
                f"{self.name}: sensor obs_{index} has shape {tuple(shape)}, a message has {sizes} numbers"
            )

        # A bytearray, so that the array over it can be written to.
        out = np.frombuffer(bytearray().join(data), "<f4").reshape(len(data), *shape)
        self._check_finite(out, f"sensor obs_{index}", agents)

        return out

    def _picture(self, index: int, observation: Any) -> np.ndarray:
        shape = tuple(self.spec.observation_specs[index].shape)
        image = _pixels(observation.compressed_data, list(observation.compressed_channel_mapping))

        # Grey is sent as a colour picture. A width of 1 does not make a sensor grey.
        height, width, planes = image.shape
        if planes == 3 and shape in ((1, height, width), (height, width, 1)):
            image = image.mean(axis=2, keepdims=True)

        # Both ways where all sizes are equal; then the sensor says which it is.
        one_size = len(set(shape)) == 1 and channel_dim(self.spec.observation_specs[index]) == LAST
        if shape[1:] == image.shape[:2] and not one_size:  # channels first: ML-Agents 3 and later
            image = np.moveaxis(image[:, :, : shape[0]], 2, 0)
        else:
            image = image[:, :, : shape[2]]

        if image.shape != shape:
            raise MalformedMessage(
                f"{self.name}: sensor obs_{index} has shape {shape}, its picture {image.shape}"
            )

        return image

    def _masks(self, infos: list[Any]) -> list[np.ndarray]:
        size = len(self._allowed)
        # A mask says what is forbidden; an agent without one may do everything.
        masks = [info.action_mask or self._allowed for info in infos]
        if any(len(mask) != size for mask in masks):
            raise MalformedMessage(
                f"{self.name} has {size} discrete actions, a mask {len(max(masks, key=len))}"
            )

        table = np.frombuffer(b"".join(masks), np.uint8).reshape(len(masks), size).astype(bool)
        return np.split(table, self._cuts, axis=1)

    def _check_finite(self, numbers: np.ndarray, what: str, agents: np.ndarray) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            fine = np.isfinite(numbers.sum())  # quick; the sum of huge numbers may overflow

        if not fine and not np.isfinite(numbers).all():
            row = int(np.argwhere(~np.isfinite(numbers))[0][0])
            bad = numbers[row][~np.isfinite(numbers[row])].flat[0] if numbers.ndim > 1 else numbers[row]
            raise MalformedMessage(f"{self.name}, agent {int(agents[row])}: its {what} holds {bad}")


class ActionEncoder:
    """Write the actions of one behavior as a list of AgentActionProto.

    Args:
        spec: the behavior's.
        old: fill the fields of protocols before 1.3 instead (players without hybrid actions).
    """

    def __init__(self, spec: BehaviorSpec, old: bool = False) -> None:
        self.old = old
        size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_size
        self._size, self._branches = size, branches

        row = Layout()
        floats = Layout()
        # Before protocol 1.3 discrete actions went as floats, too.
        floats.slot("floats", 4 * (branches if old and not size else size))
        if floats.template:
            row.append(floats.delimited(1 if old else 6))

        if branches and not old:
            indices = Layout()
            indices.slot("indices", VARINT_BYTES * branches)
            row.append(indices.delimited(7))

        self._row = row.delimited(1)

    def encode(self, action: ActionTuple) -> bytes:
        """Return a ListAgentActionProto, an entry an agent."""
        columns = {}
        if self._size:
            columns["floats"] = float_columns(action.continuous)
        elif self.old:
            columns["floats"] = float_columns(action.discrete)
        if self._branches and not self.old:
            columns["indices"] = packed_varints(action.discrete)

        return self._row.rows(len(next(iter(columns.values()))), columns).tobytes()


def behavior_spec(brain: Any, info: Any, channels_last: bool = False) -> BehaviorSpec:
    """Return the spec that a BrainParametersProto and an agent's first message describe.

    `channels_last`: how the player lays out images that say nothing of it (`sends_channels_last`).
    """
    from mlagents_envs.rpc_utils import behavior_spec_from_proto

    spec = behavior_spec_from_proto(brain, info)
    sensors = [
        ByteImage(*sensor) if _holds_bytes(sensor.shape, observation) else sensor
        for sensor, observation in zip(spec.observation_specs, info.observations, strict=True)
    ]
    spec = spec._replace(observation_specs=sensors)
    return mark_channels_last(spec) if channels_last else spec


def _holds_bytes(shape: Sequence[int], observation: Any) -> bool:
    """Tell whether a sensor's numbers are always those of a picture: sent as PNG, nothing averaged."""
    planes = [channel for channel in observation.compressed_channel_mapping if channel >= 0]
    averaged = len(set(planes)) < len(planes) or 1 in (shape[0], shape[-1])
    return observation.compression_type == PNG and not averaged


def initialization(seed: int, num_areas: int, package_version: str) -> bytes:
    """Return the UnityInputProto that answers a player's first message."""
    capabilities = b"".join(varint(i << 3) + b"\x01" for i in range(1, len(CAPABILITIES) + 1))

    # Tags of single numbers: 0x08 is field 1, 0x28 is field 5.
    content = (
        b"\x08"
        + varint(seed)
        + delimited(2, API_VERSION.encode())
        + delimited(3, package_version.encode())
        + delimited(4, capabilities)
        + b"\x28"
        + varint(num_areas)
    )

    return delimited(2, content)


def rl_input(actions: Mapping[str, bytes], command: int, side_channel: bytes) -> bytes:
    """Return a UnityInputProto: actions of every behavior, a command, side-channel messages."""
    # 0x20 is the tag of field 4, the command.
    content = b"".join(map_entry(1, name, rows) for name, rows in actions.items()) + b"\x20" + varint(command)
    if side_channel:
        content += delimited(5, side_channel)
    return delimited(1, content)


def _pixels(data: bytes, mapping: list[int]) -> np.ndarray:
    """Decode concatenated PNGs to float32 [height, width, channels] from 0 to 1.

    `mapping`: for every plane of the pictures the channel that it belongs to, -1 for none; planes of one
    channel are averaged (ML-Agents, CompressionSpec).
    """
    from mlagents_envs.rpc_utils import OffsetBytesIO
    from PIL import Image

    header, stream, planes, start = b"\x89PNG\r\n\x1a\n", OffsetBytesIO(data), [], 0
    # Pillow seeks to 0 before it reads: the stream counts from where the next picture begins.
    try:
        while start >= 0:
            stream.offset = start
            image = Image.open(stream, formats=["PNG"])
            image.load()
            array = np.array(image, np.float32) / np.float32(255)
            planes.append(array[:, :, None] if array.ndim == 2 else array)
            start = data.find(header, stream.original_tell())
        picture = np.concatenate(planes, axis=2)
    except Exception as error:  # of many kinds, by what is broken
        raise MalformedMessage(f"a picture of {len(data)} bytes cannot be decoded: {error}") from error

    if not mapping:
        return picture
    groups = [[p for p, to in enumerate(mapping) if to == channel] for channel in range(max(mapping) + 1)]
    return np.stack([picture[:, :, planes].mean(axis=2) for planes in groups], axis=2)
