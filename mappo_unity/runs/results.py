"""ML-Agents' folder of results: which run may be written, and the files beside ours that its users know.

``results/RUN/`` is a run folder of ours with configuration.yaml, BEHAVIOR.onnx and run_logs/ in it.
"""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from mappo_unity import keys
from mappo_unity.config.per_behavior import init_source
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.checkpoint_file import FOLDER, read_plain
from mappo_unity.runs.folder import CONFIG, LOGS, METRICS, is_unbegun
from mappo_unity.runs.lock import locked
from mappo_unity.runs.metrics_csv import read_metrics

CONFIGURATION = "configuration.yaml"
_SUFFIX = ".onnx"


def check_place(folder: Path, resume: bool, force: bool) -> None:
    """Raise ConfigError, with ML-Agents' advice, where a run exists and none is wanted, or the reverse."""
    is_run = (folder / CONFIG).is_file()
    if resume and not is_run:
        trained = (folder / CONFIGURATION).is_file()
        other = (
            "mlagents-learn trained there, whose .pt files this trainer cannot go on with; "
            if trained
            else ""
        )
        raise ConfigError(
            f"no run to resume in {folder}: {other}leave --resume out to start a run, or "
            "--initialize-from=RUN to begin with another one's networks"
        )

    is_taken = not resume and folder.is_dir() and any(folder.iterdir())
    # what a first start left that failed is emptied by the run that begins there
    if is_taken and not force and not is_unbegun(folder):
        raise ConfigError(
            f"{folder} holds a previous run: give another --run-id, --resume to go on with it, or --force to "
            "replace it"
        )

    # --force is for runs, not for whatever else may lie there
    if is_taken and force:
        if not is_run and not (folder / CONFIGURATION).is_file():
            raise ConfigError(f"{folder} holds no run that --force could replace: give another --run-id")


def check_beginning(folder: Path, config: Config) -> None:
    """Raise ConfigError where a new run is to begin with networks that lie in the run that it replaces."""
    starts = [("init_from", config.init_from), *(init_source(config, name) for name in config.behaviors)]
    for option, source in starts:
        path = Path(source or "").resolve()
        if source is not None and folder.resolve() in (path, *path.parents):
            raise ConfigError(
                f"{option}={source} lies in {folder}, which the new run replaces: give another --run-id"
            )


def check_playable(folder: Path) -> None:
    """Raise ConfigError where there is no run that could be played."""
    if not (folder / CONFIG).is_file():
        trained = (folder / CONFIGURATION).is_file()
        other = "mlagents-learn trained there, whose .pt files this trainer cannot read; " if trained else ""
        raise ConfigError(
            f"no run to play in {folder}: {other}give the --run-id of one, or leave --inference out to train"
        )


@contextmanager
def replaced(folder: Path, force: bool) -> Iterator[None]:
    """Set a run that is to be replaced aside; it comes back if the new one trains nothing.

    Raises ConfigError where another process trains in it.
    """
    if not force or not folder.is_dir():
        yield
        return

    with locked(folder):
        pass
    old = _aside(folder)
    shutil.rmtree(old, ignore_errors=True)  # of a replacement that had learnt something when it was killed
    folder.rename(old)
    try:
        yield
    finally:
        if _has_trained(folder):
            shutil.rmtree(old, ignore_errors=True)
        else:
            if (folder / LOGS).is_dir():  # a message may name a log that says why nothing was learnt
                shutil.copytree(folder / LOGS, old / LOGS, dirs_exist_ok=True)
            shutil.rmtree(folder, ignore_errors=True)
            old.rename(folder)


def bring_back(folder: Path) -> None:
    """Bring a run back that `replaced` set aside for one that was killed before it had learnt anything.

    Raises ConfigError where another process trains in its place.
    """
    old = _aside(folder)
    if not old.is_dir() or _has_trained(folder):
        return

    if folder.is_dir():
        with locked(folder):
            pass
        shutil.rmtree(folder)
    old.rename(folder)


def _aside(folder: Path) -> Path:
    return folder.with_name(f".{folder.name}.replaced")


def _has_trained(folder: Path) -> bool:
    return any((folder / FOLDER).glob("*.pt"))


def write_configuration(folder: Path, configuration: Mapping[str, Any]) -> None:
    """Write configuration.yaml: ML-Agents' settings with all their defaults."""
    text = yaml.safe_dump(dict(configuration), sort_keys=False, allow_unicode=True)
    write_atomically(folder / CONFIGURATION, text.encode())


def read_configuration(folder: Path) -> dict[str, Any]:
    """Return what `write_configuration` wrote for a run; nothing where it is missing or cannot be read."""
    try:
        found = yaml.safe_load((folder / CONFIGURATION).read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return {}
    return found if isinstance(found, dict) else {}


def publish(
    folder: Path, checkpoint: Path | None, policies: Sequence[str], reward: float, steps: int
) -> list[Path]:
    """Put the last checkpoint's ONNX files where ML-Agents has them, and write training_status.json.

    Args:
        folder: of the run.
        checkpoint: the last one; None: there is none, and nothing is done.
        policies: names of the behaviors.
        reward: mean return of recent episodes.
        steps: agent decisions of the run.

    Returns:
        The files ``folder/BEHAVIOR.onnx``.
    """
    if checkpoint is None:
        return []

    written, status = [], {}
    for policy in policies:
        source = _final_file(checkpoint, policy)
        if source is None:  # no ONNX file could be written, which has been said
            continue

        last = Path(policy).name  # a behavior may be called "Game/Walker"
        newest, named = folder / f"{policy}{_SUFFIX}", folder / policy / f"{last}-{steps}{_SUFFIX}"
        named.parent.mkdir(parents=True, exist_ok=True)
        for path in (newest, named):
            write_atomically(path, source.read_bytes())
        written.append(newest)

        entry = {
            "steps": steps,
            "file_path": str(named),
            "reward": None if math.isnan(reward) else reward,
            "creation_time": time.time(),
            "auxillary_file_paths": [str(checkpoint)],  # spelt as ML-Agents does
        }
        status[policy] = {"checkpoints": [entry], "final_checkpoint": entry | {"file_path": str(newest)}}

    if not status:  # what an earlier end of the run wrote stays
        return []

    (folder / LOGS).mkdir(exist_ok=True)
    text = json.dumps({**status, "metadata": {"trainer": "mappo-unity"}}, indent=2)
    write_atomically(folder / LOGS / "training_status.json", f"{text}\n".encode())
    return written


def publish_late(folder: Path, checkpoint: Path) -> list[Path]:
    """Publish what a run that is over has not, since it was broken off at its very end.

    Args:
        folder: of the run.
        checkpoint: the last one.

    Returns:
        The files ``folder/BEHAVIOR.onnx``; none where they stand as they are to be.
    """
    state = read_plain(checkpoint)
    policies = list(state["learners"])
    if all(_is_published(folder, policy, _final_file(checkpoint, policy)) for policy in policies):
        return []

    rows = read_metrics(folder / METRICS)
    reward = rows[-1]["return_mean"] if rows else math.nan
    return publish(folder, checkpoint, policies, float(reward), state["agent_steps"])


def _final_file(checkpoint: Path, policy: str) -> Path | None:
    """Return the ONNX file of a behavior in which a run ended, where there is one."""
    stem = keys.file_stem(policy)  # of "My Behavior" My_Behavior
    found = [checkpoint.with_name(name) for name in (f"final_{stem}{_SUFFIX}", f"final{_SUFFIX}")]
    return next((path for path in found if path.is_file()), None)


def _is_published(folder: Path, policy: str, source: Path | None) -> bool:
    newest = folder / f"{policy}{_SUFFIX}"
    return source is None or (newest.is_file() and newest.read_bytes() == source.read_bytes())
