"""Run folders: made without collisions, and the record of how a run came about.

The record: config.yaml (every option), overrides.yaml (the command lines with their dates), versions.json.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mappo_unity.config.overrides import shell_argument
from mappo_unity.config.schema import Config
from mappo_unity.config.user_modules import folder_of
from mappo_unity.errors import ConfigError
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.checkpoint_file import POOL, checkpoints_in, newest_good
from mappo_unity.runs.json_record import read_json
from mappo_unity.runs.lock import LOCK, locked
from mappo_unity.runs.versions import read_versions

CONFIG, OVERRIDES, VERSIONS = "config.yaml", "overrides.yaml", "versions.json"
RECORD = (CONFIG, OVERRIDES, VERSIONS)
FACTORY_FOLDER = "factory_folder"  # in versions.json
PLAYERS, LOGS = "players", "run_logs"  # folders of their logs, the latter of mappo-learn, as ML-Agents has it
METRICS, EVENTS = "metrics.csv", "tensorboard"  # logs, the latter a folder


@dataclass(frozen=True)
class NewFolder:
    """A folder made for a run, and the folders above it that had to be made (outermost first)."""

    path: Path
    made: tuple[Path, ...] = ()


def create_folder(wanted: Path, exact: bool = False) -> NewFolder:
    """Make a folder that nobody else has: the wanted name, or that with _1, _2 ... behind it.

    With `exact` (the user named it) the folder may exist if it is empty, and no other name will do.
    Raises ConfigError where it cannot be made or written.
    """
    parents: list[Path] = []
    try:
        parents += [parent for parent in reversed(wanted.parents) if not parent.exists()]
        wanted.parent.mkdir(parents=True, exist_ok=True)
        folder = NewFolder(_claim(wanted, exact), tuple(parents))
        # A folder that was there may refuse files.
        probe = folder.path / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        # Leave nothing behind; a parent that others use by now is not empty and stays.
        for parent in reversed(parents):
            with suppress(OSError):
                parent.rmdir()
        reason = error.strerror or error
        raise ConfigError(
            f"the output folder {wanted} cannot be made or written ({reason}: {error.filename}); "
            "output_dir=FOLDER sets another place"
        ) from error

    return folder


def discard_folder(folder: NewFolder, reason: BaseException | None = None) -> None:
    """Remove the folder of a run that completed no iteration, unless it holds more than the record.

    Logs without a row, and a pool, are no more, nor are players' logs, unless the `reason` told names one.
    """
    logs = [path for path in (folder.path / PLAYERS, folder.path / LOGS) if path.is_dir()]
    if any(str(path) in str(reason) for path in logs) or _other_files(folder.path):
        return

    shutil.rmtree(folder.path, ignore_errors=True)  # it may be gone already
    for parent in reversed(folder.made):
        with suppress(OSError):
            parent.rmdir()


def write_record(folder: Path, config: Config, lines: list[str]) -> None:
    """Write config.yaml and versions.json, and add the command line to overrides.yaml.

    `resume` is left out of config.yaml: it says how a run was called, not what it is. versions.json also says
    in which folder the module of env.factory was found.
    """
    lasting = replace(config, resume=None)
    history = _history(folder / OVERRIDES)
    versions = read_versions()

    # Resuming may start in another folder, where the module would not be found.
    if config.env.factory is not None:
        versions[FACTORY_FOLDER] = str(folder_of(config.env.factory) or "") or None
    history.append({"date": datetime.now().astimezone().isoformat(timespec="seconds"), "overrides": lines})

    # config.yaml last: a folder that has one counts as a run (`find_run`).
    try:
        write_atomically(folder / OVERRIDES, OmegaConf.to_yaml(OmegaConf.create(history)).encode())
        write_atomically(folder / VERSIONS, (json.dumps(versions, indent=2) + "\n").encode())
        write_atomically(folder / CONFIG, OmegaConf.to_yaml(OmegaConf.structured(lasting)).encode())
    except OSError as error:
        raise ConfigError(f"the run folder {folder} cannot be written ({error.strerror or error})") from error


@dataclass(frozen=True)
class Record:
    """The record of a run as it was, and the checkpoints that it had (size in bytes, time in ns)."""

    files: dict[str, bytes]
    checkpoints: dict[Path, tuple[int, int]]


def read_record(folder: Path) -> Record:
    """Return the record of a run, to be put back by `restore_record`."""
    files = {name: (folder / name).read_bytes() for name in RECORD if (folder / name).is_file()}
    return Record(files, _state_of(checkpoints_in(folder)))


def restore_record(folder: Path, record: Record) -> None:
    """Put the record back, unless a checkpoint was written: then what it was trained with stays written."""
    if not _state_of(checkpoints_in(folder)).items() <= record.checkpoints.items():
        return

    for name in RECORD:
        if name in record.files:
            write_atomically(folder / name, record.files[name])
        else:
            (folder / name).unlink(missing_ok=True)


def checkpoint_of_job(folder: Path) -> Path | None:
    """Return the checkpoint from which a job that is started again goes on.

    A job that was ended before its first one begins anew: what it logged counts no more.
    """
    if checkpoints_in(folder):
        return newest_good(folder)[0]
    (folder / METRICS).unlink(missing_ok=True)
    return None


def find_run(path: Path, option: str) -> Path:
    """Return the run folder of a run folder or of a checkpoint file in it.

    Raises ConfigError, naming the option, where there is none.
    """
    check_there(path, option)

    whole = Path(os.path.abspath(path))  # the path may be given from inside a run's folder
    levels = 1 if path.is_dir() else 3  # of a run's folder only that of its checkpoints is as good as itself
    above = [*path.parents][:levels] + [*whole.parents][:levels]

    for folder in [path, *above]:
        if (folder / CONFIG).is_file():
            return folder

    if path.is_file():
        raise ConfigError(
            f"{option}={path} lies in no run folder: there is no {CONFIG} beside it or above, which says how "
            f"the run was trained{runs_below(path.parent)}"
        )
    raise ConfigError(
        f"{option}={path} is neither a run folder nor a checkpoint in one: no {CONFIG} there"
        f"{runs_below(path)}"
    )


def runs_below(folder: Path, count: int = 5) -> str:
    """Return "; newest runs below ..." with the newest runs in a folder, or an empty text."""
    if not folder.is_dir() or folder.resolve() == folder.resolve().parent:  # nobody keeps runs in /
        return ""

    found: list[Path] = []
    with suppress(OSError):  # a folder that may not be read, or goes while it is
        for pattern in ("*", "*/*", "*/*/*", "*/*/*/*"):
            found += [path.parent for path in folder.glob(f"{pattern}/{CONFIG}")]

    # Other programs have a config.yaml, too.
    found = [path for path in found if (path / VERSIONS).is_file()]
    newest = sorted(found, key=lambda path: (path / CONFIG).stat().st_mtime, reverse=True)[:count]
    return f"; newest runs below {folder}: {', '.join(map(str, newest))}" if newest else ""


def check_there(path: Path, option: str, wanted: str = "") -> None:
    """Raise ConfigError if nothing is at a path that an option names, or it cannot be looked at.

    `wanted` is added to "does not exist", before the runs near it.
    """
    try:
        path.stat()
    except FileNotFoundError as error:
        if path.is_symlink():
            raise ConfigError(
                f"{option}={path} is a symbolic link to {os.readlink(path)}, which does not exist"
            ) from error

        near = path.parent
        while not near.exists():
            near = near.parent
        if Path.cwd() != near.resolve() and Path.cwd().is_relative_to(near.resolve()):
            near = Path()  # not half the disk

        raise ConfigError(f"{option}={path} does not exist{wanted}{runs_below(near)}") from error
    except OSError as error:
        circle = "it is a symbolic link that leads in a circle"
        reason = circle if error.errno == errno.ELOOP else error.strerror
        raise ConfigError(f"{option}={path} cannot be opened: {reason}") from error


def factory_folder(folder: Path) -> Path | None:
    """Return the folder in which a run found the module of env.factory; None: its record does not say."""
    found = read_json(folder / VERSIONS).get(FACTORY_FOLDER)
    return Path(found) if isinstance(found, str) and found else None


def _claim(wanted: Path, exact: bool) -> Path:
    if exact:
        wanted.mkdir(exist_ok=True)
        if any(wanted.iterdir()) and not _clear_unbegun(wanted):
            raise ConfigError(
                f"the folder {wanted} is not empty, and nothing is overwritten: "
                f"name another one, or resume the run in it with {shell_argument('resume', wanted)}"
            )
        return wanted

    # Making it is the claim: of runs that start at once one gets the name.
    for count in range(10_000):
        path = wanted.with_name(f"{wanted.name}_{count}") if count else wanted
        try:
            path.mkdir()
            return path
        except FileExistsError:
            continue

    raise ConfigError(f"the output folder {wanted} and 10,000 names like it are taken")


def _history(path: Path) -> list[Any]:
    if not path.is_file():
        return []

    try:
        history = OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:
        raise ConfigError(f"{path} cannot be read ({error})") from error

    return history if isinstance(history, list) else []


def is_unbegun(folder: Path) -> bool:
    """Return whether a folder is that of a run that ended before its first iteration was complete."""
    return all((folder / name).is_file() for name in RECORD) and not _other_files(folder)


def _clear_unbegun(folder: Path) -> bool:
    """Empty a folder if it `is_unbegun`; tell whether."""
    if not is_unbegun(folder):
        return False

    # Another process may be about to complete it.
    with locked(folder) as warning:
        if warning is not None:
            return False
        for path in folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != LOCK:
                path.unlink()
    return True


def _other_files(folder: Path) -> dict[Path, tuple[int, int]]:
    """Return what a run's folder holds beside its record, and logs and pool of one without an iteration."""
    has_rows = bool(_line_after_first(folder / METRICS))
    no_work = (*RECORD, LOCK) if has_rows else (*RECORD, LOCK, METRICS)
    no_folders = (PLAYERS, LOGS) if has_rows else (PLAYERS, LOGS, EVENTS, POOL)

    found = (path for path in folder.rglob("*") if path.is_file() and path.name not in no_work)
    return _state_of(path for path in found if path.relative_to(folder).parts[0] not in no_folders)


def _line_after_first(path: Path) -> str:
    if not path.is_file():
        return ""
    with path.open(encoding="utf-8", errors="replace") as file:
        file.readline()
        return file.readline()


def _state_of(files: Iterable[Path]) -> dict[Path, tuple[int, int]]:
    return {path: (path.stat().st_size, path.stat().st_mtime_ns) for path in files}
