"""The training loop: the file to read first.

`train` is the loop: collect, learn, count, play matches, log, save. What is trained comes from `setup`, what
is counted is in `run_state`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from rich.console import Console

from mappo_unity.config.schema import Config
from mappo_unity.diagnosis.watch import Watch
from mappo_unity.envs.statistics import with_statistics
from mappo_unity.errors import ConfigError
from mappo_unity.policies.export import RunExports
from mappo_unity.policies.warm_start.start import warm_start
from mappo_unity.reports.dashboard import dashboard
from mappo_unity.runs.checkpoint import set_aside_later
from mappo_unity.runs.logger import RunLog
from mappo_unity.scenes.contract.statistics import Statistics
from mappo_unity.signals import Interrupted
from mappo_unity.training.collection.fleet import Batches
from mappo_unity.training.episode_stats import by_policy
from mappo_unity.training.memory import is_out_of_memory
from mappo_unity.training.outcome import DIVERGED, FINISHED, INTERRUPTED, SOLVED, Outcome, why_over
from mappo_unity.training.resume_check import describe_policies
from mappo_unity.training.run_state import RunState
from mappo_unity.training.saver import CheckpointSaver
from mappo_unity.training.setup import set_up
from mappo_unity.training.stop_signals import StopSignals

__all__ = ["Outcome", "train", "why_over"]

AfterIteration = Callable[[RunState], "str | None"]
"""Called after each iteration; what it returns, unless None, ends the run with this status."""


def train(
    cfg: Config,
    folder: Path,
    resume_from: Path | None = None,
    after_iteration: AfterIteration | None = None,
    console: Console | None = None,
) -> Outcome:
    """Train to the end of the run, from a checkpoint where one is given.

    Whatever ends the run, the last complete iteration is saved first.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        resume_from: a checkpoint of this run.
        after_iteration: see `AfterIteration`.
        console: where progress and messages go; None: standard output.

    Raises:
        ConfigError: options, checkpoint and environment do not fit together, or memory ran out.
        EnvironmentFailure: the environment failed for good.
        Interrupted: a signal came before the first iteration was complete.
    """
    with _memory_explained(cfg), dashboard(cfg.log, folder) as address, set_up(cfg, folder) as setup:
        state = RunState(cfg, folder, setup)
        if resume_from is not None:
            state.load(resume_from)
        started = warm_start(cfg, setup.learners, describe_policies(setup.env)) if resume_from is None else []

        resume_steps = state.agent_steps if resume_from is not None else None
        with RunLog(cfg.log, folder, cfg.max_steps, resume_steps, console) as log:
            # not before: until here something may be refused
            begun = _begin_in(folder, resume_from, state.agent_steps)
            served = [] if address is None else [f"dashboard: {address}"]
            for note in [*begun, *served, *setup.notes, *state.notes, *started]:
                log.message(note)

            exports = RunExports(folder, log.message, resume_from is not None) if cfg.export_onnx else None
            saver = CheckpointSaver(cfg, folder, state, exports, resume_from)
            stop = StopSignals(log.message)
            specs = {name: behavior.spec for name, behavior in setup.env.behaviors.items()}
            watch = Watch(folder, specs, setup.env.sides)

            with setup.collecting() as batches, stop.taken():
                state.restore_rng()
                state.begin()
                status = _iterate_and_save(cfg, batches, state, saver, log, watch, stop, after_iteration)
            return _outcome(status, state, saver, stop)


def _begin_in(folder: Path, resume_from: Path | None, agent_steps: int) -> list[str]:
    """Move what is in a resumed run's way aside; return lines about where the run begins."""
    if resume_from is None:
        return [f"run folder: {folder}"]
    return [f"resuming from {resume_from}", *set_aside_later(folder, resume_from, agent_steps)]


def _iterate_and_save(
    cfg: Config,
    batches: Batches,
    state: RunState,
    saver: CheckpointSaver,
    log: RunLog,
    watch: Watch,
    stop: StopSignals,
    after_iteration: AfterIteration | None,
) -> str:
    """Iterate, and save the last complete iteration whatever ends that; return the status."""
    try:
        status = _iterate(cfg, batches, state, saver, log, watch, stop, after_iteration)
        saver.finish()
    except BaseException as error:
        with stop.ignored():
            saver.rescue(log.message_if_possible)
            if isinstance(error, Interrupted) and saver.last is not None:
                with suppress(OSError):  # nobody may be left to tell what went wrong
                    saver.export()  # last: a scheduler that kills meanwhile costs these files alone
                return INTERRUPTED
        raise  # an interrupted run has an outcome only where it can be resumed
    return status


def _iterate(
    cfg: Config,
    batches: Batches,
    state: RunState,
    saver: CheckpointSaver,
    log: RunLog,
    watch: Watch,
    stop: StopSignals,
    after_iteration: AfterIteration | None,
) -> str:
    """Iterate until the steps are done, the return is reached or a signal comes; return the status."""
    if state.agent_steps >= cfg.max_steps and state.matches.is_missing:
        _play_missing_series(state, saver, log)

    status = _status(cfg, state, stop)
    while status is None:
        started_s = time.perf_counter()
        batch = next(batches)
        collected_s = time.perf_counter()

        crashed = state.count_crashed(batch)
        watch.add(batch.rounds, batch.episodes)
        learned = state.setup.learn(batch, progress=state.agent_steps / cfg.max_steps)
        learned_s = time.perf_counter()

        row = state.count(batch, collect_s=collected_s - started_s, update_s=learned_s - collected_s)
        row |= crashed | by_policy(learned)
        new_lessons = state.advance_lessons(batch, batches)
        row |= state.advance_self_play(batch, batches)
        statistics = batch.statistics
        del batch  # the next one is collected without it
        saver.complete()  # whatever happens from here on, this iteration is saved
        for name, metrics in learned.items():
            _warn_rollback(name, metrics, state, log)
        for text in new_lessons:
            log.message(text)

        series = _play_series(state, saver, log, row, statistics)
        for text in watch.news() + ([state.matches.said] if series else []):
            log.message(text)

        # The best weights are those that won the series, not those of a later checkpoint.
        saver.save_if_due(won=bool(series) and state.is_best())
        status = (after_iteration(state) if after_iteration else None) or _status(cfg, state, stop)

    watch.write()
    # the loop is over: the timer of a first signal must not break off the last checkpoint
    stop.end_patience()
    return status


def _play_missing_series(state: RunState, saver: CheckpointSaver, log: RunLog) -> None:
    """Play the last series of matches of a run, which was broken off; its iteration's row stays as it is."""
    state.play_matches()
    saver.add_series()
    log.message(state.matches.said)


def _play_series(
    state: RunState, saver: CheckpointSaver, log: RunLog, row: dict[str, float], statistics: Statistics
) -> dict[str, float]:
    """Play the series of matches that is due, if one is, and log the iteration's row; return its figures."""
    series: dict[str, float] = {}
    try:
        series = state.play_matches()
        saver.complete_matches()
    finally:  # a series that fails costs no row
        log.log(*with_statistics(row | series, statistics))
    return series


def _status(cfg: Config, state: RunState, stop: StopSignals) -> str | None:
    """Return the status with which the run ends now, or None while there is more to do."""
    if stop.signal is not None:
        return INTERRUPTED
    if state.agent_steps >= cfg.max_steps:
        return FINISHED
    goal = cfg.stop_at_return
    if goal is not None and state.lessons.are_last and state.recent_episodes.reached(goal):
        return SOLVED
    return None


def _warn_rollback(name: str, metrics: dict[str, float], state: RunState, log: RunLog) -> None:
    """Say it when a policy's update was rolled back, for the first time, the 2nd, 4th, 8th ..."""
    rolled_back, updates = state.updates[name]
    is_power_of_two = rolled_back.bit_count() == 1
    if metrics.get("rolled_back") and is_power_of_two:
        limit = state.setup.learners[name].cfg.max_kl
        log.message(
            f"iteration {state.iteration}: the update of {name} was rolled back (approximate KL "
            f"{metrics['kl_last']:.3g}, limit ppo.max_kl={limit:g}); {rolled_back} of {updates} so far"
        )


def _outcome(status: str, state: RunState, saver: CheckpointSaver, stop: StopSignals) -> Outcome:
    diverged = any(2 * rolled_back > updates for rolled_back, updates in state.updates.values())
    # Only a run that did all its steps is called diverged: any other end tells more.
    return Outcome(
        DIVERGED if status == FINISHED and diverged else status,
        stop.signal,
        state.agent_steps,
        state.wall_s,
        state.recent_episodes.summary()["return_mean"],
        saver.best,
        saver.last,
        state.updates,
    )


@contextmanager
def _memory_explained(cfg: Config) -> Iterator[None]:
    """Turn memory that runs out into a line that says what makes it less."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        areas = "" if cfg.env.num_areas is None else f"env.num_areas={cfg.env.num_areas}, "
        raise ConfigError(
            f"memory ran out ({' '.join(str(error).split()) or type(error).__name__}); lower {areas}"
            f"collect.batch_size={cfg.collect.batch_size}, ppo.minibatch_size={cfg.ppo.minibatch_size} or "
            f"model.hidden={list(cfg.model.hidden)}"
        ) from error
