"""Runs that differ only in their seed are one group; its label names what sets it apart from the others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mappo_unity.config.behavior_lines import dotted_options
from mappo_unity.reports.reading import Run

_MOST = 4  # options in a label
_APART = ("seed", "output_dir", "resume")
"""Options in which runs of a group may differ; beside them those of the log that change no number."""


@dataclass(frozen=True)
class Group:
    """Runs that differ only in their seed, and what a legend calls them."""

    label: str
    runs: list[Run]


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Return the groups, in the order of their first runs.

    A label names the options in which groups differ: those given on command lines where these tell the groups
    apart (a recipe is one word there), else all; folders where they are more than a legend holds.
    """
    members: dict[tuple[tuple[str, str], ...], list[Run]] = {}
    for run in runs:
        kept = {key: value for key, value in run.options.items() if counts(key)}
        members.setdefault(tuple(sorted(kept.items())), []).append(run)

    groups = list(members.values())
    return [Group(label, group) for label, group in zip(_labels([group[0] for group in groups]), groups)]


def counts(key: str) -> bool:
    """Return whether runs that differ in this option are of different groups."""
    return key not in _APART and (not key.startswith("log.") or key == "log.return_window")


def varied(options: Sequence[dict[str, str]]) -> list[str]:
    """Return the keys whose values differ, in the order in which they come first."""
    keys = dict.fromkeys(key for one in options for key in one)
    return [key for key in keys if len({one.get(key, "") for one in options}) > 1]


def given_options(run: Run) -> dict[str, str]:
    """Return the options that a run was started with, as they were typed; hydra's own are left out."""
    options: dict[str, str] = {}
    for line in run.starts[0]["overrides"] if run.starts else []:
        options |= dotted_options(str(line).lstrip("+"))
    return {key: value for key, value in options.items() if not key.startswith(("hydra.", "hydra/"))}


def set_apart(runs: Sequence[Run]) -> tuple[list[str], list[dict[str, str]]]:
    """Return the options given to runs in which they differ, but not the seed, and each run's values."""
    given = [{key: value for key, value in given_options(run).items() if counts(key)} for run in runs]
    keys = dict.fromkeys(key for one in given for key in one)
    # as the run took it, where it is an option and no choice of presets: 1e-3 and 0.001 are one value
    values = [
        {key: run.options.get(key, one.get(key, "default")) for key in keys} for run, one in zip(runs, given)
    ]
    return varied(values), values


def run_names(runs: Sequence[Run]) -> list[str]:
    """Return the runs' folders, without what all of their paths begin with."""
    if len(runs) == 1:
        return [runs[0].folder.resolve().name]
    paths = [str(run.folder.resolve()) for run in runs]
    top = os.path.commonpath(paths)
    return [Path(os.path.relpath(path, top)).as_posix() for path in paths]


def _labels(firsts: Sequence[Run]) -> list[str]:
    if len(firsts) == 1:
        return [firsts[0].options.get("env.name", "run")]

    keys, values = set_apart(firsts)
    texts = _texts(keys, values)
    if not _tells_apart(texts, keys):
        keys = [key for key in varied([run.options for run in firsts]) if counts(key)]
        texts = _texts(keys, [run.options for run in firsts])

    return texts if _tells_apart(texts, keys) else run_names(firsts)


def _texts(keys: Sequence[str], options: Sequence[dict[str, str]]) -> list[str]:
    return [", ".join(f"{key}={one.get(key, '-')}" for key in keys) for one in options]


def _tells_apart(texts: Sequence[str], keys: Sequence[str]) -> bool:
    return len(set(texts)) == len(texts) and len(keys) <= _MOST
