"""Processes that a run starts and that end with it: workers that collect, learners beside the first."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def start_child(
    target: Callable[..., None], arguments: tuple[Any, ...], name: str
) -> tuple[BaseProcess, Connection]:
    """Start a process; return it and the driver's end of a pipe, whose other end is its last argument.

    Args:
        target: what it runs, which begins with `begin_child`.
        arguments: of `target`, before the pipe.
        name: of the process.
    """
    # "spawn": a copy of a process in which torch has run may hang
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=target, args=(*arguments, theirs), name=name)
    with _interrupts_blocked(), _without_main():
        process.start()
    theirs.close()
    return process, mine


def begin_child() -> None:
    """Leave signals to the driver, and do not outlive it; for the process itself."""
    _follow_parent()
    # not SIG_IGN, which players would inherit
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(signal_number, lambda number, frame: None)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _follow_parent() -> None:
    """Do not outlive the driver, however it ends."""
    parent: Any = parent_process()

    # a thread cannot run while the environment's own code holds Python's lock: the kernel can
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if not parent.is_alive():
            os._exit(1)

    def follow() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


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
