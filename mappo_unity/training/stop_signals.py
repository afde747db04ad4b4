"""How signals end a training run: after its iteration, or, where that takes long, at once.

The loop looks at `StopSignals.signal` between iterations; in the middle of one `Interrupted` is raised.
"""

from __future__ import annotations

import _thread
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from mappo_unity.signals import DUPLICATE_SIGNAL_S, Interrupted, handled, scheduler_signals

PATIENCE_S = 5.0  # after a signal, before the iteration is given up


class StopSignals:
    """Take the signals of a run; the first lets the iteration end, a second one gives it up.

    Args:
        say: takes a line for the user.

    Attributes: `signal`, the number of the signal that came, or None.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self.signal: int | None = None
        self._say = say
        self._came_s = 0.0
        self._patience: threading.Timer | None = None

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Take SIGINT, SIGTERM and a scheduler's signals during the block."""
        with handled(self._on_signal, signal.SIGINT, signal.SIGTERM, *scheduler_signals()):
            try:
                yield
            finally:
                self.end_patience()

    @contextmanager
    def ignored(self) -> Iterator[None]:
        """Take no notice of signals during the block, in which a checkpoint is written."""
        self.end_patience()
        numbers = (signal.SIGINT, signal.SIGTERM, *scheduler_signals())
        with handled(lambda number, frame: None, *numbers):
            yield

    def end_patience(self) -> None:
        """Give nothing up any more: the iteration has ended."""
        if self._patience is not None:
            self._patience.cancel()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            if time.monotonic() - self._came_s > DUPLICATE_SIGNAL_S:
                raise Interrupted(self.signal)
            return

        self.signal, self._came_s = number, time.monotonic()
        # the same signal again, in the main thread: the iteration takes too long
        self._patience = threading.Timer(PATIENCE_S, _thread.interrupt_main, (number,))
        self._patience.daemon = True
        self._patience.start()

        self._say(
            f"stopping after this iteration, or in {PATIENCE_S:g} s with the one before it; "
            "once more to stop at once"
        )
