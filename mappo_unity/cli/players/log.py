"""The log of mappo-player: lines with the time of day, in a file or on standard output.

A log that fails at its first line is a mistake in the options; later (a disk that filled up) the trainer's
work is worth more than the log, and lines are lost.
"""

from __future__ import annotations

import os
import sys
import time
from types import TracebackType

from mappo_unity.errors import ConfigError


class PlayerLog:
    """Write lines; also a context manager that closes its file.

    Args:
        path: the file; None or "-" for standard output.

    Raises:
        ConfigError: the file cannot be made, or cannot take its first line.
    """

    def __init__(self, path: str | None) -> None:
        self._name = f"-logFile {path}"
        self._works = False

        try:
            if path is None or path == "-":
                self._name = "the log on standard output"
                place = os.devnull if sys.stdout is None else sys.stdout.fileno()
                self._file = open(place, "wb", buffering=0, closefd=sys.stdout is None)
            else:
                self._file = open(path, "wb", buffering=0)  # nothing may wait: a kill must not lose it
        except OSError as error:
            raise self._mistake(error) from error

    def __call__(self, line: str) -> None:
        """Write a line."""
        try:
            self._file.write(f"{time.strftime('%H:%M:%S')} {line}\n".encode())
        except BrokenPipeError:  # the reader has gone, as in `mappo-player ... | head -1`
            raise
        except OSError as error:
            if not self._works:
                raise self._mistake(error) from error
        self._works = True

    def __enter__(self) -> PlayerLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def _mistake(self, error: OSError) -> ConfigError:
        return ConfigError(
            f"{self._name} cannot be written: {error.strerror}; name a file in a folder that can be written, "
            "on a disk with free space"
        )
