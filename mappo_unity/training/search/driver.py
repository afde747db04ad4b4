"""The driver of a search: hands trials to processes, keeps what they report, and replaces those that die."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any

from mappo_unity.errors import ConfigError
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.lock import locked
from mappo_unity.training.child_process import start_child
from mappo_unity.training.search.checks import RECORD, SearchPlan
from mappo_unity.training.search.messages import GO, PRUNE, STOP, Run, Task, TrialResult
from mappo_unity.training.search.table import Row, rows_of, write_csv
from mappo_unity.training.search.worker import work
from mappo_unity.training.sweep_signals import SweepSignalHandler, sweep_signals

if TYPE_CHECKING:
    from optuna.trial import Trial

    from mappo_unity.training.search.study import SearchStudy

MOST_LOST = 3
"""A trial whose process died so often has failed."""
_END_S = 5.0  # for a process that has nothing to do any more

Told = Callable[[int, list[Row]], None]
"""Called when a trial has ended, with its number and all trials, best first."""


@dataclass
class SearchResult:
    """What came of a search: its trials, best first, and the signal that ended it, if one did."""

    rows: list[Row]
    signal: int | None

    @property
    def exit_code(self) -> int:
        """0 where a trial is complete, 128 + signal where one ended the search, else 1."""
        if self.signal is not None:
            return 128 + self.signal
        return 0 if any(row.status == "complete" for row in self.rows) else 1


def run_search(plan: SearchPlan, told: Told) -> SearchResult:
    """Run the trials that are left of a search.

    Raises:
        ConfigError: its folder cannot be made, or another process is at it.
    """
    folder = plan.folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={folder} cannot be made ({error.strerror}: {error.filename})") from error
    patience, number = SweepSignalHandler(), None

    with locked(folder, f"the search in {folder} is being run"):
        write_atomically(folder / RECORD, (json.dumps(plan.record(), indent=2) + "\n").encode())
        from mappo_unity.training.search.study import SearchStudy

        study = SearchStudy(plan)
        try:
            with (
                sweep_signals(patience, parallel=True),
                _Driver(plan, study, patience, told).ended() as driver,
            ):
                driver.run()
        except KeyboardInterrupt as error:  # the second one
            number = getattr(error, "signal", int(signal.SIGINT))

        rows = rows_of(study.trials, plan)
        write_csv(rows, plan)
    return SearchResult(rows, number or patience.number)


@dataclass
class _Worker:
    """A process, the pipe to it, and the trial that it runs."""

    process: BaseProcess
    pipe: Connection
    trial: Trial | None = None


class _Driver:
    """What `run_search` keeps while trials run.

    Args:
        plan: the search.
        study: its trials.
        patience: knows whether a signal has come.
        told: see `Told`.
    """

    def __init__(
        self, plan: SearchPlan, study: SearchStudy, patience: SweepSignalHandler, told: Told
    ) -> None:
        self._plan, self._study, self._patience, self._told = plan, study, patience, told
        self._waiting = study.unfinished()
        self._asked = len(study.trials)
        self._workers: list[_Worker] = []

    @contextmanager
    def ended(self) -> Iterator[_Driver]:
        """Leave no process behind."""
        try:
            yield self
        finally:
            for worker in self._workers:
                if worker.trial is None:
                    with suppress(OSError):
                        worker.pipe.send(None)
                else:  # only where something was raised: a second signal
                    worker.process.kill()
            for worker in self._workers:
                worker.process.join(_END_S)
                worker.process.kill()
                worker.pipe.close()

    def run(self) -> None:
        """Run trials until as many are done as were wanted, or a signal has ended those that run."""
        number = self._plan.options.workers or os.cpu_count() or 1
        while True:
            while len(self._busy()) < number and self._patience.number is None:
                trial = self._next()
                if trial is None:
                    break
                self._hand(trial)

            busy = self._busy()
            if not busy:
                return
            ready = wait([worker.pipe for worker in busy])
            for worker in busy:
                if worker.pipe in ready:
                    self._answer(worker)

    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.trial is not None]

    def _next(self) -> Trial | None:
        """Return a trial that broke off, or a new one; None where all were asked for."""
        if self._waiting:
            return self._waiting.pop(0)
        if self._asked >= self._plan.options.trials:
            return None
        self._asked += 1
        return self._study.ask()

    def _hand(self, trial: Trial) -> None:
        worker = next((worker for worker in self._workers if worker.trial is None), None)
        if worker is None:
            worker = _Worker(*start_child(work, (), "mappo-search worker"))
            self._workers.append(worker)

        worker.trial = trial
        with suppress(OSError):  # it died: its pipe tells so next
            worker.pipe.send(self._task(trial))

    def _task(self, trial: Trial) -> Task:
        plan = self._plan
        lines = [*plan.lines, *self._study.suggest(trial)]
        seeds = range(plan.first_seed, plan.first_seed + plan.options.seeds)
        runs = [Run(plan.folder / f"{trial.number:03d}-{seed}", [*lines, f"seed={seed}"]) for seed in seeds]
        return Task(trial.number, runs, plan.objective, plan.file)

    def _answer(self, worker: _Worker) -> None:
        """Take a message of a worker: marks that its run has passed, or what came of its trial."""
        trial: Any = worker.trial
        try:
            message = worker.pipe.recv()
        except (EOFError, OSError):
            self._lose(worker, trial)
            return

        if isinstance(message, TrialResult):
            worker.trial = None
            if message.status == "stopped":
                self._again(trial)
            else:
                self._tell(trial, message)
            return

        prune = self._study.report(trial, message)
        answer = STOP if self._patience.number is not None else PRUNE if prune else GO
        with suppress(OSError):
            worker.pipe.send(answer)

    def _lose(self, worker: _Worker, trial: Trial) -> None:
        """Let a trial whose process died be run again, a few times."""
        worker.process.join()
        worker.pipe.close()
        self._workers.remove(worker)
        # a second signal of the user's, handed on, is no fault of the trial
        if self._patience.number is None:
            self._again(trial, f"its process died (exit code {worker.process.exitcode})")

    def _again(self, trial: Trial, error: str = "its process was ended by a signal") -> None:
        if self._patience.number is not None:
            return  # the next call takes it up
        lost = self._study.count_lost(trial)
        if lost < MOST_LOST:
            self._waiting.append(trial)
        else:
            self._tell(trial, TrialResult("failed", error=f"{error}, {lost} times"))

    def _tell(self, trial: Trial, result: TrialResult) -> None:
        self._study.tell(trial, result)
        rows = rows_of(self._study.trials, self._plan)
        write_csv(rows, self._plan)
        self._told(trial.number, rows)
