"""Several workers as one fleet, and those that play in this process, one after another."""

from __future__ import annotations

import copy
import pickle
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tensordict import TensorDictBase

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.config.schema import Config
from mappo_unity.learning.networks.joint_policy import JointPolicy
from mappo_unity.learning.networks.opponents import Opponents
from mappo_unity.runs.rng import get_rng_state, seed_everything, set_rng_state
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.description import Description, join_descriptions
from mappo_unity.training.collection.fleet import Fleet
from mappo_unity.training.collection.joining import join_batches, on_device
from mappo_unity.training.collection.lineups import Lineup, Lineups
from mappo_unity.training.collection.worker import Message, Weights, Worker, make_worker, worker_config


class Answers(NamedTuple):
    """What workers have collected."""

    batches: list[Batch]
    states: list[dict[str, Any] | None]
    rounds: TensorDictBase | None  # of all of them, where they lie side by side already


class SeveralWorkers(Fleet):
    """Workers whose batches are joined; what follows says how they are reached.

    Args:
        cfg: the run's options.
        parts: what each worker has.
    """

    def __init__(self, cfg: Config, parts: list[Description]) -> None:
        self._cfg, self.parts = cfg, parts
        self.env: Description = join_descriptions(parts)
        self._weights: Weights | None = None  # of the batch that is requested, or was last
        self._is_requested = False
        self._states: list[dict[str, Any] | None] = [None] * len(parts)
        self._behind: Weights | None = None  # of a request that a checkpoint was written beside
        self._lineups = Lineups()

    def request(self, weights: Weights | None, want_state: bool) -> None:
        """Ask every worker for a batch."""
        lineup = self._lineups.next(self._behind is not None)
        if lineup is not None:
            self._call("oppose", lineup)
        if self._behind is not None:  # as in the run that is resumed
            weights, self._behind = self._behind, None
        self._weights, self._is_requested = weights, True
        self._ask(weights, want_state)

    def receive(self) -> Batch:
        """Wait for the batches, and join them, on the learners' device."""
        batches, self._states, rounds = self._answers()
        self._is_requested = False
        return on_device(join_batches(batches, self.parts, rounds), self._cfg.device)

    def oppose(self, lineup: Lineup) -> None:
        """Let opponents play teams from the next request on."""
        self._lineups.decide(lineup)

    @property
    def opposing(self) -> set[int]:
        """The numbers of the opponents of a batch that is on its way, or is behind."""
        return self._lineups.numbers if self._is_requested or self._behind is not None else set()

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter everywhere."""
        self._call("set_parameter", name, value)
        self._states = [None] * len(self.parts)

    def restart(self) -> None:
        """Reset all scenes."""
        self._call("restart")
        self._states = [None] * len(self.parts)

    def state_dict(self) -> dict[str, Any]:
        """Return the workers' states; `behind`: the weights of a batch on its way, to collect it again."""
        if None in self._states:
            self._states = self._call("state")
        behind, players = (self._weights, self._lineups.state_dict()) if self._is_requested else (None, None)
        own = {"workers": self._states, "behind": behind, "behind_players": players}
        return {"env": None, "memories": {}, **own}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore them."""
        self._load(state["workers"])
        self._states = [None] * len(self.parts)
        if self._cfg.collect.overlap:
            self._behind = state["behind"]
            self._lineups.load_state_dict(state.get("behind_players"))

    @abstractmethod
    def _ask(self, weights: Weights | None, want_state: bool) -> None: ...

    @abstractmethod
    def _answers(self) -> Answers: ...

    @abstractmethod
    def _call(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of every worker, none of which collects; return what each returns."""

    @abstractmethod
    def _load(self, states: list[Mapping[str, Any]]) -> None: ...


class LocalWorkers(SeveralWorkers):
    """Workers in this process, one after another, each with generators of random numbers of its own."""

    def __init__(self, cfg: Config, folder: Path) -> None:
        self._workers: list[Worker] = []
        self._generators: list[dict[str, Any]] = []
        before = get_rng_state()
        try:
            for number in range(cfg.collect.workers):
                seed_everything(worker_config(cfg, number).seed)
                self._workers.append(make_worker(cfg, number, folder))
                self._generators.append(get_rng_state())
            super().__init__(cfg, [worker.describe() for worker in self._workers])
        except BaseException:
            self.close()
            raise
        finally:
            set_rng_state(before)
        self._want_state = False

    def start(self, policy: JointPolicy, keeps_ends: bool) -> None:
        """Hand out copies of the policy."""
        for number, worker in enumerate(self._workers):
            with self._drawing(number):
                worker.take(pickle.loads(packed(policy)), keeps_ends)

    def close(self) -> None:
        """Close all environments."""
        for worker in self._workers:
            worker.close()

    def _ask(self, weights: Weights | None, want_state: bool) -> None:
        self._want_state = want_state

    def _answers(self) -> Answers:
        messages: list[Message] = []
        for number, worker in enumerate(self._workers):
            with self._drawing(number):
                messages.append(worker.collect(self._weights, self._want_state))
        return Answers([message.batch for message in messages], [message.state for message in messages], None)

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        out = []
        for number, worker in enumerate(self._workers):
            with self._drawing(number):
                out.append(getattr(worker, method)(*arguments))
        return out

    def _load(self, states: list[Mapping[str, Any]]) -> None:
        for worker, state in zip(self._workers, states):
            worker.load(state)

    @contextmanager
    def _drawing(self, number: int) -> Iterator[None]:
        """Let a worker's own generators stand in for the global ones."""
        before = get_rng_state()
        set_rng_state(self._generators[number])
        try:
            yield
        finally:
            self._generators[number] = get_rng_state()
            set_rng_state(before)


def packed(policy: JointPolicy) -> bytes:
    """Return a policy as bytes, whose copy lies on the CPU."""
    own = copy.deepcopy(policy).cpu()
    if own.opponents is not None:
        own.opponents = Opponents()  # a worker is told its own
    return pickle.dumps(own)
