"""What a training run is made of: what collects, and the learners.

What an environment has (sensors, actions, teams) is read from it; what does not fit into memory is refused
before the first step.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.extras import install_command
from mappo_unity.config.overrides import is_installed
from mappo_unity.config.per_behavior import TRAIN, is_frozen
from mappo_unity.config.schema import CollectConfig, Config, Engine
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.learning.networks.opponents import Opponents
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.torch_settings import compute_as, cuda_number
from mappo_unity.runs.logger import check_loggers
from mappo_unity.runs.rng import seed_everything
from mappo_unity.training.collection.batches import Batch, count_decisions
from mappo_unity.training.collection.description import Played, describe
from mappo_unity.training.collection.fleet import Batches, Fleet, SoleWorker
from mappo_unity.training.collection.several_workers import LocalWorkers
from mappo_unity.training.collection.shared_memory import WorkerProcesses
from mappo_unity.training.learners import check_learners, make_learners
from mappo_unity.training.lessons.curriculum import lessons_of
from mappo_unity.training.side_by_side.parts import Task, learn
from mappo_unity.training.side_by_side.processes import LearnerProcesses


class TrainingSetup:
    """What collects, and a learner for every policy name.

    Args:
        cfg: the run's options.
        fleet: what collects; its environments are open.

    Attributes: `env`, what is played: the environment, or with workers what is known of theirs; `learners`
    by policy name; `policy`, their actors as one; `lessons` of environment parameters;
    `notes`, lines for the user; `frozen`, the policy names that only play; `opponents`, who plays some of the
    teams instead of the learners, with self-play; `guesses_channels`, whether `guess_channels` built the
    networks; `generators`, of random numbers, of the learners beside these, in the run that is resumed.

    Raises:
        ConfigError: options do not fit the environment, or what they ask for does not fit into memory.
    """

    def __init__(self, cfg: Config, fleet: Fleet) -> None:
        self.cfg, self.fleet, self.env = cfg, fleet, fleet.env
        self.notes = [f"note: {cfg.env.note}"] if cfg.env.note is not None else []
        self.lessons = lessons_of(cfg.env, self.env)
        fleet.lessons_in_force = self.lessons.in_force
        self.notes += self.lessons.notes

        self.opponents = Opponents() if cfg.self_play.is_on else None
        self.generators: list[Any] | None = None
        self._beside: LearnerProcesses | None = None
        self.guesses_channels = False
        self._make_learners(self.notes.append)
        if len(self.frozen) == len(self.learners):
            raise ConfigError(
                f"behaviors.{next(iter(self.frozen))}.{TRAIN}=false: nothing is learnt, since every behavior "
                "of the environment is frozen; mappo-eval plays without learning"
            )

    def guess_channels(self) -> None:
        """Build the networks again as older versions did: an image's smaller dimension holds its channels."""
        self.guesses_channels = True
        self._make_learners(lambda note: None)

    def _make_learners(self, note: Callable[[str], None]) -> None:
        rounds = batch_rounds(self.cfg.collect, self.env)
        self.learners = make_learners(self.cfg, self.env, rounds, note, self.guesses_channels)
        actors = {name: learner.actor for name, learner in self.learners.items()}
        self.policy = JointPolicy(actors, self.opponents)

        self.frozen = {name for name in self.learners if is_frozen(self.cfg, name)}
        for name in self.frozen:
            self.learners[name].round_norms = self.learners[name].actor.moving_norms = []
        check_learners(self.cfg, self.env, self._learning)

    @property
    def _learning(self) -> dict[str, PolicyLearner]:
        return {name: learner for name, learner in self.learners.items() if name not in self.frozen}

    @contextmanager
    def collecting(self) -> Iterator[Batches]:
        """Yield endless batches, collected from where the environments stand."""
        keeps_ends = any(learner.rewards.intrinsic for learner in self.learners.values())
        self.fleet.start(self.policy, keeps_ends)
        with self._beside_others():
            yield Batches(self.fleet, self.policy, self.cfg)

    @contextmanager
    def _beside_others(self) -> Iterator[None]:
        """Let the learners learn beside those of other processes, where `learners` asks for them."""
        if self.cfg.learners == 1:
            yield
            return
        rounds = batch_rounds(self.cfg.collect, self.env)
        others = self._learning, describe(self.env), rounds, self.guesses_channels, self.generators
        self._beside = LearnerProcesses(self.cfg, *others)
        try:
            yield
        finally:
            self._beside.close()
            self._beside = None

    def learn(self, batch: Batch, progress: float) -> dict[str, dict[str, float]]:
        """Improve every policy by a batch; return the metrics of each.

        Args:
            batch: as collected.
            progress: share of the run that was over when the batch began, 0 to 1, for the schedules.
        """
        share = count_decisions(batch.rounds, self.learners) / self.cfg.max_steps
        # Large minibatches gain from threads; small networks, while collecting, do not.
        compute_as(self.cfg, self.cfg.update_threads)
        tasks = {}
        for name, learner in self._learning.items():
            ahead = share if learner.cfg.schedules_count_batch else 0.0
            tasks[name] = Task(*batch.of(name), batch.void.get(name), progress + ahead)
        learned = self._beside.learn(tasks) if self._beside is not None else learn(self.learners, tasks)
        compute_as(self.cfg, self.cfg.num_threads)

        for name in self.learners if self.frozen else ():
            learned[name] = learned.get(name, {}) | {"frozen": float(name in self.frozen)}
        return learned

    def learners_state(self) -> dict[str, Any]:
        """Return the states of all learners, and the generators of those in other processes."""
        states = {name: learner.state_dict() for name, learner in self.learners.items()}
        generators = None
        if self._beside is not None:
            whole, generators = self._beside.states()
            states |= whole
        return {"learners": copy.deepcopy(states), "generators": generators}

    def forget_pending(self) -> None:
        """Drop the decisions whose outcome has not arrived: the environment was reset."""
        for learner in self.learners.values():
            learner.carried.rounds = None
        if self._beside is not None:
            self._beside.forget_pending()


@contextmanager
def set_up(cfg: Config, folder: Path) -> Iterator[TrainingSetup]:
    """Open the environments and build what learns; close the environments at the end of the block.

    Args:
        cfg: the run's options.
        folder: the run's folder; players log below it.

    Raises:
        ConfigError: see `TrainingSetup`; the device or a logger is not there.
    """
    prepare_torch(cfg)
    check_loggers(cfg.log)
    fleet = make_fleet(cfg, folder)
    try:
        yield TrainingSetup(cfg, fleet)
    finally:
        fleet.close()


def make_fleet(cfg: Config, folder: Path) -> Fleet:
    """Open the environments that the options ask for, in this process or in others."""
    if not cfg.collect.workers:
        return SoleWorker(cfg, folder)
    if cfg.collect.engine is Engine.local:
        return LocalWorkers(cfg, folder)
    if cfg.collect.engine is Engine.ray:
        return _ray_workers(cfg, folder)
    return WorkerProcesses(cfg, folder)


def _ray_workers(cfg: Config, folder: Path) -> Fleet:
    if not is_installed("ray"):
        raise ConfigError(
            f"collect.engine=ray needs the package ray, which is not installed: {install_command('ray')}"
        )
    from mappo_unity.training.collection.on_ray.fleet import RayWorkers

    return RayWorkers(cfg, folder)


def prepare_torch(cfg: Config) -> None:
    """Set threads, precision and seeds; check the device."""
    compute_as(cfg, cfg.num_threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it announces every storage
    check_device(cfg.device, cfg.learners)
    seed_everything(cfg.seed)


def check_device(device: str, learners: int = 1) -> None:
    """Raise ConfigError if torch does not find the device of the networks, or one for each learner."""
    if device == "cpu":
        return
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if not count:
        raise ConfigError(f"device={device}: this torch finds no CUDA device; use device=cpu")
    first = cuda_number(device)
    if first >= count:
        raise ConfigError(f"device={device}: the last CUDA device that torch finds is cuda:{count - 1}")
    if first + learners > count:
        raise ConfigError(
            f"learners={learners} with device={device} needs the CUDA devices up to cuda:"
            f"{first + learners - 1}, but the last one that torch finds is cuda:{count - 1}; lower learners"
        )


def batch_rounds(cfg: CollectConfig, env: Played) -> int:
    """Return the rounds of a batch in which all agents act that the environment began with."""
    if cfg.rounds is not None:
        return cfg.rounds
    # agents that are there, not slots: some of these may stay empty
    return -(-cfg.batch_size // max(1, describe(env).present))
