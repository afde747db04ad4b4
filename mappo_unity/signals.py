"""SIGINT, SIGTERM and those of schedulers: who takes them during a block, how they become exceptions.

Extension modules (NumPy, torch, MuJoCo) lose an interrupt that arrives while they are loaded, or are left
half loaded: during imports it waits, or ends the process at once. How a training run and a sweep end is in
`training.stop_signals` and `training.sweep_signals`.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

DUPLICATE_SIGNAL_S = 0.5
"""The same signal, once to the process and once to its group, is one; a second one comes later."""


def scheduler_signals() -> tuple[int, ...]:
    """Return the signals by which a scheduler asks a job to save its work: its time is over.

    SIGUSR1; and SIGUSR2 where somebody takes it, as submitit does in its jobs.
    """
    if sys.platform == "win32":
        return ()
    is_taken = callable(signal.getsignal(signal.SIGUSR2))
    return (signal.SIGUSR1, signal.SIGUSR2) if is_taken else (signal.SIGUSR1,)


@contextmanager
def handled(handler: Callable[[int, FrameType | None], Any], *numbers: int) -> Iterator[None]:
    """Let `handler` take these signals during the block; in other threads than the main one, do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


@contextmanager
def interrupts_end(command: str) -> Iterator[None]:
    """Let SIGINT end the process at once with a line and exit code 130, while nothing has been begun.

    No exception: one that comes out of a half loaded extension module ends in a traceback of that module.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        with suppress(OSError, AttributeError):  # a full disk, or no output at all
            sys.stdout.flush()
        os.write(2, f"{command}: interrupted\n".encode())
        os._exit(128 + number)

    with handled(leave, signal.SIGINT):
        yield


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Keep SIGINT back until the block has ended."""
    came: list[int] = []
    try:
        with handled(lambda number, frame: came.append(number), signal.SIGINT):
            yield
    finally:
        # late, but as if it came now: to the handler that is back in place
        if came:
            waiting = signal.getsignal(signal.SIGINT)
            if not callable(waiting):
                raise KeyboardInterrupt
            waiting(came[0], None)


class Interrupted(KeyboardInterrupt):
    """A signal ended the work; ``signal`` is its number."""

    def __init__(self, number: int = signal.SIGINT) -> None:
        super().__init__(number)
        self.signal = int(number)


@contextmanager
def termination_as_interrupt() -> Iterator[None]:
    """Let SIGTERM end the block as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    with handled(interrupt, signal.SIGTERM):
        yield
