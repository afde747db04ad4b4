"""The state of a training run: everything that a checkpoint holds."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.parameters.values import params_at
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.schema import Config, TagKind
from mappo_unity.errors import ConfigError
from mappo_unity.policies.export import sample_inputs
from mappo_unity.policies.layouts import guessed_otherwise, without_channels
from mappo_unity.policies.league.growing import step_name
from mappo_unity.policies.policy import CheckpointPolicy, Policy
from mappo_unity.runs import checkpoint
from mappo_unity.runs.behavior_events import policy_step
from mappo_unity.runs.rng import get_rng_state, set_rng_state
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.fleet import Batches
from mappo_unity.training.episode_stats import RecentEpisodes
from mappo_unity.training.match_series import MatchSeries
from mappo_unity.training.resume_check import (
    check_compatible,
    check_learners,
    check_workers,
    describe_models,
    describe_policies,
    has_snapshot,
    known_generators,
)
from mappo_unity.training.self_play.self_play import SelfPlay
from mappo_unity.training.setup import TrainingSetup

_COUNTERS = (
    *("iteration", "agent_steps", "wall_s", "saved_at", "best_score"),
    *("restarts_before", "dropped_episodes", "dropped_steps"),
)


class RunState:
    """Counters, recent episodes, matches and the learners of a run.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        setup: what is trained.

    Attributes: `iteration`, how many are complete; `agent_steps`, agent decisions; `policy_steps`, those of
    each policy; `wall_s`, seconds spent collecting and learning; `saved_at`, agent decisions at the last
    regular checkpoint; `best_score`, the highest of a checkpoint, of which matches ask nothing;
    `dropped_episodes` and `dropped_steps`, what crashed players cost; `samples`, inputs of each policy that
    an export is compared on; `self_play`, the opponents, where there are some; `notes`, lines for the user
    about what a checkpoint could not give back.
    """

    def __init__(self, cfg: Config, folder: Path, setup: TrainingSetup) -> None:
        self.cfg, self.setup, self._folder = cfg, setup, folder
        self.iteration = self.agent_steps = self.saved_at = 0
        self.wall_s = 0.0
        self.policy_steps = dict.fromkeys(setup.learners, 0)
        self.best_score = -math.inf
        self.restarts_before = self.dropped_episodes = self.dropped_steps = 0
        self.recent_episodes = RecentEpisodes(cfg.log.return_window, list(setup.env.behaviors))
        self.matches = MatchSeries(cfg, folder, setup.env.behaviors)
        self.lessons = setup.lessons
        self.self_play = SelfPlay(cfg, folder, setup) if setup.opponents is not None else None
        self.notes: list[str] = []  # about what a checkpoint could not give back
        self.samples: dict[str, dict[str, torch.Tensor]] = {}
        self._restarts_here = 0
        self._rng_state: dict[str, Any] | None = None  # of the checkpoint that is resumed

    @property
    def restarts(self) -> int:
        """How often players were started again in this run."""
        return self.restarts_before + self._restarts_here

    @property
    def updates(self) -> dict[str, tuple[int, int]]:
        """For each policy name: how many updates were rolled back, and how many there were."""
        return {name: (learner.rollbacks, learner.updates) for name, learner in self.setup.learners.items()}

    def count_crashed(self, batch: Batch) -> dict[str, float]:
        """Count what crashed players have cost; return it, where there are players."""
        if batch.restarts is None:
            return {}

        self._restarts_here = batch.restarts
        self.dropped_steps += batch.dropped_steps
        self.dropped_episodes += batch.dropped_episodes

        return {
            "restarts": float(self.restarts),
            "dropped_episodes": float(self.dropped_episodes),
            "dropped_steps": float(self.dropped_steps),
        }

    def count(self, batch: Batch, collect_s: float, update_s: float) -> dict[str, float]:
        """Count an iteration; return its metrics but those of learning.

        Args:
            batch: what was collected.
            collect_s, update_s: seconds that collecting and learning took.
        """
        learners, seconds = self.setup.learners, collect_s + update_s
        decisions = {name: batch.count_decisions(name) for name in learners}
        steps = sum(decisions.values())
        # a side that pauses in self-play keeps those it had
        self.samples = self.samples | {
            name: sample_inputs(batch.rounds.get(name), learners[name].actor.in_keys)
            for name, count in decisions.items()
            if count or name not in self.samples
        }

        self.iteration += 1
        self.agent_steps += steps
        self.policy_steps = {name: self.policy_steps[name] + count for name, count in decisions.items()}
        self.wall_s += seconds
        episodes_new = self.recent_episodes.add(batch.episodes)

        counters = {"iteration": self.iteration, "agent_steps": self.agent_steps, "wall_s": self.wall_s}
        episodes = {"episodes": self.recent_episodes.total, "episodes_new": episodes_new}
        times = {"steps_per_s": steps / seconds, "collect_s": collect_s, "update_s": update_s}
        if self.cfg.log.tags is TagKind.mlagents:
            counters |= {policy_step(name): count for name, count in self.policy_steps.items()}
        return counters | episodes | self.recent_episodes.summary() | times | self.lessons.metrics()

    def advance_lessons(self, batch: Batch, batches: Batches) -> list[str]:
        """Go on to the next lessons where those in force are complete; return a line about each.

        What was said about recent episodes and the best policy does not hold for other lessons.
        """
        changes = self.lessons.advance(batch.episodes, self.agent_steps / self.cfg.max_steps)
        if not changes:
            return []

        for change in changes:
            self.setup.fleet.set_parameter(change.name, change.lesson.value)
        if any(change.require_reset for change in changes):
            self._reset_scenes(batches)
        self.recent_episodes.begin_anew()
        self.best_score = -math.inf
        self.matches.forget()
        return [f"{self.agent_steps:,} steps: {change}" for change in changes]

    def begin(self) -> None:
        """Do what a run begins with when nothing can be refused any more."""
        if self.self_play is not None:
            self.self_play.begin(self.agent_steps, self._about())

    def advance_self_play(self, batch: Batch, batches: Batches) -> dict[str, float]:
        """Count what opponents did in a batch, and choose those of the next ones; return metrics."""
        if self.self_play is None:
            return {}
        metrics, is_reset = self.self_play.advance(batch, self.agent_steps, self._about())
        if is_reset:
            self._reset_scenes(batches)
        return metrics

    def _reset_scenes(self, batches: Batches) -> None:
        """Let the next batch begin with new episodes; what is pending has no outcome any more."""
        batches.restart()
        self.setup.forget_pending()

    def play_matches(self) -> dict[str, float]:
        """Play a series of matches where one is due, and return its figures."""
        if not self.matches.is_due(self.agent_steps):
            return {}
        actors = {name: learner.actor for name, learner in self.setup.learners.items()}
        env = replace(self.cfg.env, params=params_at(self.cfg.env.params, self.lessons.numbers))
        return self.matches.play(env, self.agent_steps, self._layout(), actors, self._rivals())

    def _rivals(self) -> dict[str, Policy]:
        """Return whom a policy may meet in a series beside random: opponents of self-play, the run's best."""
        # building a network draws weights, of which training is to feel nothing
        with torch.random.fork_rng(devices=[]):
            rivals = self.self_play.rivals(self._layout()) if self.self_play is not None else {}
            best = self._folder / checkpoint.FOLDER / checkpoint.BEST
            if best.exists():
                policy = CheckpointPolicy(best, deterministic=False)
                rivals.setdefault(step_name(policy.agent_steps), policy)
        return rivals

    def score(self) -> float:
        """Return what a best checkpoint is chosen by: return_mean; where all is cloned, which is newest."""
        return float(self.agent_steps) if self.cfg.bc.only else self.recent_episodes.score()

    def is_best(self) -> bool:
        """Return whether the policy is the best so far: by `score`; where there are two sides, by matches.

        The highest of many windows is the luckiest, so the newest counts that is not more than one standard
        error below (Breiman et al. 1984: the 1 SE rule). Of two sides the mean return says nothing.
        """
        if self.matches.two_sided and not self.cfg.bc.only:
            return self.matches.is_best(self.agent_steps)
        team_sizes = {name: behavior.slots.team_size for name, behavior in self.setup.env.behaviors.items()}
        # while too few episodes have ended both are minus infinity: the newest policy has learnt most
        return self.score() >= self.best_score - self.recent_episodes.standard_error(team_sizes)

    # --- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Return everything that resuming needs, between two iterations; what is trained is copied."""
        self_play = self.self_play.state_dict() if self.self_play is not None else None
        return self._about() | {
            **self.setup.learners_state(),
            "self_play": self_play,
            **self.setup.fleet.state_dict(),
            "window": self.recent_episodes.state_dict(),
            "matches": self.matches.state_dict(),
            "rng": get_rng_state(),
            "samples": self.samples,
            "policy_steps": self.policy_steps,
            **{name: getattr(self, name) for name in _COUNTERS},
            # After the counters, whose entry it replaces: a resumed run starts its own count at 0.
            "restarts_before": self.restarts,
        }

    def load(self, path: Path) -> None:
        """Resume from a checkpoint; `restore_rng` follows when everything is built.

        Raises:
            CheckpointError: it belongs to another environment or other networks.
        """
        state = checkpoint.load(path)
        check_compatible(path, state, self.cfg.env.name, self._layout(), self._models())
        check_learners(path, state["learners"], self.setup.learners)
        if guessed_otherwise(state["layout"], self._layout()):
            self.setup.guess_channels()

        for name, learner in self.setup.learners.items():
            learner.load_state_dict(state["learners"][name])
        if is_new := not has_snapshot(state):  # new episodes begin: what is pending has no outcome
            self.setup.forget_pending()
        check_workers(path, state, self.cfg.collect.workers)
        self.setup.generators = known_generators(state, self.cfg.learners)
        self._restore_fleet(path, state)
        self._restore_lessons(state.get("lessons", {}), is_new)

        self.recent_episodes.load_state_dict(state["window"])
        self.matches.load_state_dict(state["matches"], state["best_score"])
        # a run may take up self-play, or leave it, when it is resumed
        if self.self_play is not None and (known := state.get("self_play")) is not None:
            self.self_play.load_state_dict(known, state["agent_steps"], self.notes.append)
        for name in _COUNTERS:
            setattr(self, name, state[name])

        # checkpoints of older versions hold neither; of one policy all steps are its own
        self.samples = state.get("samples", {})
        share = self.agent_steps // len(self.policy_steps)
        self.policy_steps = state.get("policy_steps", dict.fromkeys(self.policy_steps, share))
        self._rng_state = state["rng"]

    def restore_rng(self) -> None:
        """Set the random generators as the resumed checkpoint has them: last, since building draws too."""
        if self._rng_state is not None:
            set_rng_state(self._rng_state)

    def _restore_fleet(self, path: Path, state: dict[str, Any]) -> None:
        try:
            self.setup.fleet.load_state_dict(state)
        except ConfigError as error:
            raise checkpoint.CheckpointError(
                f"checkpoint {path} does not fit the environment's options, which cannot change with resume: "
                f"{error}"
            ) from error

    def _restore_lessons(self, state: dict[str, Any], is_new: bool) -> None:
        """Set the parameters whose values the environment has not: it `is_new`, or options were changed."""
        first = self.lessons.values
        changed = self.lessons.load_state_dict(state)
        if is_new:
            changed = {name: value for name, value in self.lessons.values.items() if value != first[name]}

        for name, value in changed.items():
            self.setup.fleet.set_parameter(name, value)
        if is_new and changed:  # its first episodes began with the first lessons
            self.setup.fleet.restart()

    def _about(self) -> dict[str, Any]:
        """Return what a file needs beside networks to be played."""
        return {
            "env_name": self.cfg.env.name,
            "model": self._models(),
            "layout": self._layout(),
            "lessons": self.lessons.state_dict(),
        }

    def _layout(self) -> dict[str, Any]:
        # networks that guess their channels stay those of a checkpoint that does not tell
        layout = describe_policies(self.setup.env)
        return without_channels(layout) if self.setup.guesses_channels else layout

    def _models(self) -> dict[str, Any]:
        return describe_models({name: behavior_config(self.cfg, name).model for name in self.setup.learners})
