"""A .demo file byte by byte: a header, a behavior, records.

At byte 0 stand a varint and a DemonstrationMetaProto of that length, at byte 33 likewise a
BrainParametersProto, and after it the records, each an AgentInfoActionPairProto. Unity's recorder leaves a
second copy of the header, without its length, behind the last record (ML-Agents, DemonstrationWriter.cs and
demo_loader.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.messages import message_class, varint
from mappo_unity.protocol.protobuf import install

SUFFIX = ".demo"
BEHAVIOR_AT = 33
"""Byte at which the behavior stands: the header may not be longer."""
NAME_LENGTH = 11
"""Letters of a demonstration's name with which the longest header fits: Unity's 16 may not."""
API_VERSION = 1
READABLE_VERSIONS = (0, 1)


class DemoFile(NamedTuple):
    """The parts of a file."""

    behavior: Any
    """A BrainParametersProto."""
    records: list[Any]
    """AgentInfoActionPairProto, number arrays as bytes (`messages.message_class`); at least one."""
    has_tail: bool
    """Unity's recorder wrote it: a copy of the header follows the last record."""


class _Cut(Exception):
    """A message that goes on behind the end of the file."""


def parse(data: bytes, path: Path) -> DemoFile:
    """Return the parts of a file's content; `path` is for messages.

    Raises:
        ConfigError: empty, no demonstration, of another version, without records, cut short.
    """
    install()
    from google.protobuf.message import DecodeError
    from mlagents_envs.communicator_objects.brain_parameters_pb2 import BrainParametersProto
    from mlagents_envs.communicator_objects.demonstration_meta_pb2 import DemonstrationMetaProto

    if not data:
        raise ConfigError(f"demonstration {path} is empty")

    pair = message_class("agent_info_action_pair", "AgentInfoActionPairProto")
    records: list[Any] = []
    count = 0
    try:
        head, _ = _delimited(data[:BEHAVIOR_AT], 0)
        meta = DemonstrationMetaProto.FromString(head)
        if meta.api_version not in READABLE_VERSIONS:
            raise ConfigError(
                f"demonstration {path} has version {meta.api_version}; the versions that can be read are "
                f"{' and '.join(map(str, READABLE_VERSIONS))}"
            )

        count = meta.number_steps
        brain, at = _delimited(data, BEHAVIOR_AT)
        behavior = BrainParametersProto.FromString(brain)
        while len(records) < count:
            content, at = _delimited(data, at)
            records.append(pair.FromString(content))
    except DecodeError as error:
        raise ConfigError(f"{path} is no demonstration of ML-Agents, or it is damaged: {error}") from error
    except _Cut:
        if not count:  # a random length at the start of another kind of file
            raise ConfigError(f"{path} is no demonstration of ML-Agents: its header cannot be read") from None
        raise ConfigError(
            f"demonstration {path} is cut short: it should have {count:,} records, {len(records):,} are there"
        ) from None

    if not records:
        raise ConfigError(f"demonstration {path} has no records: was the recording not ended properly?")
    return DemoFile(behavior, records, data[at:] == head)


def header(name: str, records: int, episodes: int, mean_return: float) -> bytes:
    """Return the first 33 bytes of a file.

    Args:
        name: of the demonstration; letters and digits are kept, as in Unity, as many as fit.
        records, episodes: how many the file has.
        mean_return: of its episodes.
    """
    install()
    from mlagents_envs.communicator_objects.demonstration_meta_pb2 import DemonstrationMetaProto

    plain = "".join(letter for letter in name if letter.isascii() and letter.isalnum())
    meta = DemonstrationMetaProto(
        api_version=API_VERSION,
        demonstration_name=plain[:NAME_LENGTH],
        number_steps=records,
        number_episodes=episodes,
        mean_reward=mean_return,
    )
    return delimited(meta.SerializeToString()).ljust(BEHAVIOR_AT, b"\0")


def delimited(content: bytes) -> bytes:
    """Return a message behind its length."""
    return varint(len(content)) + content


def _delimited(data: bytes, start: int) -> tuple[bytes, int]:
    """Return the message whose length stands at `start`, and where it ends."""
    length = shift = 0
    for at in range(start, min(start + 5, len(data))):
        length |= (data[at] & 0x7F) << shift
        shift += 7
        if data[at] < 0x80:
            end = at + 1 + length
            if end > len(data):
                break
            return data[at + 1 : end], end
    raise _Cut
