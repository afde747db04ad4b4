"""Workers in processes of their own, on this machine or on others; one that is lost is replaced.

A worker is lost that is killed, raises what is ours, or hangs. The replacement has a fresh environment and
the weights of the batch that is missing, and collects it again; what was pending of the lost one's agents
teaches nothing.
"""

from __future__ import annotations

import atexit
import logging
import pickle
import time
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.keys import ACTING
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.description import Description
from mappo_unity.training.collection.several_workers import Answers, SeveralWorkers, packed
from mappo_unity.training.collection.worker import Weights
from mappo_unity.training.collection.worker_handle import WorkerHandle, WorkerLost
from mappo_unity.training.collection.worker_process import COLLECT

CLOSE_S = 10.0
"""Given to all workers together to close their environments."""

logger = logging.getLogger(__name__)


class RemoteWorkers(SeveralWorkers):
    """Workers in processes of their own; what is abstract says how these are started and give their rounds.

    Args:
        cfg: the run's options.
        folder: of the run.

    Attributes: `processes`, the workers that run.

    Raises:
        ConfigError, EnvironmentFailure: an environment could not be opened.
    """

    def __init__(self, cfg: Config, folder: Path) -> None:
        count = cfg.collect.workers
        self._cfg, self._folder = cfg, folder
        self.processes: list[WorkerHandle] = []
        self._restarts = [0] * count  # how often each worker was replaced
        self._players = [0] * count  # restarts of players of each worker
        self._players_before = [0] * count  # likewise, of those that it replaced
        self._lost: set[int] = set()  # those replaced since the last batch
        self._policy: tuple[Any, bool] | None = None
        self._asked: tuple[Any, ...] | None = None  # the request under way
        self._set = 0  # 0 and 1 take turns: the way of the rounds of the batch under way

        atexit.register(self.close)  # before multiprocessing waits for its processes
        try:
            # all start before the first is waited for
            for number in range(count):
                self.processes.append(self._open(number, 0))
            super().__init__(cfg, [self._first(number) for number in range(count)])
        except BaseException:
            self.close()
            raise

    def start(self, policy: JointPolicy, keeps_ends: bool) -> None:
        """Hand out copies of the policy."""
        taken = self._published(packed(policy)), keeps_ends
        self._call("take", *taken)
        self._policy = taken

    def close(self) -> None:
        """Close all environments and end all processes."""
        atexit.unregister(self.close)
        for process in self.processes:
            process.stop()
        until = time.monotonic() + CLOSE_S
        for process in self.processes:
            process.end(until - time.monotonic())
        self.processes = []

    @abstractmethod
    def _open(self, number: int, restarts: int) -> WorkerHandle:
        """Start a worker's process."""

    def _published(self, data: bytes) -> Any:
        """Return what stands for bytes in messages to all workers."""
        return data

    @abstractmethod
    def _rounds(self, number: int, length: int, where: Any) -> TensorDictBase:
        """Return a worker's rounds, from what it has said of them."""

    def _side_by_side(self, lengths: list[int]) -> TensorDictBase | None:
        """Return the rounds of all workers where they lie as those of one environment; None: they do not."""
        return None

    # --- what `SeveralWorkers` asks for

    def _ask(self, weights: Weights | None, want_state: bool) -> None:
        self._set = 1 - self._set
        self._asked = (COLLECT, self._published(pickle.dumps(weights)), want_state, self._set)
        for process in self.processes:
            process.send(*self._asked)

    def _answers(self) -> Answers:
        batches, states, lengths = [], [], []
        for number in range(len(self.processes)):
            (batch, length, where), state = self._until_answered(number)
            batch.rounds = self._rounds(number, length, where)
            self._count_losses(batch, number)
            batches.append(batch)
            states.append(state)
            lengths.append(length)
        self._asked = None
        self._lost.clear()
        return Answers(batches, states, self._side_by_side(lengths))

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        assert self._asked is None, "a worker that collects answers nothing else"
        for process in self.processes:
            process.send(method, *arguments)
        return [self._until_answered(number, method, *arguments) for number in range(len(self.processes))]

    def _load(self, states: list[Mapping[str, Any]]) -> None:
        for process, state in zip(self.processes, states):
            process.send("load", state)
        for number, process in enumerate(self.processes):
            try:
                process.receive()
            except WorkerLost as loss:
                raise EnvironmentFailure(f"worker {number} cannot be resumed: {loss}") from loss

    # --- answers and losses

    def _first(self, number: int) -> Description:
        try:
            description: Description = self.processes[number].receive()[1]
        except WorkerLost as loss:
            raise EnvironmentFailure(f"worker {number} cannot be started: {loss}") from loss
        return description

    def _until_answered(self, number: int, *message: Any) -> Any:
        """Return a worker's answer; of another in its place where it is lost, which is told the message."""
        while True:
            try:
                return self._answer(number)
            except WorkerLost as loss:
                self._replace(number, loss)
                self.processes[number].send(*(self._asked or message))

    def _answer(self, number: int) -> Any:
        return self.processes[number].receive()[1]

    def _replace(self, number: int, loss: WorkerLost) -> None:
        """Put a fresh worker in the place of one that was lost.

        Raises:
            EnvironmentFailure: the restarts are used up.
            ConfigError: its environment is another one.
        """
        limit = self._cfg.env.max_restarts
        self._lost.add(number)
        self._players_before[number] += self._players[number]
        self._players[number] = 0
        while True:
            self.processes[number].end()
            if self._restarts[number] >= limit:
                raise EnvironmentFailure(
                    f"worker {number} failed: {loss}. It was replaced {self._restarts[number]} times, and "
                    f"env.max_restarts={limit} allows no more"
                )
            self._restarts[number] += 1
            logger.warning(
                "worker %d failed: %s; restart %d of at most %d", number, loss, self._restarts[number], limit
            )
            try:
                self.processes[number] = self._fresh(number)
                return
            except WorkerLost as again:
                loss = again

    def _fresh(self, number: int) -> WorkerHandle:
        """Return a new worker with the policy and the parameters in force."""
        process = self._open(number, self._restarts[number])
        try:
            _, description = process.receive()
            if description.behaviors != self.parts[number].behaviors:
                raise ConfigError(
                    f"worker {number} was replaced, but its new environment shows other behaviors, sensors, "
                    "actions or team slots; env.max_teams and env.max_team_size give room for more agents"
                )

            values = self.lessons_in_force()
            messages: list[tuple[Any, ...]] = [("set_parameter", *item) for item in values.items()]
            messages += [("restart",)] if values else []  # its first episodes began without them
            messages += [("take", *self._policy)] if self._policy is not None else []
            messages += [("oppose", self._lineups.sent)] if self._lineups.sent is not None else []

            for message in messages:
                process.send(*message)
                process.receive()
        except BaseException:
            process.end()
            raise

        # it knows the past policies of the newest lineup, and none that was told before
        self._lineups.forget()
        return process

    def _count_losses(self, batch: Batch, number: int) -> None:
        """Enter into a worker's batch how often it was replaced, and what that cost."""
        part = self.parts[number]
        self._players[number] = batch.restarts or 0
        batch.restarts = self._restarts[number] + self._players_before[number] + self._players[number]
        if number not in self._lost:
            return

        # the episodes that its agents were in; what is pending of them has no outcome
        batch.dropped_episodes += part.present
        for name in part.sides:
            acting = batch.rounds.get((name, ACTING))
            batch.void[name] = torch.ones(acting.shape[1:], dtype=torch.bool)
