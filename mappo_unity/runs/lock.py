"""One training run at a time in a run folder, or one league in its folder, by a lock.

The operating system holds the lock for this process, and takes it back however the process ends: none is ever
left over. Those who only read a run (evaluation, export, videos) take none.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from mappo_unity.errors import ConfigError

LOCK = ".lock"
_FAR = 1 << 30  # Windows locks bytes, which nobody may read meanwhile: one far behind the text


@contextmanager
def locked(folder: Path, busy: str | None = None) -> Iterator[str | None]:
    """Hold the folder's lock; yield a warning where the place has no locks, else None.

    Raises ConfigError where another process trains in the folder; `busy` says what it does instead.
    """
    try:
        file = (folder / LOCK).open("a+b")
    except OSError as error:
        yield _no_lock(folder, error)
        return

    with file:  # closing it gives the lock back
        yield _take(folder, file, busy)


def _take(folder: Path, file: BinaryIO, busy: str | None) -> str | None:
    try:
        _lock(file)
    except BlockingIOError as error:
        if busy is not None:
            raise ConfigError(
                f"{busy} by another process{_holder(file)}: wait for its end or end it"
            ) from error
        raise ConfigError(
            f"the run in {folder} is being trained by another process{_holder(file)}: wait for its end or "
            "end it, then resume the run; mappo-eval, mappo-export and mappo-play can read it meanwhile"
        ) from error
    except OSError as error:
        return _no_lock(folder, error)

    _sign(file)
    return None


def _no_lock(folder: Path, error: OSError) -> str:
    return (
        f"{folder / LOCK} cannot be locked ({error.strerror or error}): "
        "take care that no other process trains in this folder"
    )


def _sign(file: BinaryIO) -> None:
    """Write who holds the lock, for the message of others; without it the message is shorter."""
    try:
        file.truncate(0)
        file.write(str(os.getpid()).encode())
        file.flush()
    except OSError:  # a full disk, say: the lock holds all the same
        pass


def _holder(file: BinaryIO) -> str:
    try:
        file.seek(0)
        return f" (process {int(file.read(20))})"
    except (OSError, ValueError):
        return ""


if sys.platform == "win32":
    import msvcrt

    def _lock(file: BinaryIO) -> None:
        file.seek(_FAR)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except PermissionError as error:
            raise BlockingIOError(error.errno, error.strerror) from error

else:
    import fcntl

    def _lock(file: BinaryIO) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
