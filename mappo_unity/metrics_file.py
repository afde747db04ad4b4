"""The files that metrics are written to, and how a resumed run continues them.

In: rows of numbers by name, each with ``agent_steps``. Out: ``metrics.csv``, one line an iteration. A killed
run leaves a cut last line and rows later than its last checkpoint; `keep_until` drops both, there and in the
files of TorchRL's TensorBoard and CSV loggers, before they are appended to. Knows nothing of what the numbers
mean.
"""

from __future__ import annotations

import csv
import io
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mappo_unity.atomic import write_atomically

STEP = "agent_steps"

# Framing of a TensorBoard record (tensorboard/summary/writer/record_writer.py), little-endian: uint64 length,
# uint32 masked CRC of these 8 bytes, the data, uint32 masked CRC of the data.
_HEADER = struct.Struct("<QI")
_LENGTH_BYTES = 8
_FOOTER_BYTES = 4


class MetricsFile:
    """Append rows to ``metrics.csv``; each is on its way to the disk when `append` returns."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._columns, _ = _read_table(path)
        self._file = path.open("a", newline="", encoding="utf-8")

    def append(self, row: Mapping[str, int | float]) -> None:
        """Write a row; names not seen before become columns at the end, with empty cells above them."""
        new = [name for name in row if name not in self._columns]
        if new:
            self._add_columns(new)
        # One write of one line: a kill leaves a cut last line at most.
        self._file.write(_format([[str(row.get(name, "")) for name in self._columns]]))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add_columns(self, names: Sequence[str]) -> None:
        _, rows = _read_table(self.path)
        self._columns = [*self._columns, *names]
        padding = [""] * len(names)
        self._file.close()
        write_atomically(self.path, _format([self._columns, *(row + padding for row in rows)]).encode())
        self._file = self.path.open("a", newline="", encoding="utf-8")


def read_metrics(path: Path) -> list[dict[str, int | float]]:
    """Return the rows of a ``metrics.csv``, oldest first; an empty cell gives no entry.

    A last line without its end (the run is writing it, or was killed) is left out. Raises ValueError that
    names file and line where a cell is no number, and OSError where the file cannot be read.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist, or is not a file")
    columns, rows = _read_table(path)
    return [
        {name: _number(cell, path, line) for name, cell in zip(columns, row, strict=True) if cell}
        for line, row in enumerate(rows, start=2)
    ]


def keep_until(folder: Path, agent_steps: int) -> None:
    """Drop what a run in `folder` wrote after `agent_steps`, and records that a kill cut short.

    Concerns ``metrics.csv``, ``tensorboard/`` and ``csv/scalars/``, as far as they exist. Each file is
    replaced atomically, and left alone where nothing has to go.
    """
    _keep_rows(folder / "metrics.csv", agent_steps)
    for path in sorted((folder / "tensorboard").rglob("*tfevents*")):
        _keep_events(path, agent_steps)
    for path in sorted((folder / "csv" / "scalars").rglob("*.csv")):
        _keep_scalars(path, agent_steps)


def _keep_rows(path: Path, agent_steps: int) -> None:
    columns, rows = _read_table(path)
    if columns:
        step = columns.index(STEP)
        rows = [row for row in rows if int(row[step]) <= agent_steps]
        _rewrite(path, _format([columns, *rows]).encode())
    elif path.exists():  # a kill within the header
        _rewrite(path, b"")


def _keep_scalars(path: Path, agent_steps: int) -> None:
    """Trim a file of TorchRL's CSVLogger: lines ``step,value``."""
    lines = [line for line in path.read_bytes().splitlines(keepends=True) if line.endswith(b"\n")]
    _rewrite(path, b"".join(line for line in lines if int(line.split(b",")[0]) <= agent_steps))


def _keep_events(path: Path, agent_steps: int) -> None:
    """Trim a TensorBoard event file, record by record; the records that stay keep their bytes."""
    records = _split_records(path.read_bytes())
    _rewrite(path, b"".join(record for step, record in records if step <= agent_steps))


def _split_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield step and bytes (framing included) of whole records, up to the first that is cut or damaged."""
    from google.protobuf.message import DecodeError
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    start = 0
    while start + _HEADER.size <= len(data):
        length, crc = _HEADER.unpack_from(data, start)
        first = start + _HEADER.size
        end = first + length + _FOOTER_BYTES
        if crc != masked_crc32c(data[start : start + _LENGTH_BYTES]) or end > len(data):
            return
        try:
            step = Event.FromString(data[first : first + length]).step
        except DecodeError:
            return
        yield step, data[start:end]
        start = end


def _rewrite(path: Path, data: bytes) -> None:
    if data != path.read_bytes():
        write_atomically(path, data)


def _read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return the header and the rows of a file, without a cut last line; both empty where there is none."""
    text = path.read_bytes().decode("utf-8", errors="replace") if path.exists() else ""
    whole_lines = text[: text.rfind("\n") + 1]
    table = list(csv.reader(io.StringIO(whole_lines)))
    if not table:
        return [], []
    for line, row in enumerate(table[1:], start=2):
        if len(row) != len(table[0]):
            raise ValueError(f"{path}, line {line}: {len(row)} cells, the header has {len(table[0])}")
    return table[0], table[1:]


def _format(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _number(cell: str, path: Path, line: int) -> int | float:
    try:
        return int(cell) if cell.lstrip("-").isdigit() else float(cell)
    except ValueError:
        raise ValueError(f"{path}, line {line}: {cell!r} is not a number") from None
