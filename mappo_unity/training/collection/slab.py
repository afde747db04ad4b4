"""A batch's tensors in memory that several processes see: each worker writes its slice, nobody copies.

The memory has no name in any file system (Linux): the last process that ends frees it, however it ends.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity.training.collection.description import Description
from mappo_unity.training.collection.joining import team_dim

_ALIGNMENT = 64  # bytes between the beginnings of entries


class SharedBytes:
    """Bytes that other processes open by `path`, while the process that made them lives.

    Args:
        size: in bytes.
    """

    def __init__(self, size: int) -> None:
        self._named: str | None = None
        if hasattr(os, "memfd_create"):
            self._file = os.memfd_create("mappo-unity")
            self.path = f"/proc/{os.getpid()}/fd/{self._file}"
        else:  # systems without memory that has no name
            self._file, self.path = tempfile.mkstemp(prefix="mappo-unity-")
            self._named = self.path
        os.ftruncate(self._file, size)  # pages that nobody writes to take no memory
        self.size = size
        self.bytes = open_bytes(self.path, size)
        self._is_pinned = False

    def pin(self) -> None:
        """Lock its pages, so that a GPU copies from them by itself while the CPU goes on.

        All of its pages take memory then. Where the driver refuses, copies are as without.
        """
        failed = torch.cuda.cudart().cudaHostRegister(self.bytes.data_ptr(), self.size, 0)
        self._is_pinned = not int(failed)

    def close(self) -> None:
        """Give up the way to it; the memory goes with the last tensor that lies in it."""
        if self._file < 0:
            return
        if self._is_pinned:
            torch.cuda.synchronize()  # a copy may be under way
            torch.cuda.cudart().cudaHostUnregister(self.bytes.data_ptr())
            self._is_pinned = False
        os.close(self._file)
        self._file = -1
        if self._named is not None:
            with suppress(OSError):
                os.unlink(self._named)


def open_bytes(path: str, size: int) -> Tensor:
    """Return shared bytes as a tensor, uint8 ``[size]``."""
    return torch.from_file(path, shared=True, size=size, dtype=torch.uint8)


class Entry(NamedTuple):
    """A tensor of a batch."""

    key: tuple[str, ...]
    dtype: torch.dtype
    shape: tuple[int, ...]  # of a row, with all workers' teams
    team_dim: int  # of the row


@dataclass(frozen=True)
class Layout:
    """Where the tensors of a batch of `capacity` rounds lie; a batch of T rounds is in the last T of them."""

    entries: tuple[Entry, ...]
    capacity: int
    teams: tuple[dict[str, int], ...]  # of each worker, by policy name
    batch_dims: dict[str, int]  # of a policy name's entries without T: [G, A] or [S, G, A]

    @property
    def size(self) -> int:
        """How many bytes it takes."""
        return sum(self._bytes(entry) for entry in self.entries)

    def rounds(self, block: Tensor, length: int, worker: int | None = None) -> TensorDict:
        """Return the last `length` rounds as tensors that lie in the block; of one worker, or of all."""
        out: dict[str, Any] = {}
        begin = 0
        for entry in self.entries:
            count = self.capacity * math.prod(entry.shape) * entry.dtype.itemsize
            region = block[begin : begin + count].view(entry.dtype).view(self.capacity, *entry.shape)
            begin += self._bytes(entry)

            name = entry.key[-2]
            rows = region[self.capacity - length :]
            if worker is not None:
                before = sum(teams[name] for teams in self.teams[:worker])
                rows = rows.narrow(1 + entry.team_dim, before, self.teams[worker][name])
            place = out
            for key in entry.key[:-1]:
                place = place.setdefault(key, {})
            place[entry.key[-1]] = rows
        return self._nested(out, length)

    def _nested(self, entries: dict[str, Any], length: int) -> TensorDict:
        def of(name: str, own: dict[str, Tensor]) -> TensorDict:
            shape = next(iter(own.values())).shape
            return TensorDict(own, shape[: 1 + self.batch_dims[name]])

        size = [length]
        following = {name: of(name, own) for name, own in entries.pop("next").items()}
        return TensorDict(
            {name: of(name, own) for name, own in entries.items()} | {"next": TensorDict(following, size)},
            size,
        )

    @staticmethod
    def _round_up(size: int) -> int:
        return -(-size // _ALIGNMENT) * _ALIGNMENT

    def _bytes(self, entry: Entry) -> int:
        return self._round_up(self.capacity * math.prod(entry.shape) * entry.dtype.itemsize)


class Row(NamedTuple):
    """A tensor of a worker's own rounds."""

    key: tuple[str, ...]
    dtype: torch.dtype
    shape: tuple[int, ...]  # of a row


def rows_of(rounds: TensorDictBase) -> list[Row]:
    """Return what rounds ``[T]`` consist of."""
    return [
        Row(key if isinstance(key, tuple) else (key,), value.dtype, tuple(value.shape[1:]))
        for key, value in rounds.items(True, True)
    ]


def make_layout(rows: Sequence[Row], parts: Sequence[Description], capacity: int) -> Layout:
    """Return the layout of the batches of workers, from what the rounds of one of them consist of."""
    teams = tuple({name: part.teams(name) for name in part.sides} for part in parts)
    totals = {name: sum(own[name] for own in teams) for name in parts[0].sides}
    entries = []
    for row in rows:
        name = row.key[-2]
        dim = team_dim(parts[0], name)
        shape = list(row.shape)
        shape[dim] = totals[name]
        entries.append(Entry(row.key, row.dtype, tuple(shape), dim))
    dims = {name: 2 + team_dim(parts[0], name) for name in parts[0].sides}
    return Layout(tuple(entries), capacity, teams, dims)


def write(rounds: TensorDictBase, layout: Layout, block: Tensor, worker: int) -> None:
    """Write a worker's rounds into its slice."""
    own = layout.rounds(block, rounds.shape[0], worker)
    for entry in layout.entries:
        own.get(entry.key).copy_(rounds.get(entry.key))
