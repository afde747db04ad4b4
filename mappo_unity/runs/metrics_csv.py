"""The files that metrics are written to, and how a resumed run appends to them.

``metrics.csv`` has one line an iteration: numbers by name, ``agent_steps`` among them. A killed run leaves a
cut last line and rows later than its last checkpoint; `keep_until` drops both, there and in the files of
TorchRL's TensorBoard and CSV loggers, before they are appended to.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mappo_unity.runs.atomic import write_atomically

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

        # Closed first, opened again after: the file behind the name is another one then.
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

    try:
        columns, rows = _read_table(path)
    except csv.Error as error:
        raise ValueError(f"{path} is no table ({error})") from error
    return [
        {name: _number(cell, path, line) for name, cell in zip(columns, row, strict=True) if cell}
        for line, row in enumerate(rows, start=2)
    ]


def keep_until(folder: Path, agent_steps: int) -> list[str]:
    """Drop what a run in `folder` wrote after `agent_steps`, and records that a kill cut short.

    Concerns ``metrics.csv``, ``tensorboard/`` and ``csv/scalars/``, as far as they exist. Each file is
    replaced atomically, and left alone where nothing has to go. Returns a line for each table with damaged
    rows: they go too, and the file as it was stays beside it.
    """
    notes = [_keep_rows(folder / "metrics.csv", agent_steps)]
    for path in sorted((folder / "tensorboard").rglob("*tfevents*")):
        keep_events(path, agent_steps)
    for path in sorted((folder / "csv" / "scalars").rglob("*.csv")):
        notes.append(_keep_scalars(path, agent_steps))

    return [note for note in notes if note is not None]


def _keep_rows(path: Path, agent_steps: int) -> str | None:
    if not path.exists():
        return None

    columns, *rows = [_cells(line) for line in _whole_lines(path)] or [[]]

    kept, damaged = [columns], []
    for line, row in enumerate(rows, start=2):
        step = _step_of(row, columns)
        if step is None:
            damaged.append(line)
        elif step <= agent_steps:
            kept.append(row)

    if columns and STEP not in columns:  # nobody can say what the rows hold
        kept, damaged = [[]], [1, *damaged]

    # The copy first: the file is replaced next.
    note = _set_aside(path, damaged)
    _rewrite(path, _format(kept).encode() if kept[0] else b"")

    return note


def _keep_scalars(path: Path, agent_steps: int) -> str | None:
    """Trim a file of TorchRL's CSVLogger: lines ``step,value``."""
    rows = [_cells(line) for line in _whole_lines(path)]
    steps = [_step_of(row, [STEP, "value"]) for row in rows]
    note = _set_aside(path, [line for line, step in enumerate(steps, start=1) if step is None])

    lines = zip(path.read_bytes().split(b"\n"), steps, strict=False)  # without the cut last one
    kept = [line + b"\n" for line, step in lines if step is not None and step <= agent_steps]

    _rewrite(path, b"".join(kept))
    return note


def _cells(line: str) -> list[str]:
    """Return a line's cells; a stray quote swallows no line but its own."""
    try:
        return next(csv.reader([line]), [])
    except csv.Error:
        return []


def _step_of(row: Sequence[str], columns: Sequence[str]) -> int | None:
    """Return a row's agent steps, None where the row is damaged: cells missing, or no numbers."""
    try:
        values = [float(cell) if cell else math.nan for cell in row]
        return int(values[columns.index(STEP)]) if len(row) == len(columns) else None
    except (ValueError, OverflowError):
        return None


def _set_aside(path: Path, damaged: Sequence[int]) -> str | None:
    """Copy a file that has damaged lines beside itself, and say so."""
    if not damaged:
        return None

    names = (f"{path.name}.damaged{number or ''}" for number in itertools.count())
    copy = next(place for place in (path.with_name(name) for name in names) if not place.exists())
    write_atomically(copy, path.read_bytes())

    lines = f"{len(damaged)} damaged line{'s' if len(damaged) > 1 else ''} (line {damaged[0]}"
    lines += f" to {damaged[-1]})" if len(damaged) > 1 else ")"
    return f"{path}: {lines} left out; the file as it was: {copy}"


def keep_events(path: Path, agent_steps: int) -> None:
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
        # A wrong length would lead anywhere: its checksum is what decides, that of the data is not looked at.
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
    table = list(csv.reader(_whole_lines(path))) if path.exists() else []
    if not table:
        return [], []

    for line, row in enumerate(table[1:], start=2):
        if len(row) != len(table[0]):
            raise ValueError(f"{path}, line {line}: {len(row)} cells, the header has {len(table[0])}")

    return table[0], table[1:]


def _whole_lines(path: Path) -> list[str]:
    """Return a file's lines, without a cut last one."""
    return [line.decode("utf-8", errors="replace") for line in path.read_bytes().split(b"\n")[:-1]]


def _format(rows: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _number(cell: str, path: Path, line: int) -> int | float:
    try:
        return int(cell) if cell.lstrip("-").isdigit() else float(cell)
    except ValueError:
        raise ValueError(f"{path}, line {line}: {cell!r} is not a number") from None
