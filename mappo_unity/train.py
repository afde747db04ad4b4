"""Build a trainer from options and run it: the file to read first.

In: `Config`, a run folder. Out: checkpoints, metrics, an `Outcome`. `Trainer.iterate` is the loop:
collect, learn, count, log, save.
"""

from __future__ import annotations

import logging
import math
import random
import signal
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from mappo_unity import checkpoint
from mappo_unity.actions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.backend import make_env_function
from mappo_unity.behavior_options import check_behaviors, options_of
from mappo_unity.collect import make_collector
from mappo_unity.config import Config, ConfigError
from mappo_unity.encoders import ObsLayout
from mappo_unity.log import RunLog, check_backends
from mappo_unity.metrics import EpisodeWindow, by_policy, count_decisions
from mappo_unity.models import JointPolicy, make_actor, make_critic
from mappo_unity.policies import describe_spec
from mappo_unity.ppo import PolicyLearner
from mappo_unity.transforms import transformed
from mappo_unity.unity_env import UnityEnv


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


def prepare_torch(cfg: Config) -> None:
    """Set threads and seeds; check the device."""
    torch.set_num_threads(cfg.num_threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every storage
    if cfg.device.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"device={cfg.device}: this torch finds no CUDA device; use device=cpu")
    random.seed(cfg.seed)
    np.random.seed(cfg.seed % 2**32)
    torch.manual_seed(cfg.seed)


def make_unity_env(cfg: Config) -> UnityEnv:
    """Open the environment of the options behind the adapter."""
    return UnityEnv(
        make_env_function(cfg.env),
        cfg.seed,
        action_limit=CONTINUOUS_LIMIT,
        max_team_size=cfg.env.max_team_size,
        max_teams=cfg.env.max_teams,
        death_masking=cfg.ppo.death_masking,
    )


def make_learners(cfg: Config, env: UnityEnv) -> dict[str, PolicyLearner]:
    """Build networks and learner of every policy name."""
    check_behaviors(cfg, env.sides)
    learners = {}
    for name, sides in env.sides.items():
        model, ppo = options_of(cfg, name)
        behavior = env.behaviors[sides[0]]
        teams, team_size = behavior.slots.num_teams * len(sides), behavior.slots.team_size
        rows, agents = cfg.collect.rounds * teams, teams * team_size
        if ppo.minibatch_size > rows * team_size:
            raise ConfigError(
                f"ppo.minibatch_size={ppo.minibatch_size} is larger than the batch of {name!r}: "
                f"collect.rounds={cfg.collect.rounds} x {agents} agents = {rows * team_size} decisions; "
                "lower ppo.minibatch_size or raise collect.rounds or env.num_areas"
            )
        obs = ObsLayout.from_specs(behavior.spec.observation_specs)
        layout = ActionLayout.from_spec(behavior.spec.action_spec, model.flatten_branches)
        actor = make_actor(obs, layout, team_size, model).to(cfg.device)
        critic = make_critic(obs, team_size, model).to(cfg.device)
        learners[name] = PolicyLearner(actor, critic, ppo, rows, team_size)
    return learners


class Trainer:
    """Environment, learners, counters and their checkpoint."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        prepare_torch(cfg)
        check_backends(cfg.log)
        self.cfg, self.folder = cfg, folder
        self.env = make_unity_env(cfg)
        self.learners = make_learners(cfg, self.env)
        self.policy = JointPolicy({name: learner.actor for name, learner in self.learners.items()})
        self.window = EpisodeWindow(cfg.log.return_window, list(self.env.behaviors))
        self.iteration = self.agent_steps = 0
        self.wall_s = 0.0
        self.saved_at = 0
        self.best_return = -math.inf
        self.last_checkpoint: Path | None = None
        self.stop_signal: int | None = None
        self.resumed = False
        self.log: RunLog | None = None

    # --- the loop

    def run(self) -> Outcome:
        """Iterate until the steps are done, the return is reached or a signal comes."""
        resume_steps = self.agent_steps if self.resumed else None
        self.log = RunLog(self.cfg.log, self.folder, self.cfg.max_steps, resume_steps)
        collector = self.make_collector()
        handlers = {s: signal.signal(s, self._on_signal) for s in (signal.SIGINT, signal.SIGTERM)}
        rng_state = getattr(self, "_rng_state", None)
        if rng_state is not None:
            set_rng_state(rng_state)
        try:
            batches = iter(collector)
            status = self._status()
            while status is None:
                self.iterate(batches)
                status = self._status()
            self.save()
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
        return make_collector(transformed(self.env), self.policy, self.cfg.collect)

    def iterate(self, batches: Any) -> None:
        """Collect a batch, learn from it, log, and save when it is time."""
        start = time.perf_counter()
        batch = next(batches)
        collected = time.perf_counter()
        learned = self._learn(batch)
        steps = count_decisions(batch, list(self.learners))
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
        self._log_row(
            {"episodes": self.window.total, "episodes_new": episodes}
            | self.window.summary()
            | times
            | learned
        )
        if self.agent_steps - self.saved_at >= self.cfg.checkpoint_interval:
            self.save()

    def _learn(self, batch: TensorDictBase) -> dict[str, float]:
        progress = self.agent_steps / self.cfg.max_steps
        return by_policy(
            {
                name: learner.learn(self.entries(batch, name), progress)
                for name, learner in self.learners.items()
            }
        )

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
            raise KeyboardInterrupt
        self.stop_signal = number
        if self.log is not None:
            self.log.message("stopping after this iteration, with a checkpoint; once more to stop at once")

    # --- checkpoints

    def save(self) -> None:
        """Write a checkpoint of everything, unless one of this moment is there."""
        if self.last_checkpoint is not None and self.saved_at == self.agent_steps:
            return
        return_mean = self.window.summary()["return_mean"]
        best = return_mean > self.best_return
        if best:
            self.best_return = return_mean
        self.saved_at = self.agent_steps
        self.last_checkpoint = checkpoint.save_in(
            self.folder, self.agent_steps, self.state_dict(), self.cfg.keep_checkpoints, best
        )

    def state_dict(self) -> dict[str, Any]:
        """Return everything that continuing needs, between two iterations."""
        return {
            "env_name": self.cfg.env.name,
            "model": self._models(),
            "layout": self._layout(),
            "learners": {name: learner.state_dict() for name, learner in self.learners.items()},
            "env": self.env.get_state(),
            "window": self.window.state_dict(),
            "rng": get_rng_state(),
            **{name: getattr(self, name) for name in self._COUNTERS},
        }

    _COUNTERS = ("iteration", "agent_steps", "wall_s", "saved_at", "best_return")

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
        for name in self._COUNTERS:
            setattr(self, name, state[name])
        self._rng_state = state["rng"]
        self.last_checkpoint = path
        self.resumed = True

    def _layout(self) -> dict[str, Any]:
        return describe_policies(self.env)

    def _models(self) -> dict[str, Any]:
        return {name: plain(asdict(options_of(self.cfg, name)[0])) for name in self.learners}

    def close(self) -> None:
        """Close the environment and the logs."""
        if self.log is not None:
            self.log.close()
        if not self.env.is_closed:
            self.env.close()


def describe_policies(env: UnityEnv) -> dict[str, Any]:
    """Return what a network must fit: sensors, actions and team size of every policy name."""
    out = {}
    for name, sides in env.sides.items():
        behavior = env.behaviors[sides[0]]
        out[name] = describe_spec(behavior.spec, behavior.slots.team_size)
    return out


def check_fits(
    path: Path, state: dict[str, Any], env_name: str, layout: dict[str, Any], models: dict[str, Any]
) -> None:
    """Refuse a checkpoint of another environment or network, saying what differs."""
    if state["env_name"] != env_name:
        raise checkpoint.CheckpointError(
            f"checkpoint {path} was written for env={state['env_name']}, not for env={env_name}"
        )
    if state["layout"] != layout:
        raise checkpoint.CheckpointError(
            f"checkpoint {path} was written for policies {state['layout']}, but the environment has {layout}"
        )
    different = []
    for name, model in models.items():
        saved = state["model"][name]
        different += [
            f"model.{k}={saved.get(k)} there, {v} here" for k, v in model.items() if saved.get(k) != v
        ]
    if different:
        raise checkpoint.CheckpointError(f"checkpoint {path} holds another network: {'; '.join(different)}")


def get_rng_state() -> dict[str, Any]:
    """Return the states of torch's, numpy's and Python's global generators."""
    kind, keys_, position, has_gauss, cached = np.random.get_state()
    version, internal, gauss_next = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [
            str(kind),
            np.asarray(keys_).astype(np.int64),
            int(position),
            int(has_gauss),
            float(cached),
        ],
        "python": [int(version), list(internal), gauss_next],
    }


def set_rng_state(state: dict[str, Any]) -> None:
    """Go back to what `get_rng_state` returned."""
    torch.set_rng_state(state["torch"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])
    kind, keys_, position, has_gauss, cached = state["numpy"]
    np.random.set_state((kind, np.asarray(keys_).astype(np.uint32), position, has_gauss, cached))
    version, internal, gauss_next = state["python"]
    random.setstate((version, tuple(internal), gauss_next))


def plain(value: Any) -> Any:
    """Turn enums into their values, all through a nested dict or list."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return getattr(value, "value", value)
