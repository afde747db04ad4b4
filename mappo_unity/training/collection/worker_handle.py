"""The driver's end of a worker in a process of its own: any, and one of this machine."""

from __future__ import annotations

import pickle
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.schema import Config
from mappo_unity.training.child_process import start_child
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

        arguments = (cfg, number, folder, restarts, self._shared.path)
        self._process, self._pipe = start_child(main, arguments, f"worker-{number}")

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
