"""The driver's end of a worker in a process of its own: any, and one of this machine."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from mappo_unity.config.schema import Config
from mappo_unity.training.collection.slab import SharedBytes
from mappo_unity.training.collection.worker_process import (
    CLOSE,
    ERROR,
    PULSE_BYTES,
    ROUNDS,
    STOP,
    Report,
    main,
)

LOOK_S = 1.0
"""Between two looks at a worker's pulse."""
END_S = 5.0
"""Within which a process whose pipe is closed has ended."""


class WorkerLost(Exception):
    """A worker is gone, or of no more use; the text says how."""


class WorkerHandle(ABC):
    """The driver's end of a worker that answers messages (see `worker_process`).

    Attributes: `timeout_s`, seconds without a round after which it is lost.
    """

    timeout_s: float

    @property
    @abstractmethod
    def pid(self) -> int | None:
        """Id of its process, on its machine."""

    @abstractmethod
    def send(self, *message: Any) -> None:
        """Send a message; `receive` notices where nobody takes it."""

    def receive(self) -> tuple[str, Any]:
        """Wait for a message that is no error.

        Raises:
            WorkerLost: the process has ended, an exception of ours or of the machine came, or no round was
                played within `collect.timeout_s`.
            ConfigError, EnvironmentFailure: what the environment raised.
        """
        kind, content = self._message()
        if kind != ERROR:
            return kind, content

        report: Report = content
        if report.error is not None:
            raise report.error
        raise WorkerLost(f"it raised {report.text}")

    @abstractmethod
    def _message(self) -> tuple[str, Any]: ...

    @abstractmethod
    def stop(self) -> None:
        """Ask it to close its environment and end, also in the middle of a batch."""

    @abstractmethod
    def end(self, within_s: float = 0.0) -> None:
        """End the process, at once after some seconds; its players go with it."""

    def _silent(self) -> WorkerLost:
        return WorkerLost(f"it has played no round for collect.timeout_s={self.timeout_s:g} s")


class WorkerProcess(WorkerHandle):
    """The driver's end of a worker in a process of its own, on this machine.

    Args:
        cfg: the run's options.
        number: of the worker.
        folder: of the run.
        restarts: how often the worker was replaced.
    """

    def __init__(self, cfg: Config, number: int, folder: Path, restarts: int = 0) -> None:
        self.timeout_s = cfg.collect.timeout_s
        self._shared = SharedBytes(PULSE_BYTES)
        self._pulse = self._shared.bytes.view(torch.int64)

        # "spawn": a copy of a process in which torch has run may hang
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        arguments = (cfg, number, folder, restarts, self._shared.path, theirs)
        self._process = context.Process(target=main, args=arguments, name=f"worker-{number}")
        with _interrupts_blocked(), _without_main():
            self._process.start()
        theirs.close()

    @property
    def pid(self) -> int | None:
        """Id of the process."""
        return self._process.pid

    def send(self, *message: Any) -> None:
        """Send a message; `receive` notices where nobody takes it."""
        with suppress(OSError):
            self._pipe.send_bytes(pickle.dumps(message))

    def _message(self) -> tuple[str, Any]:
        rounds, since = int(self._pulse[ROUNDS]), time.monotonic()
        connection: Connection = self._pipe
        while True:
            ready = wait([connection, self._process.sentinel], min(LOOK_S, self.timeout_s))
            if connection in ready:
                try:
                    message: tuple[str, Any] = pickle.loads(connection.recv_bytes())
                    return message
                except (EOFError, OSError):
                    raise WorkerLost(f"its process ended with {self._end()}") from None
            if ready:
                raise WorkerLost(f"its process ended with {self._end()}")

            now, before = int(self._pulse[ROUNDS]), rounds
            if now != before:
                rounds, since = now, time.monotonic()
            elif time.monotonic() - since > self.timeout_s:
                raise self._silent()

    def stop(self) -> None:
        """Ask it to close its environment and end, also in the middle of a batch."""
        self._pulse[STOP] = 1
        self.send(CLOSE)

    def end(self, within_s: float = 0.0) -> None:
        """End the process, at once after some seconds; its players go with it."""
        if within_s > 0:
            self._process.join(within_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._pipe.close()
        self._shared.close()

    def _end(self) -> str:
        self._process.join(END_S)
        code = self._process.exitcode
        return f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Let a process that is started here begin with SIGINT blocked, until it can take it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Let a process that is started here not import the program: a script would begin to train there, too."""
    before = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = before
