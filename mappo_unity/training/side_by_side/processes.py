"""The driver's end of learners beside its own: it hands out parts of a batch, and learns its own."""

from __future__ import annotations

import pickle
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from mappo_unity.config.schema import Config
from mappo_unity.errors import EnvironmentFailure
from mappo_unity.learning.ppo import PolicyLearner
from mappo_unity.training.child_process import start_child
from mappo_unity.training.collection.description import Description
from mappo_unity.training.collection.joining import team_dim
from mappo_unity.training.collection.worker_process import CLOSE, ERROR, Report
from mappo_unity.training.side_by_side.parts import Task, learn, part_of_state, shares, whole_state
from mappo_unity.training.side_by_side.process import device_of, join, leave, main, meet

END_S = 5.0
"""Within which a learner that was closed has ended, or one that failed has said why."""


class LearnerProcesses:
    """Learners in processes of their own beside the driver's, which is the first.

    Args:
        cfg: the run's options.
        learners: of the policy names that learn; they take a part of the teams from now on.
        description: of what is played.
        rounds: of a batch.
        guesses_channels: see `TrainingSetup.guess_channels`.
        generators: of each process, of the run that is resumed; None: fresh ones.

    Raises:
        EnvironmentFailure: a process could not be started.
    """

    def __init__(
        self,
        cfg: Config,
        learners: Mapping[str, PolicyLearner],
        description: Description,
        rounds: int,
        guesses_channels: bool = False,
        generators: Sequence[Any] | None = None,
    ) -> None:
        self._learners = learners
        self._teams = {
            name: shares(description.teams(name), cfg.learners, team_dim(description, name))
            for name in learners
        }

        # all start before anything is sent: importing torch takes seconds
        self._folder = Path(tempfile.mkdtemp(prefix="mappo-unity-"))
        meeting = str(self._folder / "meeting")
        others = range(1, cfg.learners)
        self._children = [start_child(main, (cfg, rank, meeting), f"learner-{rank}") for rank in others]

        try:
            whole = {name: learner.state_dict() for name, learner in learners.items()}
            parts = [self._parts(whole, rank) for rank in range(cfg.learners)]
            for rank in others:
                known = None if generators is None else generators[rank - 1]
                self._send(rank, "build", description, rounds, guesses_channels, parts[rank], known)

            # the others meet when they have built theirs, and join after it, as this one does
            meet(cfg, 0, meeting)
            join(learners, parts[0], device_of(cfg, 0))
            self._answers()
        except BaseException as error:
            try:
                self._explain(error)
            finally:
                self.close()
            raise

    def learn(self, tasks: Mapping[str, Task]) -> dict[str, dict[str, float]]:
        """Learn a batch together; return the metrics of each policy name, which are everybody's.

        Raises:
            EnvironmentFailure: a learner has failed or is gone.
        """
        for rank in range(1, 1 + len(self._children)):
            parts = {name: task.part(self._teams[name][rank]).to("cpu") for name, task in tasks.items()}
            self._send(rank, "learn", parts)
        try:
            mine = {name: task.part(self._teams[name][0]) for name, task in tasks.items()}
            metrics = learn(self._learners, mine)
            self._answers()
        except RuntimeError as error:
            self._explain(error)
            raise
        return metrics

    def states(self) -> tuple[dict[str, Any], list[Any]]:
        """Return the learners' states as one learner alone has them, and the other processes' generators."""
        self._send_all("state")
        answers = self._answers()
        whole = {}
        for name, learner in self._learners.items():
            parts = [learner.state_dict(), *(kept[name] for kept, _ in answers)]
            whole[name] = whole_state(parts, self._teams[name])
        return whole, [generators for _, generators in answers]

    def forget_pending(self) -> None:
        """Drop the decisions whose outcome has not arrived, of the others."""
        self._send_all("forget_pending")
        self._answers()

    def close(self) -> None:
        """End the processes."""
        self._send_all(CLOSE)
        leave()
        for process, pipe in self._children:
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()
            pipe.close()
        self._children = []
        shutil.rmtree(self._folder, ignore_errors=True)

    def _parts(self, states: Mapping[str, Any], rank: int) -> dict[str, Any]:
        """Return a learner's part of whole states."""
        return {name: part_of_state(state, self._teams[name][rank]) for name, state in states.items()}

    def _send_all(self, *message: Any) -> None:
        for rank in range(1, 1 + len(self._children)):
            self._send(rank, *message)

    def _send(self, rank: int, *message: Any) -> None:
        with suppress(OSError):  # where nobody takes it, the answer is missing
            self._children[rank - 1][1].send_bytes(pickle.dumps(message))

    def _answers(self) -> list[Any]:
        return [self._answer(rank) for rank in range(1, 1 + len(self._children))]

    def _answer(self, rank: int) -> Any:
        process, pipe = self._children[rank - 1]
        try:
            kind, content = pickle.loads(pipe.recv_bytes())
        except (EOFError, OSError):
            process.join(END_S)
            raise EnvironmentFailure(
                f"learner {rank} is gone: its process ended with {process.exitcode}; the run can be resumed "
                "from its last checkpoint"
            ) from None
        if kind != ERROR:
            return content

        report: Report = content
        if report.error is not None:
            raise report.error
        raise EnvironmentFailure(f"learner {rank} failed: {report.text}")

    def _explain(self, error: BaseException) -> None:
        """Raise what a learner says of its end, where an error of torch.distributed followed from that."""
        if isinstance(error, EnvironmentFailure) or not isinstance(error, RuntimeError):
            return
        for rank, (process, pipe) in enumerate(self._children, 1):
            if wait([pipe, process.sentinel], END_S):
                self._answer(rank)
