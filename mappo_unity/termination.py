"""SIGTERM as an interrupt, for commands that clean up when they are ended.

In: a block. Out: an exception in it that knows its signal. Training has its own way: it ends its iteration.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from mappo_unity.interrupts import handled


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
