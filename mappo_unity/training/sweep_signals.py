"""How signals end a sweep: at once where jobs run one by one, with a wait where they run side by side.

A launcher of processes kills its jobs when its own process is interrupted; so that process does not take the
first signal as its own, but hands it on, and waits until the jobs have written their checkpoints.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from mappo_unity.signals import (
    DUPLICATE_SIGNAL_S,
    Interrupted,
    handled,
    scheduler_signals,
    termination_as_interrupt,
)

GRACE_S = 30.0


class SweepSignalHandler:
    """Handle the signals of the process that started the jobs: the first makes it wait, a second ends it."""

    def __init__(self) -> None:
        self.number: int | None = None
        self._since_s = 0.0
        self._timer: threading.Timer | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Take a signal; raises Interrupted for the second one, or GRACE_S after the first."""
        if self.number is not None:
            if time.monotonic() - self._since_s > DUPLICATE_SIGNAL_S:
                raise Interrupted(self.number)
            return

        self.number, self._since_s = number, time.monotonic()
        print(
            f"waiting up to {GRACE_S:.0f} s for the jobs' checkpoints; once more to stop at once",
            file=sys.stderr,
            flush=True,
        )

        # The timer sends this process the same signal again, which ends it as a second one does.
        if os.name == "posix":
            _hand_on(number)
            self._timer = threading.Timer(GRACE_S, os.kill, (os.getpid(), number))
            self._timer.daemon = True
            self._timer.start()

    def end(self) -> None:
        """Wait no longer."""
        if self._timer is not None:
            self._timer.cancel()


def _hand_on(number: int) -> None:
    for child in multiprocessing.active_children():
        with suppress(OSError, TypeError):  # it has ended
            os.kill(child.pid, number)  # type: ignore[arg-type]


_sweep: SweepSignalHandler | None = None  # in the process of the sweep; None in those of its jobs


def in_process_of_its_own() -> bool:
    """Return whether a job runs in a process of its own, beside others."""
    return _sweep is None


@contextmanager
def sweep_signals(patience: SweepSignalHandler, parallel: bool) -> Iterator[None]:
    """Between jobs, let SIGTERM end a sweep as Ctrl-C does: with its table and its exit code.

    With `parallel` (jobs in processes of their own) both wait for the jobs, as `patience` does.
    """
    global _sweep
    _sweep = patience
    try:
        with _waiting(patience) if parallel else termination_as_interrupt():
            yield
    finally:
        _sweep = None


@contextmanager
def _waiting(patience: SweepSignalHandler) -> Iterator[None]:
    with handled(patience, signal.SIGINT, signal.SIGTERM):
        try:
            yield
        finally:
            patience.end()


def hand_to_launcher(number: int) -> None:
    """Give a scheduler's signal that has ended a job to a launcher that takes it, to have it started again.

    Submitit's handler raises SystemExit.
    """
    if number in scheduler_signals() and callable(signal.getsignal(number)):
        signal.raise_signal(number)


class _JobProcess:
    """The signals of a process that does one job after the other."""

    def __init__(self) -> None:
        self.stopped_by: int | None = None
        self._busy = False
        self._installed = False

    def begin(self) -> None:
        # Python lets only the main thread install handlers
        if not self._installed and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, self)
            signal.signal(signal.SIGTERM, self)
            self._installed = True
        self._busy = self.stopped_by is None

    def end(self) -> None:
        self._busy = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        first, self.stopped_by = self.stopped_by is None, number
        if first and self._busy:  # outside a job there is nothing to end, and the launcher must not break
            raise Interrupted(number)


_process = _JobProcess()


@contextmanager
def job_signals() -> Iterator[bool]:
    """Yield whether a job may begin; a signal that ends it ends the later ones of its process.

    Raises Interrupted only in the process of the sweep: a launcher kills all others at the first exception.
    """
    # Here jobs run in the process of the sweep: its own handlers are in charge.
    if _sweep is not None:
        if _sweep.number is not None:
            raise Interrupted(_sweep.number)
        yield True
        return

    _process.begin()
    try:
        yield _process.stopped_by is None
    except Interrupted as error:
        _process.stopped_by = error.signal
    finally:
        _process.end()
