"""The driver's end of a worker that is an actor of Ray."""

from __future__ import annotations

import logging
import re
import time
from collections import deque
from concurrent.futures import Future, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError

from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.training.collection.on_ray.actor import OPEN, Place, WorkerActor
from mappo_unity.training.collection.on_ray.cluster import WORKER_CPUS, describe_room
from mappo_unity.training.collection.worker_handle import LOOK_S, WorkerHandle, WorkerLost
from mappo_unity.training.collection.worker_process import CLOSE

PATIENCE_S = 30.0
"""After which it is said that a worker has not begun; importing torch takes some of it."""
_PULSE = "pulse"  # the thread that answers while a batch is collected

logger = logging.getLogger(__name__)


class ActorHandle(WorkerHandle):
    """The driver's end of a worker that is an actor of Ray.

    Args:
        cfg: the run's options.
        number: of the worker.
        folder: of the run.
        restarts: how often the worker was replaced.
    """

    def __init__(self, cfg: Config, number: int, folder: Path, restarts: int = 0) -> None:
        self.timeout_s = cfg.collect.timeout_s
        self._number = number
        # whether one that is lost is replaced, and how often, is not Ray's business
        options: dict[str, Any] = {"num_cpus": WORKER_CPUS, "max_restarts": 0, "max_task_retries": 0}
        options |= {"concurrency_groups": {_PULSE: 1}, "scheduling_strategy": "SPREAD"}
        actor: Any = ray.remote(**options)(WorkerActor)
        self._actor = actor.remote(cfg, number, folder.absolute(), restarts, Place.here())
        self._look = self._asked_for_pulse()
        self._pid: int | None = None
        self._rounds = 0
        # those that are awaited; futures, since a signal in the middle of `ray.get` loses its number
        self._answers: deque[Future[Any]] = deque()
        self.send(OPEN)

    @property
    def pid(self) -> int | None:
        """Id of its process, on its machine; None before it runs."""
        return self._pid

    def send(self, *message: Any) -> None:
        """Send a message; `receive` notices where nobody takes it."""
        self._answers.append(self._actor.tell.remote(*message).future())

    def _message(self) -> tuple[str, Any]:
        answer = self._answers.popleft()
        since = time.monotonic()
        try:
            if self._pid is None:
                self._wait_for_place(since)
            while not _is_done(answer, min(LOOK_S, self.timeout_s)):
                if self._has_played():
                    since = time.monotonic()
                elif time.monotonic() - since > self.timeout_s:
                    raise self._silent()
            message: tuple[str, Any] = answer.result()
            return message
        except RayActorError as error:
            raise WorkerLost(_reason(error)) from None
        except RayError as error:
            raise WorkerLost(f"Ray says {type(error).__name__}: {_reason(error)}") from None

    def _wait_for_place(self, since: float) -> None:
        """Wait until the actor runs somewhere; raises ConfigError where the cluster has no room for it."""
        is_said = False
        while not self._has_played():
            waited_s = time.monotonic() - since
            if waited_s > self.timeout_s:
                raise ConfigError(
                    f"collect.engine=ray: no place for worker {self._number} within "
                    f"collect.timeout_s={self.timeout_s:g} s: a worker takes {WORKER_CPUS} CPU, and "
                    f"{describe_room()}; lower collect.workers, or add machines"
                )
            if waited_s > PATIENCE_S and not is_said:
                logger.warning(
                    "worker %s has not begun: it takes %d CPU, and %s",
                    self._number,
                    WORKER_CPUS,
                    describe_room(),
                )
                is_said = True
            _is_done(self._look, min(LOOK_S, self.timeout_s))

    def _has_played(self) -> bool:
        """Return whether rounds were played, or the process began, since this was asked last."""
        if not self._look.done():
            return False
        before = self._pid, self._rounds
        self._pid, self._rounds = self._look.result()
        self._look = self._asked_for_pulse()
        return before != (self._pid, self._rounds)

    def _asked_for_pulse(self) -> Future[Any]:
        future: Future[Any] = self._actor.pulse.options(concurrency_group=_PULSE).remote().future()
        return future

    def stop(self) -> None:
        """Ask it to close its environment, also in the middle of a batch."""
        self._actor.stop.options(concurrency_group=_PULSE).remote()
        self.send(CLOSE)

    def end(self, within_s: float = 0.0) -> None:
        """End the actor, at once after some seconds; its players go with it."""
        with suppress(RayError):
            if within_s > 0 and self._answers and self._pid is not None:
                _is_done(self._answers[-1], within_s)
            ray.kill(self._actor, no_restart=True)


def _is_done(answer: Future[Any], within_s: float) -> bool:
    return bool(wait([answer], within_s).done)


def _reason(error: Exception) -> str:
    """Return the sentence that says why, of the many that Ray has."""
    text = re.sub("\x1b\\[[0-9;]*m", "", str(error))  # without colors
    lines = [line.strip() for line in text.splitlines() if line.strip()] or [type(error).__name__]
    if "creation task" in lines[0]:  # as where this package is missing there, or another version of it
        return f"its actor cannot be created: {lines[-1]}"
    because = [line for line in lines if line.startswith("The actor is dead because")]
    return (because or lines)[0].partition(". ")[0].rstrip(".").replace("The actor", "the actor", 1)
