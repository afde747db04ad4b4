"""Checkpoints: written whole or not at all, read without running code.

A checkpoint is a nested dict of tensors, numpy arrays and plain values, in a ``.pt`` file that plain
``torch.load(weights_only=True)`` opens.

A file is written beside its place, synced and renamed, so that a kill or a full disk leaves the
previous one. It is a zip archive; its checksums are verified before anything is read, and only
tensors and plain values are ever unpickled.
"""

from __future__ import annotations

import errno
import io
import os
import shutil
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.checkpoint_file import (
    BEST,
    FOLDER,
    FORMAT,
    NAME,
    CheckpointError,
    checkpoints_in,
    newest_good,
    read_plain,
    step_of,
    unreadable,
)

__all__ = [
    "BEST",
    "FOLDER",
    "NAME",
    "CheckpointError",
    "checkpoints_in",
    "load",
    "newest_good",
    "save",
    "save_in",
    "set_aside_later",
]


def save(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically.

    Raises:
        CheckpointError: the disk is full or the folder cannot be written; a previous file stays.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        torch.save(_to_tensors({"format": FORMAT} | state), content)
        write_atomically(path, content.getvalue())
        _sync_folder(path.parent)
    except (OSError, RuntimeError) as error:
        raise CheckpointError(
            f"checkpoint {path} could not be written: {error}; the checkpoints before it stay as they are. "
            "Free some space or choose another output_dir, then resume with resume=" + str(path.parent.parent)
        ) from error


def save_in(folder: Path, agent_steps: int, state: dict[str, Any], keep: int, best: bool) -> Path:
    """Write a run's checkpoint, make it the best one if it is, and drop all but the newest ``keep``.

    Raises:
        CheckpointError: it cannot be written, or not become the best one; those before it stay.
    """
    if not folder.is_dir():
        raise CheckpointError(
            f"the run folder {folder} was removed or moved while the run was training: "
            f"no checkpoint of {agent_steps} steps can be written"
        )

    path = folder / FOLDER / NAME.format(agent_steps)
    save(path, state)

    if best:
        try:
            _make_best(path, state)
        except OSError as error:
            raise CheckpointError(
                f"checkpoint {path} was written, but {BEST} could not be made of it: {error}; the one before "
                "it stays"
            ) from error

    for old in checkpoints_in(folder)[:-keep]:
        with suppress(OSError):  # one that cannot be removed costs space, and no run
            old.unlink(missing_ok=True)

    return path


def _make_best(path: Path, state: dict[str, Any]) -> None:
    # A second name for the same file, moved into place: at no moment there is none.
    link = path.with_name(f".{BEST}.{os.getpid()}.tmp")
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:  # a file system without hard links
        save(path.with_name(BEST), state)
    else:
        os.replace(link, path.with_name(BEST))


def set_aside_later(folder: Path, resumed: Path, agent_steps: int) -> list[str]:
    """Move checkpoints later than the one that a run goes on from out of its way, to ``abandoned_N/``.

    They belong to a way that is not taken: among them new ones would count as old. Where the best one is of
    that way, the one that the run goes on from is the best.

    Args:
        folder: the run's.
        resumed: the checkpoint that the run goes on from.
        agent_steps: its.

    Returns:
        A line for the user, where there are any.
    """
    later = [path for path in checkpoints_in(folder) if step_of(path) > agent_steps]
    best = folder / FOLDER / BEST
    is_of_later = best.exists() and not _is_up_to(best, agent_steps)
    files_of_best = list(best.parent.glob(f"{best.stem}*")) if is_of_later else []  # its ONNX files, too
    if not later and not files_of_best:
        return []

    # The best one may be known by that name alone; a run resumes from numbered ones.
    own = folder / FOLDER / NAME.format(agent_steps)
    if not own.exists():
        shutil.copy2(resumed, own)

    numbers = count(1)
    while (aside := folder / FOLDER / f"abandoned_{next(numbers)}").exists():
        pass
    aside.mkdir()
    for path in [*later, *files_of_best]:
        os.replace(path, aside / path.name)

    lines = []
    if later:
        many = f"{len(later)} later checkpoints, up to {step_of(later[-1]):,} steps"
        lines.append(f"{many}, were moved to {aside}")
    if files_of_best:
        write_atomically(best, own.read_bytes())
        lines.append(f"the best one until now is of later steps, too, and lies in {aside}")
    return lines


def _is_up_to(path: Path, agent_steps: int) -> bool:
    """Return whether a checkpoint can be read and is of so many steps at most."""
    try:
        return int(load(path)["agent_steps"]) <= agent_steps
    except CheckpointError:
        return False


def load(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        CheckpointError: it is missing, damaged, not ours, or holds more than tensors and plain values.
    """
    # Called for its checks: it says what is wrong with the file.
    read_plain(path)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for damaged or hostile files
        raise CheckpointError(unreadable(path, error)) from error


def _to_tensors(value: Any) -> Any:
    """Turn numpy arrays and scalars into what weights_only loading allows."""
    if isinstance(value, dict):
        return {key: _to_tensors(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_tensors(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _array_to_tensor(value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def _array_to_tensor(array: np.ndarray) -> Any:
    # Unsigned numbers go as signed ones of the same bytes, with their type; `to_arrays` turns them back.
    if array.dtype in (np.uint16, np.uint32, np.uint64):
        return {
            "__array__": str(array.dtype),
            "data": torch.from_numpy(array.view(f"i{array.itemsize}").copy()),
        }

    return torch.from_numpy(array.copy(order="C"))  # np.ascontiguousarray makes one number a row of one


def to_arrays(value: Any) -> Any:
    """Turn the tensors of a loaded state back into numpy arrays (for scenes and adapters)."""
    if isinstance(value, dict):
        if "__array__" in value:
            return value["data"].numpy().view(value["__array__"])
        return {key: to_arrays(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [to_arrays(entry) for entry in value]
    return value.numpy() if isinstance(value, torch.Tensor) else value


def _sync_folder(folder: Path) -> None:
    # A rename outlives a loss of power only once the folder is on the disk.
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # not possible on every platform; the rename itself is atomic
        return

    try:
        os.fsync(descriptor)
    except OSError as error:
        # some file systems, shared and network ones, do not do so with folders
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)
