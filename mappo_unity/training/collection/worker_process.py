"""A worker in a process of its own: what runs there, and the messages that it takes and gives.

A message is a pickled tuple. To the worker: a method of `Worker` and its arguments, or `COLLECT`, `SLAB`,
`CLOSE`. From it: (`OK`, what the method returned), (`SPACE`, rounds, rows) where a batch has no room in the
memory that it knows, or (`ERROR`, `Report`). Tensors of a batch travel in shared memory (`slab`), or as
`on_ray` says.
"""

from __future__ import annotations

import os
import pickle
import traceback
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.learning.torch_settings import compute_as
from mappo_unity.runs.rng import seed_everything
from mappo_unity.training.child_process import begin_child
from mappo_unity.training.collection.slab import Layout, open_bytes, rows_of, write
from mappo_unity.training.collection.worker import Worker, make_worker, worker_config

COLLECT, SLAB, CLOSE = "collect", "slab", "close"
OK, SPACE, ERROR = "ok", "space", "error"

ROUNDS, STOP = 0, 1
"""Of a pulse, int64 ``[2]``: the rounds that the worker has played, and whether it is to stop."""
PULSE_BYTES = 16


class Report(NamedTuple):
    """An exception of a worker: one that ends the run as it is, or any other one with its traceback."""

    error: ConfigError | EnvironmentFailure | None
    text: str


class Stopped(Exception):
    """The driver does not want the batch any more."""


class Answering(ABC):
    """Answer messages to a worker, however they come and go.

    Args:
        number: of the worker.
        pulse: see `ROUNDS`.
    """

    def __init__(self, number: int, pulse: Tensor) -> None:
        self._number, self._pulse = number, pulse

    def answer(self, worker: Worker, method: str, arguments: Sequence[Any]) -> Any:
        """Return what a method of the worker returns; raises `Stopped`."""
        if method == COLLECT:
            weights, want_state, which = arguments
            message = worker.collect(pickle.loads(weights), want_state)
            length = message.batch.rounds.shape[0]
            where = self._hand_over(message.batch.rounds, which)
            return (replace(message.batch, rounds=TensorDict({}, [length])), length, where), message.state
        if method == "take":
            packed_policy, keeps_ends = arguments
            policy: JointPolicy = pickle.loads(packed_policy)
            policy.register_forward_pre_hook(self._beat)
            return worker.take(policy, keeps_ends)
        return getattr(worker, method)(*arguments)

    @abstractmethod
    def _hand_over(self, rounds: TensorDictBase, which: int) -> Any:
        """Bring a batch's rounds to the driver, by a set's way; return what it finds them by."""

    def _beat(self, *arguments: Any) -> None:
        """Say that a round is played; leave where nobody wants the batch any more."""
        self._pulse[ROUNDS] += 1
        if self._pulse[STOP]:
            raise Stopped


def main(cfg: Config, number: int, folder: Path, restarts: int, pulse: str, pipe: Connection) -> None:
    """Run a worker until the driver closes it, or is gone.

    Args:
        cfg: the run's options.
        number: of the worker.
        folder: of the run.
        restarts: how often the worker was replaced.
        pulse: path of the shared bytes of its pulse.
        pipe: to the driver.
    """
    begin_child()
    compute_as(cfg, cfg.num_threads)
    seed_everything(worker_config(cfg, number, restarts).seed)
    serving = _Serving(number, open_bytes(pulse, PULSE_BYTES).view(torch.int64), pipe)
    try:
        serving.serve(lambda: make_worker(cfg, number, folder, restarts))
    except (EOFError, OSError):
        os._exit(1)  # the driver has gone


class _Serving(Answering):
    """Answer the driver's messages one by one, through a pipe and shared memory."""

    def __init__(self, number: int, pulse: Tensor, pipe: Connection) -> None:
        super().__init__(number, pulse)
        self._pipe = pipe
        self._slabs: dict[int, tuple[Layout, Tensor]] = {}  # by set, 0 or 1

    def serve(self, make: Any) -> None:
        """Open the worker that `make` makes, and serve it."""
        try:
            worker: Worker = make()
        except BaseException as error:
            self._send(ERROR, report(error))
            return

        try:
            self._send(OK, worker.describe())
            while True:
                method, *arguments = pickle.loads(self._pipe.recv_bytes())
                if method == CLOSE:
                    return
                try:
                    self._send(OK, self.answer(worker, method, arguments))
                except Stopped:
                    return
                except (EOFError, BrokenPipeError, ConnectionResetError):
                    raise
                except BaseException as error:
                    self._send(ERROR, report(error))
        finally:
            worker.close()

    def _hand_over(self, rounds: TensorDictBase, which: int) -> int:
        """Write a batch's rounds into a set's memory; return its capacity."""
        length = rounds.shape[0]
        if which not in self._slabs or self._slabs[which][0].capacity < length:
            self._send(SPACE, (length, rows_of(rounds)))
            message = pickle.loads(self._pipe.recv_bytes())
            if message[0] == CLOSE:
                raise Stopped
            _, path, layout = message
            self._slabs[which] = layout, open_bytes(path, layout.size)

        layout, block = self._slabs[which]
        write(rounds, layout, block, self._number)
        return layout.capacity

    def _send(self, kind: str, content: Any) -> None:
        self._pipe.send_bytes(pickle.dumps((kind, content)))


def report(error: BaseException) -> Report:
    """Return what a driver is told about an exception; one that a user is to see keeps type and text."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    if isinstance(error, (ConfigError, EnvironmentFailure)):
        kind = type(error)
        # anew: what it came from may hold anything, and its type's constructor may take more than a text
        plain = kind(str(error)) if _takes_a_text(kind) else _base(error)(str(error))
        plain.details = error.details
        return Report(plain, text)
    return Report(None, text + "\n" + "".join(traceback.format_exception(error)))


def _takes_a_text(kind: type[BaseException]) -> bool:
    # of this package: others might be missing where the message is read
    return kind.__module__.startswith("mappo_unity.") and kind.__init__ in (
        ValueError.__init__,
        RuntimeError.__init__,
    )


def _base(error: ConfigError | EnvironmentFailure) -> type[ConfigError] | type[EnvironmentFailure]:
    return ConfigError if isinstance(error, ConfigError) else EnvironmentFailure
