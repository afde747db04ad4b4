"""Many equal-looking messages at once: a row of bytes an agent, written column by column with numpy.

Numbers get a fixed width (varints padded to five bytes, zeros written out), so all rows are alike and no loop
runs over agents.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mappo_unity.protocol.messages import delimited, varint

VARINT_BYTES = 5  # holds any int32 >= 0
_SHIFTS = np.arange(0, 7 * VARINT_BYTES, 7, dtype=np.int64)
# the high bit of a byte says that another one follows
_GO_ON = np.array([0x80] * (VARINT_BYTES - 1) + [0], np.uint8)


def varint_columns(numbers: np.ndarray) -> np.ndarray:
    """Return int ``[n]`` >= 0 as padded varints, uint8 ``[n, 5]``."""
    return ((numbers.astype(np.int64)[:, None] >> _SHIFTS) & 0x7F).astype(np.uint8) | _GO_ON


def packed_varints(numbers: np.ndarray) -> np.ndarray:
    """Return int ``[n, k]`` >= 0 as packed padded varints, uint8 ``[n, 5 k]``."""
    return varint_columns(numbers.reshape(-1)).reshape(len(numbers), -1)


def float_columns(numbers: np.ndarray) -> np.ndarray:
    """Return float ``[n, ...]`` as little-endian float32, uint8 ``[n, 4 k]``."""
    flat = np.ascontiguousarray(numbers.reshape(len(numbers), -1), "<f4")
    return flat.view(np.uint8)


@dataclass
class Layout:
    """Lay out one row: constant bytes, and slices that differ between rows.

    Build it with `constant` and `slot` in the order of the wire, then call `rows` for a uint8 ``[n, width]``.
    """

    template: bytearray = field(default_factory=bytearray)
    slots: dict[str, slice] = field(default_factory=dict)

    def constant(self, content: bytes) -> None:
        """Append bytes that are the same in every row."""
        self.template += content

    def slot(self, name: str, width: int) -> None:
        """Append `width` bytes that every row has of its own."""
        self.slots[name] = slice(len(self.template), len(self.template) + width)
        self.template += bytes(width)

    def append(self, other: Layout) -> None:
        """Append another layout with its slots."""
        for name, place in other.slots.items():
            self.slots[name] = slice(place.start + len(self.template), place.stop + len(self.template))
        self.template += other.template

    def delimited(self, number: int) -> Layout:
        """Return this layout as the content of a length-delimited field."""
        out = Layout()
        out.constant(varint(number << 3 | 2) + varint(len(self.template)))
        out.append(self)
        return out

    def rows(self, count: int, columns: dict[str, np.ndarray]) -> np.ndarray:
        """Return uint8 ``[count, width]`` with the named slots filled from uint8 ``[count, slot width]``."""
        out = np.empty((count, len(self.template)), np.uint8)
        out[:] = np.frombuffer(bytes(self.template), np.uint8)
        for name, values in columns.items():
            out[:, self.slots[name]] = values
        return out


def joined_rows(number: int, parts: list[np.ndarray | list[bytes]], count: int) -> bytes:
    """Return `count` length-delimited fields, each made of one row of every part.

    A part is uint8 ``[count, width]`` or a list of `count` byte strings of any length.
    """
    rows: list[bytes] = []
    for i in range(count):
        content = b"".join(part[i] if isinstance(part, list) else part[i].tobytes() for part in parts)
        rows.append(delimited(number, content))

    return b"".join(rows)
