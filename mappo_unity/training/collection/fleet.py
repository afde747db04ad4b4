"""Fleets: what drives workers, and hands the learner one batch of all of them.

The learner and the training loop do not know which fleet they have. Here are the interface and today's path,
a sole worker that shares all with the learner; others are in `several_workers` and `processes`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.config.schema import Config
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.encoders import update_norms
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.runs.folder import PLAYERS
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.description import Played
from mappo_unity.training.collection.lineups import Lineup
from mappo_unity.training.collection.worker import MOVES, Weights, Worker, make_unity_env


class Fleet(ABC):
    """Workers, driven together.

    Attributes: `env`, what they play; `parts`, what each of them plays; `lessons_in_force`, returns the
    values of environment parameters that have changed since the environments were opened, for a worker that
    is replaced.
    """

    env: Played
    parts: Sequence[Played]
    lessons_in_force: Callable[[], Mapping[str, Value]] = staticmethod(dict)

    @abstractmethod
    def start(self, policy: JointPolicy, keeps_ends: bool) -> None:
        """Hand out the policy; see `Worker.take`."""

    @abstractmethod
    def request(self, weights: Weights | None, want_state: bool) -> None:
        """Ask every worker for a batch; `receive` returns it. See `Worker.collect`."""

    @abstractmethod
    def receive(self) -> Batch:
        """Wait for what was requested.

        Its tensors hold until the batch after the next is requested.
        """

    @abstractmethod
    def oppose(self, lineup: Lineup) -> None:
        """Let opponents play teams from the next request on."""

    @property
    def opposing(self) -> set[int]:
        """The numbers of the opponents of a batch that is on its way."""
        return set()

    @abstractmethod
    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter everywhere."""

    @abstractmethod
    def restart(self) -> None:
        """Reset all scenes: the next batch begins with new episodes."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs, as of the batch that was received last."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned, before `start`; raises ConfigError if it does not fit."""

    @abstractmethod
    def close(self) -> None:
        """Close all environments."""


class SoleWorker(Fleet):
    """A single worker that shares this process's policy and generators of random numbers."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        self.env = make_unity_env(cfg, folder / PLAYERS)
        self.parts = [self.env]
        self._worker = Worker(cfg, self.env, cfg.device)
        self._lineup: Lineup | None = None  # of the next request

    def start(self, policy: JointPolicy, keeps_ends: bool) -> None:
        """Hand out the policy."""
        self._worker.take(policy, keeps_ends)

    def request(self, weights: Weights | None, want_state: bool) -> None:
        """Ask for a batch, which `receive` collects."""
        if self._lineup is not None:
            self._worker.oppose(self._lineup)
            self._lineup = None

    def receive(self) -> Batch:
        """Collect a batch with the policy as it is."""
        return self._worker.collect(None, want_state=False).batch

    def oppose(self, lineup: Lineup) -> None:
        """Let opponents play."""
        self._lineup = lineup

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter."""
        self._worker.set_parameter(name, value)

    def restart(self) -> None:
        """Reset the scene."""
        self._worker.restart()

    def state_dict(self) -> dict[str, Any]:
        """Return the environment's snapshot, or None where it gives none, and the agents' memories."""
        state = self._worker.state()
        return {"env": state["env"], "memories": state["memories"]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore them; older checkpoints hold no memories."""
        self._worker.load({"env": state["env"], "memories": state.get("memories", {})})

    def close(self) -> None:
        """Close the environment."""
        self._worker.close()


class Batches:
    """Endless batches of a fleet, each collected with the newest weights.

    With `overlap` the next batch is requested before this one is learnt from: with the weights as they are.

    Args:
        fleet: that collects.
        policy: what is trained.
        cfg: the run's options.
    """

    def __init__(self, fleet: Fleet, policy: JointPolicy, cfg: Config) -> None:
        self._fleet, self._policy = fleet, policy
        self._overlap, self._shares = cfg.collect.overlap, cfg.collect.workers == 0
        self._is_requested = False

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """Return the next batch."""
        if not self._is_requested:
            self._request()
        batch = self._fleet.receive()
        self._is_requested = False
        if not self._shares:
            move_norms(self._policy, batch)
        if self._overlap:
            self._request()
        return batch

    def restart(self) -> None:
        """Reset all scenes: the next batch begins with new episodes."""
        self._fleet.restart()

    def _request(self) -> None:
        self._fleet.request(None if self._shares else weights_of(self._policy), want_state=True)
        self._is_requested = True


def move_norms(policy: JointPolicy, batch: Batch) -> None:
    """Take a batch of workers into the statistics that move with each round (`ppo.obs_norm_update=round`).

    Each worker has moved its own copies by its own rounds alone. All begin the next batch with these, which
    have seen what they would have seen in one process.
    """
    for name, actor in zip(policy.names, policy.actors.values()):
        if isinstance(actor, UnityActor):
            update_norms(actor.moving_norms, batch.rounds.get(name))


def weights_of(policy: JointPolicy) -> dict[str, dict[str, Any]]:
    """Return copies of all actors' tensors, on the CPU, and whether statistics move with each round."""
    weights: dict[str, dict[str, Any]] = {}
    for name, actor in zip(policy.names, policy.actors.values()):
        own = {key: value.detach().to("cpu", copy=True) for key, value in actor.state_dict().items()}
        if isinstance(actor, UnityActor):  # not while its critic warms up
            own[MOVES] = torch.tensor(bool(actor.moving_norms))
        weights[name] = own
    return weights
