"""Messages of the ML-Agents protocol as classes whose number arrays are plain bytes.

A packed array of floats or bools and a bytes field look alike on the wire, so the classes here declare such
arrays as bytes: parsing touches no single number, and numpy reads them in place. All other fields are those
of mlagents_envs. Small helpers write the same format.

Wire format: https://protobuf.dev/programming-guides/encoding/
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any

from mappo_unity.protocol.protobuf import PREFIX, install

API_VERSION = "1.5.0"
"""Version of the protocol; peers must agree in the first number."""
STATUS_OK, STATUS_QUIT = 200, 400
"""Header status: go on, or the peer leaves (RpcCommunicator of ML-Agents, both sides)."""
METHOD = "/communicator_objects.UnityToExternalProto/Exchange"
"""The one remote call; the player is the gRPC client."""
STEP, RESET = 0, 1
"""Values of CommandProto."""
PNG = 1
"""Value of CompressionTypeProto."""
CAPABILITIES = (
    "baseRLCapabilities",
    "concatenatedPngObservations",
    "compressedChannelMapping",
    "hybridActions",
    "trainingAnalytics",
    "variableLengthObservation",
    "multiAgentGroups",
)
"""Fields of UnityRLCapabilitiesProto; both ends of ours have them all."""

_AS_BYTES = {
    "FloatData": ("data",),
    "AgentInfoProto": ("action_mask",),
    "AgentActionProto": ("continuous_actions", "vector_actions_deprecated"),
}

OPTIONS = (
    ("grpc.max_send_message_length", -1),
    ("grpc.max_receive_message_length", -1),
    ("grpc.enable_http_proxy", 0),
)
"""gRPC options of both ends: pictures of many agents exceed its limit of 4 MB; the way is never a proxy's."""


@cache
def message_class(file: str = "unity_message", message: str = "UnityMessageProto") -> Any:
    """Return the class of a message, arrays as bytes; below UnityMessageProto hang most others.

    Args:
        file: the module of mlagents_envs that declares it, without ``_pb2``.
        message: its name.
    """
    install()
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    # a pool of our own: in the default one are the messages as mlagents_envs declares them
    pool = descriptor_pool.DescriptorPool()

    def add(file: Any) -> None:
        # A pool takes a file only after those that it imports.
        for needed in file.dependencies:
            add(needed)

        proto = descriptor_pb2.FileDescriptorProto()
        file.CopyToProto(proto)
        for declared in proto.message_type:
            _declare_bytes(declared)
        pool.Add(proto)

    root = importlib.import_module(f"{PREFIX}{file}_pb2").DESCRIPTOR
    add(root)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{root.package}.{message}"))


def _declare_bytes(message: Any) -> None:
    for field in message.field:
        if field.name in _AS_BYTES.get(message.name, ()):
            field.type, field.label = field.TYPE_BYTES, field.LABEL_OPTIONAL
            field.ClearField("options")  # [packed = ...] holds for arrays only

    for nested in message.nested_type:
        _declare_bytes(nested)


def parse(data: bytes) -> Any:
    """Parse a UnityMessageProto; raises google.protobuf.message.DecodeError."""
    return message_class().FromString(data)


def varint(number: int) -> bytes:
    """Return a non-negative integer as a varint."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def delimited(field: int, content: bytes) -> bytes:
    """Return a length-delimited field (message, string, bytes, packed array) with its tag."""
    return varint(field << 3 | 2) + varint(len(content)) + content


def map_entry(field: int, key: str, value: bytes) -> bytes:
    """Return one entry of a map from strings to messages."""
    return delimited(field, delimited(1, key.encode()) + delimited(2, value))


def message(
    status: int, *, unity_output: bytes | None = None, unity_input: bytes | None = None, text: str = ""
) -> bytes:
    """Return a UnityMessageProto with a header and, at most, one of the two sides' contents."""
    header = b"\x08" + varint(status) + (delimited(2, text.encode()) if text else b"")
    out = delimited(1, header)

    if unity_output is not None:
        out += delimited(2, unity_output)
    if unity_input is not None:
        out += delimited(3, unity_input)

    return out
