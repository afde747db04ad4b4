"""Let mlagents_envs run on a current, compiled protobuf.

Its generated ``*_pb2.py`` files predate protobuf 4 and fail to import beside a current one ("Descriptors
cannot be created directly"). After `install` the same modules load: each old file still holds the serialized
description of its messages, which is read as a literal (the file is never executed) and handed to the
protobuf runtime.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

PREFIX = "mlagents_envs.communicator_objects."
SUFFIX = "_pb2"


def install() -> None:
    """Make ``mlagents_envs`` importable in this process; call it before importing from there.

    Calling it again changes nothing.
    """
    if not any(isinstance(finder, _OldPb2Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldPb2Finder())

    if importlib.util.find_spec("distutils") is None:  # Python 3.12+; mlagents_envs compares versions with it
        importlib.import_module("setuptools")  # brings its own distutils


def read_serialized_file(path: Path) -> bytes | None:
    """Return the serialized FileDescriptorProto in an old generated file; None where it holds none.

    Files of current generators hold none under the name ``serialized_pb`` and load by themselves.
    """
    for node in ast.walk(ast.parse(path.read_bytes(), str(path))):
        if isinstance(node, ast.keyword) and node.arg == "serialized_pb":
            return _literal_bytes(node.value)
    return None


def _literal_bytes(node: ast.expr) -> bytes | None:
    """Return the bytes of ``b'...'`` or of the call ``_b('...')`` of a latin-1 string."""
    if isinstance(node, ast.Call) and len(node.args) == 1:
        node = node.args[0]
    value = node.value if isinstance(node, ast.Constant) else None
    if isinstance(value, str):
        return value.encode("latin-1")
    return value if isinstance(value, bytes) else None


class _OldPb2Finder(MetaPathFinder):
    """Find the old generated modules of mlagents_envs, and nothing else."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not (fullname.startswith(PREFIX) and fullname.endswith(SUFFIX)):
            return None

        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
            return spec

        serialized = read_serialized_file(Path(spec.origin))
        if serialized is not None:
            spec.loader = _SerializedLoader(serialized)

        return spec


class _SerializedLoader(Loader):
    """Build a generated module from its serialized FileDescriptorProto."""

    def __init__(self, serialized: bytes) -> None:
        self.serialized = serialized

    def exec_module(self, module: ModuleType) -> None:
        from google.protobuf import descriptor_pb2, descriptor_pool
        from google.protobuf.internal import builder

        names = vars(module)
        # A pool takes a file only after those that it imports.
        for imported in descriptor_pb2.FileDescriptorProto.FromString(self.serialized).dependency:
            importlib.import_module(imported.removesuffix(".proto").replace("/", ".") + SUFFIX)

        names["DESCRIPTOR"] = descriptor_pool.Default().AddSerializedFile(self.serialized)
        builder.BuildMessageAndEnumDescriptors(names["DESCRIPTOR"], names)
        builder.BuildTopDescriptorsAndMessages(names["DESCRIPTOR"], module.__name__, names)
