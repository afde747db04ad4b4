"""Runs read from their folders, to be shown: options, metrics by column, versions, how they were started.

It only reads, runs that are being trained too, and runs of older versions as they are.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from mappo_unity.config.option_table import find_option, option_table, show_value
from mappo_unity.config.options_file import read_yaml
from mappo_unity.config.renamed import rename_keys
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.runs.folder import CONFIG, METRICS, OVERRIDES, VERSIONS, check_there, find_run, runs_below
from mappo_unity.runs.json_record import read_json
from mappo_unity.runs.metrics_csv import STEP, read_metrics

RESULT = "result.json"  # of a sweep's job
_DEPTH = 4  # folders below the one that is named in which runs are looked for


@dataclass(frozen=True)
class Run:
    """A run as its folder has it.

    Attributes: `options`, every option by its full name, as texts; `columns`, metrics by name, float64
    [rows], NaN where a row has none; `versions`; `starts`, date and command line of the start and each
    resumption; `result`, what a sweep notes of its job, else empty.
    """

    folder: Path
    options: dict[str, str]
    columns: dict[str, np.ndarray]
    versions: dict[str, Any]
    starts: list[dict[str, Any]]
    result: dict[str, Any]

    @property
    def metrics(self) -> list[str]:
        """The names of the metrics that have a number in some row."""
        return [name for name, column in self.columns.items() if np.isfinite(column).any()]


def read_runs(paths: Sequence[str], option: str = "runs") -> tuple[list[Run], list[str]]:
    """Return the runs of run folders, checkpoints and folders of runs, and notes about those left out.

    Raises:
        ConfigError: a path leads to no run, no run has metrics yet, or a file of one cannot be read.
    """
    folders = list(dict.fromkeys(folder for path in paths for folder in find_runs(Path(path), option)))
    runs = [read_run(folder) for folder in folders]
    empty = [run.folder for run in runs if not run.columns]

    if len(empty) == len(runs):
        names = ", ".join(str(folder) for folder in empty[:5])
        raise ConfigError(
            f"{names}: no metrics yet; {METRICS} is written after a run's first iteration, or the run ended "
            "before it"
        )
    return [run for run in runs if run.columns], [f"{folder}: no metrics, left out" for folder in empty]


def find_runs(path: Path, option: str) -> list[Path]:
    """Return the run folder that a path names, or those below it, sorted; raise ConfigError for none."""
    check_there(path, option)
    if path.is_file():
        return [find_run(path, option)]

    found = []
    for folder, below, files in os.walk(path):
        depth = len(Path(folder).relative_to(path).parts)
        # other programs have a config.yaml, too
        is_run = CONFIG in files and (VERSIONS in files or METRICS in files)
        if is_run:
            found.append(Path(folder))
        below[:] = [] if is_run or depth == _DEPTH else sorted(below)

    if not found:
        raise ConfigError(
            f"{option}={path} is no run folder, and there is none below it: a run folder holds {CONFIG} and "
            f"{METRICS}{runs_below(path.parent)}"
        )
    return sorted(found, key=_by_numbers)


def read_run(folder: Path) -> Run:
    """Return the run of a folder, with no columns where it has no metrics yet; raise ConfigError."""
    return Run(
        folder,
        _options(folder / CONFIG),
        _columns(folder / METRICS),
        read_json(folder / VERSIONS),
        _starts(folder / OVERRIDES),
        read_json(folder / RESULT),
    )


@cache
def default_options() -> dict[str, str]:
    """Return the default of every option, as a text."""
    table = option_table(Config)
    return {key: show_value(option.default) for key, option in table.items() if not option.is_section}


def _columns(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        return {}
    try:
        rows = read_metrics(path)
    except (ValueError, OSError) as error:
        raise ConfigError(f"{path} cannot be read ({error})") from error

    names = list(dict.fromkeys(name for row in rows for name in row))
    if rows and STEP not in names:
        raise ConfigError(f"{path} is no table of metrics: there is no column {STEP}")
    return {name: np.array([row.get(name, np.nan) for row in rows], float) for name in names}


def _options(path: Path) -> dict[str, str]:
    saved = read_yaml(path)
    if not isinstance(saved, dict):
        raise ConfigError(f"{path} holds no options")

    # an older run lacks the newest options: it was trained as their defaults say
    return default_options() | _flat(rename_keys(saved), "")


def _flat(value: dict[Any, Any], prefix: str) -> dict[str, str]:
    flat: dict[str, str] = {}
    for name, item in value.items():
        key = f"{prefix}{name}"
        option = find_option(option_table(Config), key)
        is_inner = option is None or option.is_section or option.is_open
        if isinstance(item, dict) and item and is_inner:
            flat |= _flat(item, f"{key}.")
        else:
            flat[key] = show_value(item)
    return flat


def _starts(path: Path) -> list[dict[str, Any]]:
    try:
        found = OmegaConf.to_container(OmegaConf.load(path))
    except Exception:  # whatever a damaged file makes YAML raise
        return []
    starts = found if isinstance(found, list) else []
    return [start for start in starts if isinstance(start, dict) and isinstance(start.get("overrides"), list)]


def _by_numbers(path: Path) -> tuple[tuple[bool, int, str], ...]:
    """Sort job 10 of a sweep behind job 9."""
    return tuple((not part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in path.parts)
