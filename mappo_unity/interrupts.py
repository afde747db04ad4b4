"""Ctrl-C while a command starts.

In: a block of imports and reading of options. Out: the interrupt, after the block. Extension modules (NumPy,
torch, MuJoCo) lose an interrupt that arrives while they are loaded, or are left half loaded by it.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Keep SIGINT back until the block has ended; in other threads, which get no signals, do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        came.append(number)

    previous = signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
        if came and callable(previous):
            previous(came[0], None)
        elif came:
            raise KeyboardInterrupt
