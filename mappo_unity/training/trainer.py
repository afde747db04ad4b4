"""Build a trainer from options and run it: the file to read first.

In: `Config`, a run folder. Out: checkpoints, metrics, an `Outcome`. `Trainer.iterate` is the loop:
collect, learn, count, log, save.
"""

from __future__ import annotations

import _thread
import copy
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.per_behavior import options_of
from mappo_unity.config.schema import Config, ConfigError
from mappo_unity.envs.transforms import transformed
from mappo_unity.interrupts import handled
from mappo_unity.learning.actor_critic import JointPolicy
from mappo_unity.policies.export import RunExports, sample_inputs
from mappo_unity.runs import checkpoint
from mappo_unity.runs.logger import RunLog, check_backends
from mappo_unity.runs.rng import get_rng_state, set_rng_state
from mappo_unity.stopping import ECHO_S
from mappo_unity.termination import Interrupted
from mappo_unity.training.build import batch_rounds, make_learners, make_unity_env, prepare_torch
from mappo_unity.training.collect import make_collector
from mappo_unity.training.crashed_episodes import drop_episodes
from mappo_unity.training.episode_stats import EpisodeWindow, by_policy, count_decisions
from mappo_unity.training.match_series import MatchSeries
from mappo_unity.training.memory import is_out_of_memory
from mappo_unity.training.resume_check import check_fits, describe_models, describe_policies

PATIENCE_S = 5.0  # after a signal, before the iteration is given up
DIVERGED = "diverged"  # status of a run most of whose updates were rolled back


@dataclass
class Outcome:
    """How a run ended."""

    status: str  # "finished", "solved", "diverged" or "interrupted"
    signal: int | None
    agent_steps: int
    wall_s: float
    return_mean: float
    best_checkpoint: Path | None
    last_checkpoint: Path | None
    updates: dict[str, tuple[int, int]] = field(default_factory=dict)
    """For each policy name: how many updates were rolled back, and how many there were."""


def train(cfg: Config, folder: Path, resume_from: Path | None = None) -> Outcome:
    """Train to the end of the run, from a checkpoint where one is given.

    Whatever ends the run, the last complete iteration is saved first.

    Raises:
        ConfigError: options, checkpoint and environment do not fit together, or memory ran out.
        EnvironmentFailure: the environment failed for good.
        Interrupted: a signal came before the first iteration was complete.
    """
    trainer: Trainer | None = None
    try:
        trainer = Trainer(cfg, folder)
        if resume_from is not None:
            trainer.load(resume_from)
        return trainer.run()
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise ConfigError(
            f"memory ran out ({' '.join(str(error).split()) or type(error).__name__}); lower "
            f"collect.batch_size={cfg.collect.batch_size}, ppo.minibatch_size={cfg.ppo.minibatch_size} or "
            f"model.hidden={list(cfg.model.hidden)}"
        ) from error
    finally:
        if trainer is not None:
            trainer.close()


def why_over(cfg: Config, path: Path) -> str | None:
    """Return why a run at a checkpoint has nothing left to train, or None.

    Args:
        cfg: the options with which it would be resumed.
        path: the checkpoint.
    """
    state = checkpoint.load(path)
    if state["agent_steps"] >= cfg.max_steps:
        return (
            f"it has done {state['agent_steps']:,} of max_steps={cfg.max_steps:,} steps; "
            "max_steps=N with a larger N trains on"
        )

    window = EpisodeWindow(cfg.log.return_window, list(state["window"]["recent"]))
    window.load_state_dict(state["window"])
    if cfg.stop_at_return is not None and window.reached(cfg.stop_at_return):
        mean = window.summary()["return_mean"]
        return (
            f"its mean return {mean:.4g} has reached stop_at_return={cfg.stop_at_return:g}; "
            "stop_at_return=null, or a higher one, trains on"
        )
    return None


class Trainer:
    """Environment, learners, counters and their checkpoint."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        prepare_torch(cfg)
        check_backends(cfg.log)
        self.cfg, self.folder = cfg, folder
        self.notes: list[str] = []  # for the user, when the run begins
        self.env = make_unity_env(cfg, folder)
        try:
            self.learners = make_learners(cfg, self.env, self.notes.append)
            self.matches = MatchSeries(cfg, folder, self.env.behaviors)
        except BaseException:
            self.env.close()
            raise
        self.policy = JointPolicy({name: learner.actor for name, learner in self.learners.items()})
        self.window = EpisodeWindow(cfg.log.return_window, list(self.env.behaviors))
        self.iteration = self.agent_steps = 0
        self.wall_s = 0.0
        self.restarts_before = self.dropped_episodes = self.dropped_steps = 0
        self.saved_at = 0
        self.best_score = -math.inf
        self.last_checkpoint: Path | None = None
        self.stop_signal: int | None = None
        self.stopped_s = 0.0  # when it came
        self._patience: threading.Timer | None = None
        self._complete: dict[str, Any] | None = None  # state of the last complete iteration of this process
        self._saved_iteration: int | None = None  # of the last checkpoint
        self.resumed = False
        self._rng_state: dict[str, Any] | None = None  # of the checkpoint that is continued
        self.log: RunLog | None = None
        self.samples: dict[str, dict[str, torch.Tensor]] = {}  # what an export is compared on
        self.exports: RunExports | None = None

    # --- the loop

    def run(self) -> Outcome:
        """Iterate until the steps are done, the return is reached or a signal comes."""
        resume_steps = self.agent_steps if self.resumed else None
        self.log = RunLog(self.cfg.log, self.folder, self.cfg.max_steps, resume_steps)
        if self.cfg.env.note is not None:
            self.log.message(f"note: {self.cfg.env.note}")
        for note in self.notes:
            self.log.message(note)
        if self.cfg.export_onnx:
            self.exports = RunExports(self.folder, self.log.message)
        collector = self.make_collector()
        if self._rng_state is not None:
            set_rng_state(self._rng_state)

        try:
            with handled(self._on_signal, signal.SIGINT, signal.SIGTERM):
                status = self._iterate_to_the_end(iter(collector))
        finally:
            self._end_patience()
            collector.shutdown(close_env=False)
        return self._outcome(status)

    def _iterate_to_the_end(self, batches: Iterator[TensorDictBase]) -> str:
        """Iterate, save and return the status; whatever breaks in, the last complete iteration is saved."""
        try:
            status = self._status()
            while status is None:
                self.iterate(batches)
                status = self._status()
            self._end_patience()
            self.save()
            if self.exports is not None:
                self.exports.finish(self.last_checkpoint)
            return status
        except BaseException as error:
            with handled(lambda number, frame: None, signal.SIGINT, signal.SIGTERM):
                self._rescue()
            if isinstance(error, Interrupted) and self.last_checkpoint is not None:
                return "interrupted"
            raise

    def _rescue(self) -> None:
        """Save the last complete iteration before an error or a second signal ends the run; say where."""
        try:
            self.save()
        except ConfigError as error:
            self._say(str(error))
            return
        if self._complete is None:
            if not self.resumed:
                self._say("no iteration was complete: there is nothing to resume")
            return
        iteration, steps = self._complete["iteration"], self._complete["agent_steps"]
        self._say(
            f"saved the last complete iteration, {iteration} ({steps:,} steps): {self.last_checkpoint}; "
            f"resume with: mappo-train {shell_argument('resume', self.folder)}"
        )

    def _say(self, text: str) -> None:
        with suppress(OSError):  # whoever read our output may be gone, or the disk it went to full
            if self.log is not None:
                self.log.message(text)

    def _outcome(self, status: str) -> Outcome:
        updates = {name: (learner.rollbacks, learner.updates) for name, learner in self.learners.items()}
        learns_little = any(2 * rolled > total for rolled, total in updates.values())
        if status == "finished" and learns_little:
            status = DIVERGED
        best = self.folder / checkpoint.FOLDER / checkpoint.BEST
        return Outcome(
            status,
            self.stop_signal,
            self.agent_steps,
            self.wall_s,
            self.window.summary()["return_mean"],
            best if best.exists() else None,
            self.last_checkpoint,
            updates,
        )

    def make_collector(self) -> Collector:
        """Build the collector; it goes on where the environment stands."""
        rounds = batch_rounds(self.cfg, self.env)
        return make_collector(transformed(self.env), self.policy, rounds, self.cfg.device)

    def iterate(self, batches: Any) -> None:
        """Collect a batch, learn from it, log, and save when it is time."""
        start = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        troubles = self._drop_cut_off(batch)
        learned = self._learn(batch)
        steps = count_decisions(batch, list(self.learners))
        self.samples = {
            name: sample_inputs(batch.get(name), learner.actor.in_keys)
            for name, learner in self.learners.items()
        }
        end = time.perf_counter()

        self.iteration += 1
        self.agent_steps += steps
        self.wall_s += end - start
        episodes = self.window.add(self.env.pop_episodes())
        times = {
            "steps_per_s": steps / (end - start),
            "collect_s": collected - start,
            "update_s": end - collected,
        }
        row = {"episodes": self.window.total, "episodes_new": episodes} | self.window.summary()
        row |= times | troubles | by_policy(learned)
        self._complete = self._copied_state()
        self._warn_rollbacks(learned)
        series: dict[str, float] = {}
        try:
            series = self._play_matches()
            self._complete["matches"] = self.matches.state_dict()
        finally:  # a series that fails costs no row
            self._log_row(row | series)
        won = bool(series) and self._score() >= self.best_score  # these weights, not those of later on
        if won or self.last_checkpoint is None or self._interval_is_over():
            self.save(won)

    def _interval_is_over(self) -> bool:
        return self.agent_steps - self.saved_at >= self.cfg.checkpoint_interval

    def _drop_cut_off(self, batch: TensorDictBase) -> dict[str, float]:
        """Take episodes that failed players cut off out of the batch; count them, and the restarts."""
        if self.env.restarts is None:
            return {}
        cuts = self.env.pop_cut_off()
        self.dropped_steps += drop_episodes(batch, cuts, self.env)
        self.dropped_episodes += sum(int(cut.slots.sum()) for cut in cuts)
        return {
            "restarts": float(self.restarts),
            "dropped_episodes": float(self.dropped_episodes),
            "dropped_steps": float(self.dropped_steps),
        }

    @property
    def restarts(self) -> int:
        """Return how often players were started again in this run."""
        return self.restarts_before + (self.env.restarts or 0)

    def _learn(self, batch: TensorDictBase) -> dict[str, dict[str, float]]:
        progress = self.agent_steps / self.cfg.max_steps
        torch.set_num_threads(min(self.cfg.update_threads, os.cpu_count() or 1))
        metrics = {
            name: learner.learn(self.entries(batch, name), progress)
            for name, learner in self.learners.items()
        }
        torch.set_num_threads(self.cfg.num_threads)
        return metrics

    @staticmethod
    def entries(batch: TensorDictBase, name: str) -> TensorDictBase:
        """Return one policy name's entries of a batch, with its own ``next``."""
        entries = batch.get(name).copy()
        entries.set("next", batch.get(("next", name)))
        return entries

    def _log_row(self, row: dict[str, float]) -> None:
        if self.log is not None:
            counters = {"iteration": self.iteration, "agent_steps": self.agent_steps, "wall_s": self.wall_s}
            self.log.log(counters | row)

    def _warn_rollbacks(self, learned: dict[str, dict[str, float]]) -> None:
        """Say it when a policy's update was rolled back, for the first time, the 2nd, 4th, 8th ..."""
        for name, metrics in learned.items():
            learner = self.learners[name]
            is_power_of_two = learner.rollbacks & (learner.rollbacks - 1) == 0
            if metrics.get("rolled_back") and is_power_of_two:
                self._say(
                    f"iteration {self.iteration}: the update of {name} was rolled back (approximate KL "
                    f"{metrics['kl_last']:.3g}, limit ppo.max_kl={learner.cfg.max_kl:g}); "
                    f"{learner.rollbacks} of {learner.updates} so far"
                )

    def _play_matches(self) -> dict[str, float]:
        """Play a series of matches when it is due."""
        if not self.matches.is_due(self.agent_steps):
            return {}
        actors = {name: learner.actor for name, learner in self.learners.items()}
        figures = self.matches.play(self.agent_steps, self._layout(), actors)
        if self.log is not None:
            self.log.message(self.matches.said)
        return figures

    def _score(self) -> float:
        """What the best checkpoint is chosen by: return_mean; where there are two sides, the matches.

        (There one side's gain is the other's loss, and the mean return says nothing.)
        """
        if self.matches.two_sided:
            return self.matches.score(self.agent_steps)
        return self.window.summary()["return_mean"]

    def _status(self) -> str | None:
        if self.stop_signal is not None:
            return "interrupted"
        if self.agent_steps >= self.cfg.max_steps:
            return "finished"
        if self.cfg.stop_at_return is not None and self.window.reached(self.cfg.stop_at_return):
            return "solved"
        return None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """Let the iteration end at the first signal, unless it takes too long; give it up at the second."""
        if self.stop_signal is not None:
            if time.monotonic() - self.stopped_s > ECHO_S:
                raise Interrupted(self.stop_signal)
            return
        self.stop_signal, self.stopped_s = number, time.monotonic()
        self._patience = threading.Timer(PATIENCE_S, _thread.interrupt_main, (number,))
        self._patience.daemon = True
        self._patience.start()
        self._say(
            f"stopping after this iteration, or in {PATIENCE_S:g} s with the one before it; "
            "once more to stop at once"
        )

    def _end_patience(self) -> None:
        if self._patience is not None:
            self._patience.cancel()

    # --- checkpoints

    def save(self, best: bool = False) -> None:
        """Write a checkpoint of the last complete iteration, unless there is one.

        `best`: call it the best one though its score is only as good as the best before.
        """
        state = self._complete
        if state is None or state["iteration"] == self._saved_iteration:
            return
        score = self._score()
        best = best or score > self.best_score
        if best:
            self.best_score = score
        if self.last_checkpoint is not None:  # the first one comes early and is not part of the rhythm
            self.saved_at = state["agent_steps"]
        state |= {"best_score": self.best_score, "saved_at": self.saved_at}

        path = checkpoint.save_in(self.folder, state["agent_steps"], state, self.cfg.keep_checkpoints, best)
        self.last_checkpoint, self._saved_iteration = path, state["iteration"]
        if best and self.exports is not None:
            self.exports.best_changed()

    def _copied_state(self) -> dict[str, Any]:
        """Return `state_dict` with copies of what the next iteration changes in place."""
        state = self.state_dict()
        return state | {"learners": copy.deepcopy(state["learners"])}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that continuing needs, between two iterations."""
        return {
            "env_name": self.cfg.env.name,
            "model": self._models(),
            "layout": self._layout(),
            "learners": {name: learner.state_dict() for name, learner in self.learners.items()},
            "env": self.env.get_state(),
            "window": self.window.state_dict(),
            "matches": self.matches.state_dict(),
            "rng": get_rng_state(),
            "samples": self.samples,
            **{name: getattr(self, name) for name in self._COUNTERS},
            "restarts_before": self.restarts,
        }

    _COUNTERS = (
        *("iteration", "agent_steps", "wall_s", "saved_at", "best_score"),
        *("restarts_before", "dropped_episodes", "dropped_steps"),
    )

    def load(self, path: Path) -> None:
        """Continue from a checkpoint.

        Raises:
            CheckpointError: it belongs to another environment or another network.
        """
        state = checkpoint.load(path)
        check_fits(path, state, self.cfg.env.name, self._layout(), self._models())
        for name, learner in self.learners.items():
            learner.load_state_dict(state["learners"][name])
        if state["env"] is not None:
            self._restore_env(path, checkpoint.to_arrays(state["env"]))
        self.window.load_state_dict(state["window"])
        self.matches.load_state_dict(state["matches"])
        for name in self._COUNTERS:
            setattr(self, name, state[name])
        self._rng_state = state["rng"]
        self.samples = state.get("samples", {})
        self.last_checkpoint, self._saved_iteration = path, self.iteration
        self.resumed = True

    def _restore_env(self, path: Path, state: dict[str, Any]) -> None:
        try:
            self.env.set_state(state)
        except ConfigError as error:
            raise checkpoint.CheckpointError(
                f"checkpoint {path} does not fit the environment's options, which cannot change with resume: "
                f"{error}"
            ) from error

    def _layout(self) -> dict[str, Any]:
        return describe_policies(self.env)

    def _models(self) -> dict[str, Any]:
        return describe_models({name: options_of(self.cfg, name)[0] for name in self.learners})

    def close(self) -> None:
        """Close the environment and the logs."""
        if self.log is not None:
            self.log.close()
        if not self.env.is_closed:
            self.env.close()
