"""The progress of a run on the terminal: one line that is updated in place, or now and then a plain line."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from rich.console import Console
from rich.live import Live
from rich.text import Text

PLAIN_INTERVAL_S = 2.0  # between two lines where there is no terminal
RATE_WINDOW_S = 300.0  # of the speed behind "left": so long that a series of matches does not rule it


@dataclass(frozen=True)
class Job:
    """What a job of a sweep puts before its lines, and whether other jobs print beside it."""

    mark: str = ""
    is_beside_others: bool = False


_NO_JOB = Job()
_job: ContextVar[Job] = ContextVar("job", default=_NO_JOB)


@contextmanager
def job_of_sweep(number: int, is_beside_others: bool) -> Iterator[None]:
    """Mark what is printed meanwhile as a job's: ``[job 3] 4,096/500,000 steps``."""
    token = _job.set(Job(f"[job {number}] ", is_beside_others))
    try:
        yield
    finally:
        _job.reset(token)


def current_job() -> Job:
    """Return the job of a sweep that runs here; one without a mark outside of sweeps."""
    return _job.get()


class Progress:
    """Show how far a run is; a line updated in place needs a terminal, elsewhere lines follow each other."""

    def __init__(self, console: Console, max_steps: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console
        self._max_steps = max_steps
        self._clock = clock
        self._job = current_job()
        self._marks: deque[tuple[float, int]] = deque()  # (time in s, agent steps)
        self._live: Live | None = None
        self._unprinted: str | None = None
        self._printed_at = -math.inf

    def update(self, row: Mapping[str, int | float]) -> None:
        """Show the newest row."""
        now = self._clock()
        self._marks.append((now, int(row["agent_steps"])))
        # Two marks stay at least: a speed needs both ends.
        while now - self._marks[0][0] > RATE_WINDOW_S and len(self._marks) > 2:
            self._marks.popleft()

        line = self._job.mark + describe(row, self._max_steps, self._rate(row))

        if self._has_terminal():
            self._update_live(line)
        else:
            self._unprinted = line
            if now - self._printed_at >= PLAIN_INTERVAL_S:
                self._print_plain()

    def close(self) -> None:
        """Leave the last line standing."""
        if self._live is not None:
            self._live.stop()
            self._live = None

        if self._unprinted is not None:
            self._print_plain()

    def _has_terminal(self) -> bool:
        """Return whether a line can be updated in place; several processes would write over each other."""
        terminal = self._console.is_terminal and not self._console.is_dumb_terminal
        return terminal and not self._job.is_beside_others

    def _update_live(self, line: str) -> None:
        if self._live is None:  # started late: before the first row there is nothing to show
            self._live = Live(console=self._console, auto_refresh=False)
            self._live.start()
        self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)

    def _print_plain(self) -> None:
        self._console.print(self._unprinted, markup=False, highlight=False, soft_wrap=True)
        self._unprinted = None
        self._printed_at = self._clock()

    def _rate(self, row: Mapping[str, int | float]) -> float:
        """Return agent steps per second over the window; the row's own figure before there are two rows."""
        (start_s, start), (end_s, end) = self._marks[0], self._marks[-1]
        if end_s > start_s:
            return (end - start) / (end_s - start_s)
        return row.get("steps_per_s", math.nan)


def describe(row: Mapping[str, int | float], max_steps: int, steps_per_s: float) -> str:
    """Return the progress line of a row, in 80 columns for a run of a million agent steps.

    `steps_per_s`: the speed that the time left is reckoned with.
    """
    steps = int(row["agent_steps"])
    lessons = [f"{value:.0f}" for name, value in row.items() if name.startswith("lesson/")]
    left_s = max(max_steps - steps, 0) / steps_per_s if steps_per_s > 0 else math.nan

    return "  ".join(
        (
            f"{steps:,}/{max_steps:,} steps",
            f"{_figure(row.get('steps_per_s', steps_per_s), ',.0f')}/s",
            f"return {_figure(row.get('return_mean', math.nan), '.2f')}",
            f"length {_figure(row.get('episode_length_mean', math.nan), '.0f')}",
            *([f"lesson {', '.join(lessons)}"] if lessons else []),
            f"{_duration(left_s)} left",
        )
    )


def _figure(value: float, spec: str) -> str:
    return format(value, spec) if math.isfinite(value) else "-"


def _duration(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "-"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
