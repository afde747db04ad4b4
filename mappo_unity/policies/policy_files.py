"""What a path given as run=, policy=, opponent= or resume= is, as far as that can be known without torch.

A path that does not fit is a `ConfigError`, which says what it is instead and what the option takes.
"""

from __future__ import annotations

import logging
import os
import zipfile
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any

from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.parameters.values import params_at
from mappo_unity.config.schema import EnvConfig
from mappo_unity.errors import ConfigError
from mappo_unity.runs.checkpoint_file import (
    BEST,
    FOLDER,
    POOL,
    CheckpointError,
    checkpoints_in,
    newest_good,
    read_plain,
)
from mappo_unity.runs.folder import CONFIG, check_there, runs_below

RANDOM = "random"
ZOO = "zoo"
ZOO_FOLDER = Path(__file__).resolve().parents[1] / "zoo"
"""The trained policies that the package brings, BEHAVIOR.onnx each."""
SUFFIX = ".onnx"
PLAYABLE = "random, zoo, a run folder, a checkpoint (.pt) or an ONNX file"

logger = logging.getLogger(__name__)


class Kind(Enum):
    """What plays."""

    random = "random actions"
    run = "a run folder"
    checkpoint = "a checkpoint"
    onnx = "an ONNX file"
    onnx_folder = "a folder of ONNX files"


@dataclass(frozen=True)
class Source:
    """Where a policy comes from; `path` is that of a run where a run's folder of checkpoints was named."""

    kind: Kind
    path: Path
    option: str


def locate(where: str, option: str, wanted: str = PLAYABLE) -> Source:
    """Return what a path is that an option names as a policy.

    Raises:
        ConfigError: nothing is there, or nothing that plays.
    """
    path = Path(where)
    if where == RANDOM:
        return Source(Kind.random, path, option)
    if where == ZOO:
        return Source(Kind.onnx_folder, ZOO_FOLDER, option)

    check_there(path, option, f": give {wanted}")
    if path.is_dir():
        return _folder(path, option)
    return Source(_kind_of_file(path, option, wanted), path, option)


def check_resumable(path: Path, option: str) -> None:
    """Raise ConfigError for an ONNX file or a folder of them, and for a file that is no checkpoint."""
    check_there(path, option)

    wanted = "a run folder or a checkpoint (.pt)"
    if path.is_dir():
        if (path / CONFIG).is_file() or (path.parent / CONFIG).is_file() or not list(path.glob(f"*{SUFFIX}")):
            return
        raise ConfigError(f"{option}={path} is a folder of ONNX files: {option} takes {wanted}")

    if _kind_of_file(path, option, wanted) is Kind.checkpoint:
        if option == "resume" and path.parent.name == POOL:
            raise ConfigError(
                f"{option}={path} is an opponent of a run's pool: it holds a policy, but not what resuming "
                f"needs (optimizer, counters, critic); its run: {shell_argument(option, path.parent.parent)}"
            )
        return

    # An ONNX file in the folder of a run: that run can be named instead.
    run = next((folder for folder in path.parents if (folder / CONFIG).is_file()), None)
    instead = f"; its run: {shell_argument(option, run)}" if run is not None else ""
    if option == "resume":
        reason = "it holds a policy, but not what resuming needs (optimizer, counters, critic)"
        use = f"mappo-eval {shell_argument('run', path)} and mappo-play env=NAME "
        use += f"{shell_argument('policy', path)} play it"
    else:
        reason = "it needs no export"
        use = "Unity loads it as it is"

    raise ConfigError(
        f"{option}={path} is an ONNX file: {reason}. {option} takes {wanted}{instead}. An ONNX file is for "
        f"playing: {use}"
    )


def choose_checkpoint(run: Path, option: str = "run") -> Path:
    """Return a checkpoint file as it is; of a run folder the best, else the newest good one.

    Raises:
        ConfigError: the folder holds none; names the option.
    """
    if not run.is_dir():
        return run

    run = _folder(run, option).path
    best = run / FOLDER / BEST
    if best.is_file():
        return best

    path, warnings = newest_good(run)
    for warning in warnings:
        logger.warning("%s; %s is taken", warning, path)
    return path


def check_checkpoint(source: Source) -> dict[str, Any]:
    """Return the plain values of the checkpoint that a source means; raise ConfigError if it is not whole."""
    path = choose_checkpoint(source.path, source.option)
    try:
        return read_plain(path)
    except CheckpointError as error:
        others = [str(p) for p in reversed(checkpoints_in(source.path)) if p != path]
        if not others:
            raise
        raise CheckpointError(f"{error}; its run has others: {', '.join(others)}") from error


def at_its_lessons(env: EnvConfig, policy: str) -> EnvConfig:
    """Return the options of an environment at the lessons that a policy had reached.

    The lessons are those of its checkpoint; what holds none (an ONNX file) plays the last ones.
    """
    source = locate(policy, "run")
    is_checkpoint = source.kind in (Kind.run, Kind.checkpoint)
    saved = check_checkpoint(source).get("lessons", {}) if is_checkpoint else {}
    return replace(env, params=params_at(env.params, saved.get("numbers", {}), missing=-1))


def _folder(path: Path, option: str) -> Source:
    numbered, best = checkpoints_in(path), path / FOLDER / BEST
    if numbered or best.is_file():
        return Source(Kind.run, path, option)

    whole = Path(os.path.abspath(path)) if path.name in ("", "..") else path  # "." has no name
    if whole.name == FOLDER and list(path.glob("*.pt")):  # a run's folder of checkpoints
        return Source(Kind.run, whole.parent, option)

    if list(path.glob(f"*{SUFFIX}")):
        return Source(Kind.onnx_folder, path, option)

    wanted = f"{FOLDER}/{BEST}, {FOLDER}/step_*.pt, *{SUFFIX}"
    raise ConfigError(
        f"{option}={path} holds no policy: that folder has none of {wanted}{_files(path)}{runs_below(path)}"
    )


def _files(folder: Path) -> str:
    names = sorted(path.name for path in folder.glob("*.pt"))[:5]
    return f"; it has {', '.join(names)}: name one of them" if names else ""


def _kind_of_file(path: Path, option: str, wanted: str) -> Kind:
    if not path.is_file():
        raise ConfigError(f"{option}={path} is no file: give {wanted}")

    if path.suffix.lower() == SUFFIX:
        return Kind.onnx
    if path.suffix == ".pt" or zipfile.is_zipfile(path):
        return Kind.checkpoint

    what = "empty" if path.stat().st_size == 0 else "neither a checkpoint nor an ONNX file"
    raise ConfigError(f"{option}={path} is {what}: give {wanted}")
