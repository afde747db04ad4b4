"""A checkpoint as files that Unity loads: one ONNX file for each policy name.

A checkpoint holds some observations that its policies acted on. Files are written whole or not at all, and
only after onnxruntime has played them as torch plays the checkpoint (`onnx_check`). `RunExports` keeps those
of a training run up to date while it goes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from mappo_unity import keys
from mappo_unity.config.packages import ExportError
from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_check import compare
from mappo_unity.policies.onnx_graph import build_model
from mappo_unity.policies.onnx_policy import SUFFIX, OnnxPolicy, file_name
from mappo_unity.policies.policy import CheckpointPolicy
from mappo_unity.policies.policy_files import choose_checkpoint
from mappo_unity.runs import checkpoint
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.checkpoint_file import POOL
from mappo_unity.signals import interrupts_wait

SAMPLE_ROWS = 64  # observations that a checkpoint keeps of each policy
PAUSE_S = 10.0  # least time between two exports of the best checkpoint of a run
MAX_SHARE = 0.02  # of a run's time that they may take
FINAL = "final" + SUFFIX


@dataclass(frozen=True)
class Exported:
    """A file written."""

    policy: str
    path: Path
    agent_steps: int
    rows: int  # observations compared
    error: float  # largest difference of deterministic outputs


def export_checkpoint(path: Path, out: Path | None = None) -> list[Exported]:
    """Write a checkpoint's policies as ONNX files, after comparing them with it.

    Args:
        path: the checkpoint.
        out: a file for a single policy, or a folder; None: beside the checkpoint, under its name.

    Raises:
        CheckpointError: the checkpoint cannot be read.
        ExportError: a policy cannot be exported, its file plays differently, or cannot be written.
    """
    with torch.random.fork_rng(devices=[]):  # building networks draws weights
        policy = CheckpointPolicy(path, deterministic=True)

    state = checkpoint.load(path)
    samples = _samples(path, state)
    paths = _output_paths(list(policy.layout), path, out)

    written = []
    for name, layout in policy.layout.items():
        metadata = {"agent_steps": str(policy.agent_steps), "env_name": state["env_name"]}
        actor: Any = policy.actors[name]
        data = build_model(actor[0].module, layout["sensors"], name, metadata).SerializeToString()

        # What cannot be compared is refused, before anything is written.
        sample = samples.get(name, {})
        rows = len(next(iter(sample.values()), ()))
        if not rows:
            raise ExportError(
                f"checkpoint {path} holds no observations of {name!r} to compare an export with; "
                f"{_how_to_get_samples(path)}"
            )

        error = compare(data, actor, layout["sensors"], sample)
        written.append((data, Exported(name, paths[name], policy.agent_steps, rows, error)))

    with interrupts_wait():  # all of them, or none
        for data, exported in written:
            _write(exported.path, data)

    return [exported for _, exported in written]


def _samples(path: Path, state: dict[str, Any]) -> dict[str, dict[str, torch.Tensor]]:
    """Return observations that a checkpoint's policies acted on; for a snapshot of self-play its run's."""
    if path.parent.name == POOL:
        try:
            state = checkpoint.load(choose_checkpoint(path.parent.parent))
        except ConfigError:  # a copy without its run
            return {}
    samples: dict[str, dict[str, torch.Tensor]] = state.get("samples", {})
    return samples


def _how_to_get_samples(path: Path) -> str:
    if path.parent.name == POOL:
        return f"it is a snapshot of self-play, and no checkpoint of its run {path.parent.parent} holds any"
    return "let its run go on for an iteration (mappo-train resume=...), which writes one that does"


def sample_inputs(entries: TensorDictBase, in_keys: Sequence[str]) -> dict[str, torch.Tensor]:
    """Return up to 64 inputs of an actor that were acted on, spread evenly over a batch.

    Args:
        entries: one policy name's entries ``[T, (S,) G, A, ...]``.
        in_keys: the actor's.

    Returns:
        Tensors ``[n, ...]``.
    """
    acting = entries.get(keys.ACTING)[..., 0]
    rows = acting.flatten().nonzero()[:, 0]
    if len(rows) > SAMPLE_ROWS:
        rows = rows[torch.linspace(0, len(rows) - 1, SAMPLE_ROWS, device=rows.device).long()]

    return {key: entries.get(key).flatten(0, acting.ndim - 1)[rows].cpu() for key in in_keys}


class RunExports:
    """Keep ``best.onnx`` and ``final.onnx`` beside a training run's checkpoints while it goes.

    Whatever goes wrong becomes a line for the user, once, and never ends the run.

    Args:
        folder: of the run.
        message: takes a line for the user.
        is_resumed: the run was broken off, perhaps before its last export.
    """

    def __init__(self, folder: Path, message: Callable[[str], None], is_resumed: bool = False) -> None:
        self.folder = folder / checkpoint.FOLDER
        self.message = message
        self._stale = is_resumed
        self._next_at = -math.inf
        self._warned: set[str] = set()

    def best_changed(self) -> None:
        """Export the best checkpoint, unless the last time was a moment ago; then `finish` will."""
        self._stale = True
        start = time.monotonic()
        if start < self._next_at:
            return

        self._export(checkpoint.BEST)
        # The pause grows with what an export takes, so that a slow one keeps to its share of the run.
        end = time.monotonic()
        self._next_at = end + max(PAUSE_S, (end - start) / MAX_SHARE)

    def finish(self, last: Path | None) -> None:
        """Export the best checkpoint if its file is behind, and the last one as ``final.onnx``."""
        if self._stale or not list(self.folder.glob(f"best*{SUFFIX}")):
            self._export(checkpoint.BEST)
        if last is not None:
            self._export(last.name, FINAL)

    def is_behind(self, agent_steps: int) -> bool:
        """Return whether ``final.onnx``, or one of several such files, is not of the last checkpoint.

        Args:
            agent_steps: of the last checkpoint.
        """
        files = list(self.folder.glob(f"{Path(FINAL).stem}*{SUFFIX}"))
        return not files or any(_steps_of(path) != agent_steps for path in files)

    def _export(self, name: str, out: str | None = None) -> None:
        path = self.folder / name
        if not path.is_file():
            return

        try:
            export_checkpoint(path, None if out is None else self.folder / out)
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            if reason not in self._warned:
                self._warned.add(reason)
                self.message(f"no ONNX file was written for {path} (training continues): {reason}")
        else:
            self._stale = self._stale and name != checkpoint.BEST


# --- files


def _steps_of(path: Path) -> int | None:
    """Return the agent steps that an ONNX file says its policy has learnt from; None: it cannot be read."""
    try:
        return OnnxPolicy(path, deterministic=True).agent_steps
    except ConfigError:
        return None


def _output_paths(names: list[str], path: Path, out: Path | None) -> dict[str, Path]:
    """Where each policy's file goes.

    A single policy: ``out`` if it ends in .onnx, else ``out/NAME.onnx``, or beside the checkpoint.
    """
    if out is None:
        out = path.with_suffix(SUFFIX)
    elif out.is_dir() or out.suffix != SUFFIX:
        return {name: out / file_name(name) for name in names}
    if len(names) == 1:
        return {names[0]: out}
    return {name: out.with_name(f"{out.stem}_{file_name(name)}") for name in names}


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, data)
    except OSError as error:
        raise ExportError(
            f"the ONNX file {path} cannot be written: {error.strerror or error}; out=... names another file "
            "or folder"
        ) from error
