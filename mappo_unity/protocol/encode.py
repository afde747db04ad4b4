"""A player's end of the messages: steps of a BaseEnv to bytes, bytes to actions."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, ObservationSpec, TerminalSteps
from PIL import Image

from mappo_unity.protocol.batch_encoding import (
    VARINT_BYTES,
    Layout,
    float_columns,
    joined_rows,
    varint_columns,
)
from mappo_unity.protocol.messages import (
    API_VERSION,
    CAPABILITIES,
    PNG,
    delimited,
    map_entry,
    varint,
)
from mappo_unity.scenes.contract.images import ByteImage


class BehaviorEncoder:
    """Write the agents of one behavior as a list of AgentInfoProto.

    Args:
        name: full name, ``Ball?team=0``.
        spec: the behavior's sensors and actions.
        png: send `ByteImage`s that are pictures (`is_picture`) as PNG. Clients take the first message's word
            for what always comes, so other pictures are never sent as PNG.
    """

    def __init__(self, name: str, spec: BehaviorSpec, png: bool = True) -> None:
        self.name, self.spec = name, spec
        self.pictures = [
            png and is_picture(sensor) and isinstance(sensor, ByteImage) for sensor in spec.observation_specs
        ]
        self.mask_size = sum(spec.action_spec.discrete_branches)

        self._head = _head_layout(self.mask_size)
        self._sensors = [_float_sensor(i, sensor) for i, sensor in enumerate(spec.observation_specs)]

        # The row of an agent whose sensors all go as floats.
        whole = Layout()
        for part in (self._head, *self._sensors):
            whole.append(part)
        self._row = whole.delimited(1)

    def encode(self, decision: DecisionSteps, terminal: TerminalSteps) -> bytes:
        """Return a ListAgentInfoProto: terminal rows first, then decisions."""
        return self._encode(terminal, True) + self._encode(decision, False)

    def brain_parameters(self) -> bytes:
        """Return the behavior's BrainParametersProto."""
        actions = self.spec.action_spec
        branches = [int(size) for size in actions.discrete_branches]
        # Tags of single numbers: 0x08 is field 1, 0x10 is field 2; below, 0x30 is 6 and 0x40 is 8.
        spec = b"\x08" + varint(int(actions.continuous_size)) + b"\x10" + varint(len(branches))
        if branches:
            spec += delimited(3, b"".join(varint(size) for size in branches))

        # Trainers from before protocol 1.3 read the sizes from the old fields, 3 and 6.
        old_sizes = branches if branches else [int(actions.continuous_size)]

        return (
            delimited(3, b"".join(varint(size) for size in old_sizes))
            + (b"" if branches else b"\x30\x01")  # the deprecated kind of action: continuous
            + delimited(7, self.name.encode())
            + b"\x40\x01"  # is_training
            + delimited(9, spec)
        )

    def _encode(self, steps: DecisionSteps | TerminalSteps, ends: bool) -> bytes:
        count = len(steps)
        if not count:
            return b""

        columns = self._head_columns(steps, ends)
        drawn = {
            i: pictures
            for i, picture in enumerate(self.pictures)
            if picture and (pictures := _drawn(i, self.spec.observation_specs[i], steps.obs[i])) is not None
        }

        # Floats only: all rows are equally long, and are written at once.
        if not drawn:
            for i, obs in enumerate(steps.obs):
                columns[f"obs_{i}"] = float_columns(obs)
            return self._row.rows(count, columns).tobytes()

        # PNGs differ in length: rows are joined one by one.
        parts: list[np.ndarray | list[bytes]] = [self._head.rows(count, columns)]
        for i, sensor in enumerate(self._sensors):
            floats = {f"obs_{i}": float_columns(steps.obs[i])}
            parts.append(drawn[i] if i in drawn else sensor.rows(count, floats))

        return joined_rows(1, parts, count)

    def _head_columns(self, steps: DecisionSteps | TerminalSteps, ends: bool) -> dict[str, np.ndarray]:
        columns = {
            "reward": float_columns(steps.reward),
            "done": np.full((len(steps), 1), ends, np.uint8),
            "id": varint_columns(steps.agent_id),
            "group_id": varint_columns(np.asarray(steps.group_id)),
            "group_reward": float_columns(steps.group_reward),
        }

        if isinstance(steps, TerminalSteps):
            columns["interrupted"] = steps.interrupted.astype(np.uint8)[:, None]
        elif self.mask_size and steps.action_mask is not None:
            columns["mask"] = np.concatenate(steps.action_mask, axis=1).astype(np.uint8)

        return columns


def is_picture(sensor: ObservationSpec) -> bool:
    """Tell whether a sensor is a picture [height, width, channels], as ML-Agents 2 lays them out."""
    shape = sensor.shape
    return len(shape) == 3 and shape[2] < min(shape[0], shape[1])


def initialization(scene: str, package_version: str, brain_parameters: Sequence[bytes] = ()) -> bytes:
    """Return a UnityRLInitializationOutputProto, with the behaviors that came up."""
    capabilities = b"".join(varint(i << 3) + b"\x01" for i in range(1, len(CAPABILITIES) + 1))
    return (
        delimited(1, scene.encode())
        + delimited(2, API_VERSION.encode())
        + b"".join(delimited(5, brain) for brain in brain_parameters)
        + delimited(7, package_version.encode())
        + delimited(8, capabilities)
    )


def output(
    agent_infos: dict[str, bytes], initialization_output: bytes | None = None, side_channel: bytes = b""
) -> bytes:
    """Return a UnityOutputProto of the behaviors' agent lists and of messages on side channels."""
    infos = b"".join(map_entry(2, name, infos) for name, infos in agent_infos.items())
    content = delimited(1, infos + (delimited(3, side_channel) if side_channel else b""))
    return content if initialization_output is None else content + delimited(2, initialization_output)


def decode_actions(spec: BehaviorSpec, values: Sequence[Any]) -> ActionTuple:
    """Return the actions of a ListAgentActionProto, in its order.

    A client from before protocol 1.3 fills only `vector_actions_deprecated`.
    Raises ValueError: a row of another length than the behavior's actions.
    """
    size, branches = spec.action_spec.continuous_size, spec.action_spec.discrete_size
    count = len(values)
    old = bool(count) and not values[0].continuous_actions and not len(values[0].discrete_actions)

    action = ActionTuple()
    if size:
        rows = [v.vector_actions_deprecated if old else v.continuous_actions for v in values]
        action.add_continuous(_floats(rows, size))

    if branches:
        if old:
            # such a client sends branch indices as floats
            discrete = _floats([v.vector_actions_deprecated for v in values], branches).astype(np.int32)
        else:
            discrete = np.array([v.discrete_actions for v in values], np.int32)
        if discrete.shape != (count, branches):
            raise ValueError(f"expected {branches} discrete actions for each of {count} agents")
        action.add_discrete(discrete)

    return action


def _floats(rows: list[bytes], size: int) -> np.ndarray:
    if any(len(row) != 4 * size for row in rows):
        raise ValueError(f"expected {size} float actions an agent, got {[len(row) // 4 for row in rows]}")
    return np.frombuffer(b"".join(rows), "<f4").reshape(len(rows), size)


def _head_layout(mask_size: int) -> Layout:
    """Lay out AgentInfoProto up to its observations; the order of fields is free."""
    head = Layout()
    # A tag is the field's number << 3 | its wire type.
    for tag, name, width in (
        (b"\x3d", "reward", 4),
        (b"\x40", "done", 1),
        (b"\x48", "interrupted", 1),
        (b"\x50", "id", VARINT_BYTES),
        (b"\x70", "group_id", VARINT_BYTES),
        (b"\x7d", "group_reward", 4),
    ):
        head.constant(tag)
        head.slot(name, width)

    if mask_size:
        # Packed flags, as a length-delimited field 11.
        head.constant(b"\x5a" + varint(mask_size))
        head.slot("mask", mask_size)

    return head


def _description(sensor: ObservationSpec) -> bytes:
    """Return the fields of ObservationProto that never change."""
    flags = [int(flag) for flag in sensor.dimension_property or ()]
    if len(sensor.shape) == 3 and not any(flags):
        flags = [1, 2, 2]  # channels, height, width: said, since clients take old players' for the last
    return (
        delimited(1, b"".join(varint(int(size)) for size in sensor.shape))
        + delimited(6, b"".join(varint(flag) for flag in flags))
        # the type of observation, field 7
        + b"\x38"
        + varint(int(sensor.observation_type.value))
        + delimited(8, (sensor.name or "").encode())
    )


def _float_sensor(index: int, sensor: ObservationSpec) -> Layout:
    numbers = Layout()
    numbers.slot(f"obs_{index}", 4 * int(np.prod(sensor.shape)))

    content = Layout()
    content.constant(_description(sensor))
    content.append(numbers.delimited(1).delimited(4))
    return content.delimited(13)


def _drawn(index: int, sensor: ObservationSpec, obs: np.ndarray) -> list[bytes] | None:
    """Return the ObservationProto fields with PNGs; None where PNG would lose something."""
    # A PNG holds 256 levels: it is exact only for numbers that are such levels.
    levels = np.rint(obs * 255)
    exact = levels.astype(np.float32) / np.float32(255)
    if not (np.array_equal(exact, obs) and levels.min() >= 0 and levels.max() <= 255):
        return None

    head = _description(sensor) + b"\x10" + varint(PNG)
    return [delimited(13, head + delimited(3, _pngs(image))) for image in levels.astype(np.uint8)]


def _pngs(image: np.ndarray) -> bytes:
    """Return uint8 [height, width, channels] as colour PNGs of three channels each, one after the other.

    As Unity does: missing channels are zero, but one grey channel stands three times.
    """
    channels = image.shape[2]
    colours = np.repeat(image, 3, 2) if channels == 1 else np.pad(image, ((0, 0), (0, 0), (0, -channels % 3)))

    out = io.BytesIO()
    for first in range(0, colours.shape[2], 3):
        Image.fromarray(np.ascontiguousarray(colours[:, :, first : first + 3])).save(out, "PNG")

    return out.getvalue()
