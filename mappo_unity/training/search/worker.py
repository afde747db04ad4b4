"""The process that runs trials, one after the other, as the driver hands them over."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config, SearchObjective
from mappo_unity.policies.warm_start.sources import adopt_file_options
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.folder import checkpoint_of_job, write_record
from mappo_unity.runs.lock import locked
from mappo_unity.scenes.factory import check_factory
from mappo_unity.training.child_process import begin_child
from mappo_unity.training.search.messages import GO, MARKS, PRUNE, Run, Task, TrialResult
from mappo_unity.training.sweep import RESULT, JobResult, note_failure

if TYPE_CHECKING:
    from mappo_unity.training.outcome import Outcome
    from mappo_unity.training.run_state import RunState

Report = Callable[[list[tuple[int, float]]], str]
"""Takes marks that a run has passed, with its mean return there; returns the driver's answer."""

_NOT_REACHED = 2
"""A run that misses the goal counts as if it took so many times its budget (the PAR2 score)."""


def work(pipe: Connection) -> None:
    """Run trials until the driver sends None, or ends."""
    begin_child()

    def report(marks: list[tuple[int, float]]) -> str:
        pipe.send(marks)
        return str(pipe.recv())

    while (task := pipe.recv()) is not None:
        pipe.send(run_trial(task, report))


def run_trial(task: Task, report: Report) -> TrialResult:
    """Train the runs of a trial, one for each seed, those that were begun from their checkpoints.

    The first run's marks are reported; all are asked after each iteration whether to go on.
    """
    result = TrialResult("complete")
    returns = []

    for index, run in enumerate(task.runs):
        job = JobResult(task.number, run.lines, "failed")
        try:
            outcome = _train(run, task, _Marks(report, is_compared=index == 0), job)
        except KeyboardInterrupt:  # before the first iteration: there is nothing to keep
            result.status = "stopped"
            break
        except Exception as error:
            note_failure(job, run.folder, error)
            outcome = None

        _write(run, job)
        result.agent_steps += job.agent_steps or 0
        result.wall_s += job.wall_s
        returns.append(math.nan if job.return_mean is None else job.return_mean)
        result.status, result.error = _status(outcome, job)
        if result.status != "complete":
            break
        assert outcome is not None
        result.values.append(_value(task.objective, outcome))

    mean = sum(returns) / max(1, len(returns))
    result.return_mean = mean if returns and math.isfinite(mean) else None
    return result


class _Marks:
    """What a run reports: its mean return at each of `MARKS` parts of its budget, when it has passed them.

    Args:
        report: to the driver.
        is_compared: whether this run's returns are; another one only asks whether to go on.
    """

    def __init__(self, report: Report, is_compared: bool) -> None:
        self._report, self._is_compared = report, is_compared
        self._passed = 0

    def __call__(self, state: RunState) -> str | None:
        """Report after an iteration; return the status that ends the run, or None."""
        passed = min(MARKS, MARKS * state.agent_steps // state.cfg.max_steps)
        answer = self._tell(passed, state.recent_episodes.summary()["return_mean"])
        return None if answer == GO else answer

    def finish(self, mean: float) -> None:
        """Pass what is left of a run that reached its goal: it would have stayed there."""
        self._tell(MARKS, mean)

    def _tell(self, passed: int, mean: float) -> str:
        if not (self._is_compared and math.isfinite(mean)):
            return self._report([])
        marks = [(mark, mean) for mark in range(self._passed + 1, passed + 1)]
        self._passed = max(self._passed, passed)
        return self._report(marks)


def _train(run: Run, task: Task, marks: _Marks, job: JobResult) -> Outcome:
    from rich.console import Console

    from mappo_unity.training.trainer import SOLVED, train

    start_s = time.monotonic()
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with locked(run.folder):
            config = _config(run, task)
            write_record(run.folder, config, run.lines)
            check_factory(config.env)
            checkpoint = checkpoint_of_job(run.folder)
            outcome = train(config, run.folder, checkpoint, marks, Console(quiet=True))
    finally:
        job.wall_s = round(time.monotonic() - start_s, 3)

    if outcome.status == SOLVED:
        marks.finish(outcome.return_mean)
    job.status, job.agent_steps, job.wall_s = outcome.status, outcome.agent_steps, outcome.wall_s
    job.return_mean = outcome.return_mean if math.isfinite(outcome.return_mean) else None
    return outcome


def _config(run: Run, task: Task) -> Config:
    return adopt_file_options(compose_config(run.lines, file=task.file).config, run.lines, task.file)


def _write(run: Run, job: JobResult) -> None:
    write_atomically(run.folder / RESULT, (json.dumps(asdict(job), indent=2) + "\n").encode())


def _status(outcome: Outcome | None, job: JobResult) -> tuple[str, str | None]:
    """Return the status of a trial after one of its runs, and what failed."""
    if outcome is None:
        return "failed", job.error
    if outcome.status == PRUNE:
        return "pruned", None
    if outcome.status in ("finished", "solved", "diverged"):
        return ("complete", None) if job.return_mean is not None else ("failed", "no episode has ended")
    return "stopped", None


def _value(objective: SearchObjective, outcome: Outcome) -> float:
    if objective is SearchObjective.final_return:
        return outcome.return_mean

    cost = float(outcome.agent_steps) if objective is SearchObjective.decisions else outcome.wall_s
    return cost if outcome.status == "solved" else _NOT_REACHED * cost
