"""What can be known of checkpoints without torch: which there are, whether one is whole, and what it holds.

A checkpoint is a zip archive: its checksums are verified first, then its pickle is read with a stand-in for
everything but plain values, so nothing in it is ever run and no tensor is loaded.
"""

from __future__ import annotations

import pickle
import re
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

from mappo_unity.errors import ConfigError

FORMAT = 2
FOLDER = "checkpoints"
POOL = "pool"  # the folder of past policies that only play, see `training.self_play`
BEST = "best.pt"
NAME = "step_{:012d}.pt"
_PATTERN = re.compile(r"step_(\d{12})\.pt")


class CheckpointError(ConfigError):
    """A checkpoint cannot be written, read or used; the message says which and why."""


def checkpoints_in(folder: Path) -> list[Path]:
    """Return a run's numbered checkpoints, oldest first."""
    return sorted(p for p in (folder / FOLDER).glob("step_*.pt") if _PATTERN.fullmatch(p.name))


def step_of(path: Path) -> int:
    """Return the agent decisions that the name of a numbered checkpoint tells."""
    found = _PATTERN.fullmatch(path.name)
    assert found is not None, path
    return int(found[1])


def read_plain(path: Path) -> dict[str, Any]:
    """Return a checkpoint's entries; a stand-in for each tensor.

    Raises:
        CheckpointError: it is missing, damaged, not ours, or of another format.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist")

    try:
        with zipfile.ZipFile(path) as archive:
            # Checksums first: nothing of a damaged archive reaches the unpickler.
            damaged = archive.testzip()
            if damaged is not None:
                raise CheckpointError(
                    f"checkpoint {path} is damaged: the checksum of its part {damaged!r} is wrong"
                )
            (name,) = (name for name in archive.namelist() if re.fullmatch(r"[^/]+/data\.pkl", name))
            with archive.open(name) as file:
                state = _PlainValues(file).load()
    except CheckpointError:
        raise
    except Exception as error:  # zipfile and pickle raise many kinds for damaged or hostile files
        raise CheckpointError(unreadable(path, error)) from error

    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise CheckpointError(_other_format(path, state))

    return state


def unreadable(path: Path, error: Exception) -> str:
    """Say that a file is no checkpoint that can be read, and why."""
    empty = "it is empty" if path.stat().st_size == 0 else ""
    reason = empty or str(error).strip().split("\n")[0][:200] or type(error).__name__
    return f"checkpoint {path} is damaged or no checkpoint of mappo-unity: {reason}"


def newest_good(where: Path) -> tuple[Path, list[str]]:
    """Return the checkpoint to resume from: the file itself, or a folder's newest good one.

    Returns:
        The path, and a line for each damaged file that was passed over.

    Raises:
        CheckpointError: there is none.
    """
    if where.is_file():
        candidates, folder = [where], where.parent.parent
        # A damaged file gives way to one before it, never to a later one.
        candidates += [p for p in reversed(checkpoints_in(folder)) if p.name < where.name]
    elif where.is_dir():
        candidates = list(reversed(checkpoints_in(where)))
    else:
        raise CheckpointError(f"{where} does not exist: give a run folder or a checkpoint file")

    if not candidates:
        raise CheckpointError(f"{where} holds no checkpoint ({FOLDER}/step_*.pt): nothing to resume from")

    warnings: list[str] = []
    for path in candidates:
        try:
            read_plain(path)
        except CheckpointError as error:
            warnings.append(str(error))
        else:
            return path, warnings

    raise CheckpointError(f"{where} holds no good checkpoint:\n  " + "\n  ".join(warnings))


class _Nothing:
    """Stand in for a tensor, and for whatever else a pickle would build."""

    def __new__(cls, *args: Any, **kwargs: Any) -> _Nothing:
        return object.__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Take anything."""

    def __setstate__(self, state: Any) -> None:
        """Take anything."""


class _PlainValues(pickle.Unpickler):
    """Read plain values; every class and function that a pickle names is `_Nothing`, but for OrderedDict."""

    def find_class(self, module: str, name: str) -> Any:
        return OrderedDict if (module, name) == ("collections", "OrderedDict") else _Nothing

    def persistent_load(self, pid: Any) -> Any:
        return _Nothing()


def _other_format(path: Path, state: Any) -> str:
    found = state.get("format") if isinstance(state, dict) else None
    if not isinstance(found, int):
        return f"{path} is a file of torch, but no checkpoint of mappo-unity"
    return f"checkpoint {path} has format {found}, but this version reads format {FORMAT}"
