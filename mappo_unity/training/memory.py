"""How much memory is free, and whether something fits into it."""

from __future__ import annotations

import os
from pathlib import Path

from mappo_unity.errors import ConfigError

_CGROUP = Path("/sys/fs/cgroup")
_UNITS = ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB")


def free_memory() -> int | None:
    """Return the bytes of memory that this process can still take; None where nobody knows."""
    limits = [size for size in (_free_of_machine(), _free_of_container()) if size is not None]
    return min(limits, default=None)


def check_free(needed: float, what: str, remedy: str) -> None:
    """Raise ConfigError if so many bytes are more than what is free.

    Args:
        needed: in bytes.
        what: needs them, the beginning of the message.
        remedy: the end of the message.
    """
    free = free_memory()
    if free is not None and needed > free:
        raise ConfigError(f"{what} takes about {show_size(needed)}, but {show_size(free)} are free; {remedy}")


def show_size(size: float) -> str:
    """Return a number of bytes for reading: 3.5 GiB."""
    unit = 0
    while size >= 1024 and unit < len(_UNITS) - 1:
        size, unit = size / 1024, unit + 1
    return f"{size:,.0f} {_UNITS[unit]}" if unit == 0 or size >= 100 else f"{size:,.1f} {_UNITS[unit]}"


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception says that memory ran out; torch says so by a RuntimeError."""
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def _free_of_machine() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        pass  # not Linux

    try:  # what is left out here are caches, which the system would give up: an underestimate
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _free_of_container() -> int | None:
    """Return what a container's limit leaves (cgroup version 2); None without a limit."""
    try:
        limit = (_CGROUP / "memory.max").read_text().strip()
        used = int((_CGROUP / "memory.current").read_text())
        stat = dict(line.split() for line in (_CGROUP / "memory.stat").read_text().splitlines())
        # Files in the cache count as used there, but the system gives up the inactive ones when asked.
        return None if limit == "max" else int(limit) - used + int(stat.get("inactive_file", 0))
    except (OSError, ValueError):
        return None
