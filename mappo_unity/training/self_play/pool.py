"""The pool of past policies: snapshots in files of the run, and how each has fared.

A snapshot's file is a checkpoint that plays (`mappo-eval run=`, `mappo-league`), but holds nothing to resume
from. The run's own checkpoints refer to it by name and checksum.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from mappo_unity.errors import ConfigError
from mappo_unity.runs import checkpoint
from mappo_unity.runs.checkpoint_file import POOL, CheckpointError, read_plain, step_of

_FORGET = 200.0  # results after which older ones count half, so that a share won is of recent matches

Tensors = dict[str, torch.Tensor]


@dataclass
class Record:
    """How an opponent of one policy name has fared against those who learn."""

    elo: float
    lost: float = 0.0  # results, a draw counted half: what the learner won
    played: float = 0.0

    def add(self, score: float) -> None:
        """Count a result: 1 the opponent won, 0.5 drawn, 0 lost."""
        if self.played >= _FORGET:
            self.lost, self.played = self.lost / 2, self.played / 2
        self.lost += 1 - score
        self.played += 1

    @property
    def share_lost(self) -> float:
        """The learner's share of the points against it, from a half on with nothing known."""
        return (self.lost + 1) / (self.played + 2)


@dataclass
class Snapshot:
    """A past policy; `actors` holds the networks' tensors by policy name."""

    number: int
    steps: int
    file: str
    checksum: int
    actors: dict[str, Tensors] = field(default_factory=dict)
    dropped_at: int | None = None  # out of the pool; agent decisions from which on no checkpoint refers to it


class Pool:
    """The newest snapshots of a run, and older ones that are still playing or that a checkpoint refers to.

    Args:
        folder: the run's.
        window: how many are opponents.
    """

    def __init__(self, folder: Path, window: int) -> None:
        self._folder, self._window = folder, window
        self._snapshots: list[Snapshot] = []
        self._next = 0
        self._best: tuple[int, int] | None = None  # the best checkpoint's time, ns, and agent decisions

    @property
    def numbers(self) -> list[int]:
        """The numbers of the opponents, oldest first."""
        return [snapshot.number for snapshot in self._snapshots if snapshot.dropped_at is None]

    @property
    def all_numbers(self) -> set[int]:
        """The numbers of all snapshots whose networks are at hand, also of those that left the pool."""
        return {snapshot.number for snapshot in self._snapshots if snapshot.actors}

    def tensors(self, number: int, name: str) -> Tensors:
        """Return an opponent's network for a policy name."""
        return self._of(number).actors[name]

    def steps(self, number: int) -> int:
        """Return the agent decisions after which a snapshot was taken."""
        return self._of(number).steps

    def add(self, steps: int, actors: Mapping[str, Tensors], about: Mapping[str, Any]) -> int:
        """Take a snapshot into the pool and write its file; return its number.

        Args:
            steps: agent decisions of the run.
            actors: tensors by policy name; they are copied.
            about: what a file needs beside them to be played.

        Raises:
            CheckpointError: the file cannot be written.
        """
        copies = {name: {k: v.detach().cpu().clone() for k, v in a.items()} for name, a in actors.items()}
        path = self._folder / POOL / checkpoint.NAME.format(steps)
        if not self._folder.is_dir():
            raise CheckpointError(f"the run folder {self._folder} was removed while the run was training")
        learners = {name: {"actor": tensors} for name, tensors in copies.items()}
        checkpoint.save(path, {**about, "agent_steps": steps, "learners": learners})

        number, self._next = self._next, self._next + 1
        self._snapshots.append(Snapshot(number, steps, path.name, _checksum(copies), copies))
        for old in self.numbers[: -self._window]:
            self._of(old).dropped_at = steps
        return number

    def keep(self, used: set[int], steps: int) -> None:
        """Keep the files of snapshots that left the pool and are still playing after so many decisions."""
        for snapshot in self._snapshots:
            if snapshot.dropped_at is not None and snapshot.number in used:
                snapshot.dropped_at = steps + 1  # a checkpoint may be written now

    def clean(self, used: set[int]) -> None:
        """Delete the files of snapshots that neither play nor belong to a checkpoint that is kept.

        Args:
            used: numbers that are still playing.
        """
        kept = [step_of(path) for path in checkpoint.checkpoints_in(self._folder)]
        if not kept:
            return
        best = self._best_steps()
        for snapshot in list(self._snapshots):
            dropped_at = snapshot.dropped_at
            if dropped_at is None or snapshot.number in used or kept[0] < dropped_at:
                continue
            if best is not None and snapshot.steps <= best < dropped_at:
                continue
            with suppress(OSError):  # one that cannot be removed costs space, and no run
                (self._folder / POOL / snapshot.file).unlink(missing_ok=True)
            self._snapshots.remove(snapshot)

    def _best_steps(self) -> int | None:
        """Return the agent decisions of the best checkpoint, which is kept, too."""
        path = self._folder / checkpoint.FOLDER / checkpoint.BEST
        try:
            changed = path.stat().st_mtime_ns
            if self._best is None or self._best[0] != changed:
                self._best = changed, int(read_plain(path)["agent_steps"])
        except (OSError, CheckpointError):
            return None
        return self._best[1]

    def state_dict(self) -> dict[str, Any]:
        """Return the snapshots by reference to their files."""
        known = [
            {"number": s.number, "steps": s.steps, "file": s.file, "checksum": s.checksum}
            | {"dropped_at": s.dropped_at}
            for s in self._snapshots
        ]
        return {"next": self._next, "snapshots": known}

    def load_state_dict(
        self, state: Mapping[str, Any], used: set[int], skip: bool, say: Callable[[str], None]
    ) -> None:
        """Restore what `state_dict` returned, from the files.

        Args:
            used: numbers that are playing, or will at a next episode.
            skip: go on without those whose files are missing or damaged.
            say: takes a line about each of these.

        Raises:
            CheckpointError: a file that is needed is missing or damaged, and not to be skipped.
        """
        self._next, self._snapshots = int(state["next"]), []
        for known in state["snapshots"]:
            snapshot = Snapshot(**known)
            needed = snapshot.dropped_at is None or snapshot.number in used
            path = self._folder / POOL / snapshot.file
            try:
                if needed:
                    snapshot.actors = _read(path, snapshot.checksum)
            except ConfigError as error:
                if not skip:
                    raise CheckpointError(
                        f"an opponent of the pool cannot be loaded: {error}; "
                        "self_play.skip_missing=true resumes without it"
                    ) from error
                say(f"an opponent of the pool is left out: {error}")
                continue
            self._snapshots.append(snapshot)

    def _of(self, number: int) -> Snapshot:
        return next(snapshot for snapshot in self._snapshots if snapshot.number == number)


def _read(path: Path, checksum: int) -> dict[str, Tensors]:
    learners = checkpoint.load(path)["learners"]
    actors = {name: learner["actor"] for name, learner in learners.items()}
    if _checksum(actors) != checksum:
        raise CheckpointError(f"{path} holds another policy than the one that the checkpoint refers to")
    return actors


def _checksum(actors: Mapping[str, Tensors]) -> int:
    """Return a CRC-32 of all tensors, in the order of their names."""
    value = 0
    for name in sorted(actors):
        for key in sorted(actors[name]):
            value = zlib.crc32(actors[name][key].contiguous().numpy().tobytes(), value)
    return value
