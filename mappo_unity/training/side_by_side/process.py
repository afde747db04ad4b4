"""A learner beside the run's, in a process of its own: what runs there.

A message is a pickled tuple: a method of `LearnersHere` and its arguments, or `CLOSE`; the answer is
(`OK`, what the method returned) or (`ERROR`, `Report`), as of workers.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from dataclasses import replace
from datetime import timedelta
from multiprocessing.connection import Connection
from typing import Any

import torch
import torch.distributed as dist

from mappo_unity.config.schema import Config
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.learning.reduction import SeveralLearners
from mappo_unity.learning.torch_settings import compute_as, cuda_number
from mappo_unity.runs.rng import get_rng_state, seed_everything, set_rng_state
from mappo_unity.training.child_process import begin_child
from mappo_unity.training.collection.description import Description
from mappo_unity.training.collection.worker_process import CLOSE, ERROR, OK, report
from mappo_unity.training.learners import make_learners
from mappo_unity.training.side_by_side.parts import CARRIED, STATES, Task, learn

WAIT = timedelta(minutes=10)
"""Within which all learners come to where they add up."""
SEED_DISTANCE = 1_000_003
"""Between the seeds of two learners, which draw minibatches."""


def main(cfg: Config, rank: int, meeting: str, pipe: Connection) -> None:
    """Run a learner until the driver closes it, or is gone.

    Args:
        cfg: the run's options.
        rank: of the learner; 0 is the driver's.
        meeting: path of a file through which the learners find one another.
        pipe: to the driver.
    """
    begin_child()
    compute_as(cfg, cfg.update_threads)
    seed_everything((cfg.seed + rank * SEED_DISTANCE) % 2**31)
    here = LearnersHere(cfg, rank, meeting)
    try:
        while True:
            method, *arguments = pickle.loads(pipe.recv_bytes())
            if method == CLOSE:
                break
            try:
                answer = OK, getattr(here, method)(*arguments)
            except BaseException as error:
                # nothing is in step any more: the driver ends the run
                pipe.send_bytes(pickle.dumps((ERROR, report(error))))
                break
            pipe.send_bytes(pickle.dumps(answer))
    except (EOFError, OSError):
        os._exit(1)  # the driver has gone
    leave()


class LearnersHere:
    """The learners of all policy names, from some of the teams each."""

    def __init__(self, cfg: Config, rank: int, meeting: str) -> None:
        self._cfg, self._rank, self._meeting = cfg, rank, meeting
        self._device = device_of(cfg, rank)
        self._learners: dict[str, PolicyLearner] = {}

    def build(
        self,
        description: Description,
        rounds: int,
        guesses_channels: bool,
        states: Mapping[str, Any],
        generators: Any,
    ) -> None:
        """Build the learners, and join the others.

        Args:
            description: of what is played.
            rounds: of a batch.
            guesses_channels: see `TrainingSetup.guess_channels`.
            states: of the learners that learn, with what they keep of the teams of this one.
            generators: states of generators of random numbers in the run that is resumed; None: fresh ones.
        """
        meet(self._cfg, self._rank, self._meeting)
        cfg = replace(self._cfg, device=self._device)
        everybody = make_learners(cfg, description, rounds, lambda note: None, guesses_channels)
        self._learners = {name: everybody[name] for name in states}
        join(self._learners, states, self._device)
        if generators is not None:
            set_rng_state(generators)

    def learn(self, tasks: Mapping[str, Task]) -> None:
        """Learn some teams' part of a batch."""
        learn(self._learners, {name: task.to(self._device) for name, task in tasks.items()})

    def state(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return what the learners keep of their teams, by policy name, and the generators."""
        kept = {}
        for name, learner in self._learners.items():
            state = learner.state_dict()
            kept[name] = {key: _on_cpu(state[key]) for key in (CARRIED, STATES)}
        return kept, get_rng_state()

    def forget_pending(self) -> None:
        """Drop the decisions whose outcome has not arrived."""
        for learner in self._learners.values():
            learner.carried.rounds = None


def meet(cfg: Config, rank: int, meeting: str) -> None:
    """Join the process group of the learners."""
    dist.init_process_group(
        "nccl" if cfg.device.startswith("cuda") else "gloo",
        init_method=f"file://{meeting}",
        rank=rank,
        world_size=cfg.learners,
        timeout=WAIT,
    )


def leave() -> None:
    """Leave the process group, where there is one."""
    if dist.is_initialized():
        dist.destroy_process_group()


def join(learners: Mapping[str, PolicyLearner], states: Mapping[str, Any], device: str) -> None:
    """Load what learners keep of their teams, and let them learn beside the others."""
    reduction = SeveralLearners(device=device)
    for name, learner in learners.items():
        learner.load_state_dict(states[name])
        learner.join(reduction)


def device_of(cfg: Config, rank: int) -> str:
    """Return the device of a learner: with device=cuda each has one of its own."""
    if not cfg.device.startswith("cuda"):
        return cfg.device
    return f"cuda:{cuda_number(cfg.device) + rank}"


def _on_cpu(entries: dict[str, torch.Tensor] | None) -> dict[str, torch.Tensor] | None:
    return None if entries is None else {key: entry.cpu() for key, entry in entries.items()}
