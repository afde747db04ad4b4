"""Build a trainer from options and run it: the file to read first.

In: `Config`, a run folder. Out: checkpoints, metrics, an `Outcome`. `Trainer.iterate` is the loop:
collect, learn, count, log, save.
"""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from mappo_unity import checkpoint
from mappo_unity.behavior_options import options_of
from mappo_unity.build import batch_rounds, make_learners, make_unity_env, prepare_torch
from mappo_unity.collect import make_collector
from mappo_unity.config import Config, EnvironmentFailure
from mappo_unity.drops import drop_episodes
from mappo_unity.export import RunExports, sample_inputs
from mappo_unity.fit import check_fits, describe_models, describe_policies
from mappo_unity.log import RunLog, check_backends
from mappo_unity.metrics import EpisodeWindow, by_policy, count_decisions
from mappo_unity.models import JointPolicy
from mappo_unity.rng import get_rng_state, set_rng_state
from mappo_unity.series import MatchSeries
from mappo_unity.stopping import ECHO_S
from mappo_unity.transforms import transformed


@dataclass
class Outcome:
    """How a run ended."""

    status: str  # "finished", "solved" or "interrupted"
    signal: int | None
    agent_steps: int
    wall_s: float
    return_mean: float
    best_checkpoint: Path | None
    last_checkpoint: Path | None


def train(cfg: Config, folder: Path, resume_from: Path | None = None) -> Outcome:
    """Run a training to its end, or on from a checkpoint.

    Raises:
        ConfigError: options, checkpoint and environment do not fit together.
    """
    trainer = Trainer(cfg, folder)
    try:
        if resume_from is not None:
            trainer.load(resume_from)
        return trainer.run()
    finally:
        trainer.close()


class Trainer:
    """Environment, learners, counters and their checkpoint."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        prepare_torch(cfg)
        check_backends(cfg.log)
        self.cfg, self.folder = cfg, folder
        self.env = make_unity_env(cfg, folder)
        self.learners = make_learners(cfg, self.env)
        self.policy = JointPolicy({name: learner.actor for name, learner in self.learners.items()})
        self.window = EpisodeWindow(cfg.log.return_window, list(self.env.behaviors))
        self.iteration = self.agent_steps = 0
        self.wall_s = 0.0
        self.restarts_before = self.dropped_episodes = self.dropped_steps = 0
        self.saved_at = 0
        self.best_score = -math.inf
        self.matches = MatchSeries(cfg, folder, self.env.behaviors)
        self.last_checkpoint: Path | None = None
        self.stop_signal: int | None = None
        self.stopped_s = 0.0  # when it came
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
        if self.cfg.export_onnx:
            self.exports = RunExports(self.folder, self.log.message)
        collector = self.make_collector()
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        if self._rng_state is not None:
            set_rng_state(self._rng_state)
        try:
            batches = iter(collector)
            status = self._status()
            while status is None:
                self.iterate(batches)
                status = self._status()
            self.save()
            if self.exports is not None:
                self.exports.finish(self.last_checkpoint)
        except EnvironmentFailure:
            self.save()
            raise
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            collector.shutdown(close_env=False)
        best = self.folder / checkpoint.FOLDER / checkpoint.BEST
        return Outcome(
            status,
            self.stop_signal,
            self.agent_steps,
            self.wall_s,
            self.window.summary()["return_mean"],
            best if best.exists() else None,
            self.last_checkpoint,
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
        self._report(learned)
        row = {"episodes": self.window.total, "episodes_new": episodes} | self.window.summary()
        row |= times | troubles | learned
        series: dict[str, float] = {}
        try:
            series = self._play_matches()
        finally:  # a series that fails costs no row
            self._log_row(row | series)
        won = bool(series) and self._score() >= self.best_score  # these weights, not those of later on
        if won or self.agent_steps - self.saved_at >= self.cfg.checkpoint_interval:
            self.save(won)

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

    def _learn(self, batch: TensorDictBase) -> dict[str, float]:
        progress = self.agent_steps / self.cfg.max_steps
        torch.set_num_threads(min(self.cfg.update_threads, os.cpu_count() or 1))
        metrics = {
            name: learner.learn(self.entries(batch, name), progress)
            for name, learner in self.learners.items()
        }
        torch.set_num_threads(self.cfg.num_threads)
        return by_policy(metrics)

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

    def _report(self, learned: dict[str, float]) -> None:
        """Say it when an update was taken back."""
        if self.log is not None and learned.get("rolled_back"):
            self.log.message(
                f"iteration {self.iteration}: the update was rolled back (approximate KL "
                f"{learned['kl_last']:.3g}, limit ppo.max_kl={self.cfg.ppo.max_kl}); "
                f"{learned['rollbacks']:.0f} so far"
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
        goal = self.cfg.stop_at_return
        if goal is not None and self.window.full and self.window.summary()["return_mean"] >= goal:
            return "solved"
        return None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.stop_signal is not None:
            if time.monotonic() - self.stopped_s > ECHO_S:
                raise KeyboardInterrupt
            return
        self.stop_signal, self.stopped_s = number, time.monotonic()
        if self.log is not None:
            self.log.message("stopping after this iteration, with a checkpoint; once more to stop at once")

    # --- checkpoints

    def save(self, best: bool = False) -> None:
        """Write a checkpoint of everything, unless one of this moment is there.

        `best`: call it the best one though its score is only as good as the best before.
        """
        if self.last_checkpoint is not None and self.saved_at == self.agent_steps:
            return
        score = self._score()
        best = best or score > self.best_score
        if best:
            self.best_score = score
        self.saved_at = self.agent_steps
        self.last_checkpoint = checkpoint.save_in(
            self.folder, self.agent_steps, self.state_dict(), self.cfg.keep_checkpoints, best
        )
        if best and self.exports is not None:
            self.exports.best_changed()

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
            self.env.set_state(checkpoint.to_arrays(state["env"]))
        self.window.load_state_dict(state["window"])
        self.matches.load_state_dict(state["matches"])
        for name in self._COUNTERS:
            setattr(self, name, state[name])
        self._rng_state = state["rng"]
        self.samples = state.get("samples", {})
        self.last_checkpoint = path
        self.resumed = True

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
