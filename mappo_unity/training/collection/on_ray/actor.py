"""A worker as an actor of Ray: what runs there, and what it answers.

Messages are those of `worker_process`, as arguments and return values of one method; `OPEN` comes first.
A second thread tells the pulse, also while a batch is collected.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase

from mappo_unity.config.schema import Config
from mappo_unity.learning.torch_settings import compute_as
from mappo_unity.runs.rng import seed_everything
from mappo_unity.training.collection.description import Description
from mappo_unity.training.collection.slab import Layout, make_layout, rows_of, write
from mappo_unity.training.collection.worker import Worker, make_worker, worker_config
from mappo_unity.training.collection.worker_process import (
    CLOSE,
    ERROR,
    OK,
    ROUNDS,
    STOP,
    Answering,
    Stopped,
    report,
)

OPEN = "open"


class Place(NamedTuple):
    """Where the driver runs and looks for modules: an environment's own code is found from there."""

    folder: str
    modules: list[str]

    @classmethod
    def here(cls) -> Place:
        """Return the place of this process."""
        return cls(os.getcwd(), [path for path in sys.path if path])

    def enter(self) -> None:
        """Go there, as far as it exists on this machine."""
        sys.path += [path for path in self.modules if path not in sys.path and os.path.exists(path)]
        if os.path.isdir(self.folder):
            os.chdir(self.folder)


class WorkerActor(Answering):
    """A worker as an actor.

    Args:
        cfg: the run's options.
        number: of the worker.
        folder: of the run; players log below it, on the machine of the worker.
        restarts: how often the worker was replaced.
        place: of the driver.
    """

    def __init__(self, cfg: Config, number: int, folder: Path, restarts: int, place: Place) -> None:
        super().__init__(number, torch.zeros(2, dtype=torch.int64))
        self._cfg, self._folder, self._restarts = cfg, folder, restarts
        self._place = place
        self._worker: Worker | None = None
        self._parts: list[Description] = []  # what this worker has, alone

    def tell(self, method: str, *arguments: Any) -> tuple[str, Any]:
        """Take a message; return the one that answers it."""
        try:
            if method == OPEN:
                return OK, self._opened()
            assert self._worker is not None, "no worker"
            if method == CLOSE:
                self._worker.close()
                return OK, None
            return OK, self.answer(self._worker, method, arguments)
        except Stopped:
            return OK, None
        except BaseException as error:
            return ERROR, report(error)

    def pulse(self) -> tuple[int, int]:
        """Return the id of the process, and the rounds that it has played."""
        return os.getpid(), int(self._pulse[ROUNDS])

    def stop(self) -> None:
        """Give up the batch that is being collected."""
        self._pulse[STOP] = 1

    def _opened(self) -> Description:
        self._place.enter()
        compute_as(self._cfg, self._cfg.num_threads)
        seed_everything(worker_config(self._cfg, self._number, self._restarts).seed)
        self._worker = make_worker(self._cfg, self._number, self._folder, self._restarts)
        self._parts = [self._worker.describe()]
        return self._parts[0]

    def _hand_over(self, rounds: TensorDictBase, which: int) -> tuple[Layout, np.ndarray]:
        """Return the rounds as one array, which Ray hands on without copies, and where they lie in it."""
        layout = make_layout(rows_of(rounds), self._parts, rounds.shape[0])
        block = np.empty(layout.size, np.uint8)
        write(rounds, layout, torch.from_numpy(block), 0)
        return layout, block
