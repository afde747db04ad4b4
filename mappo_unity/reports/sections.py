"""What a page says in words and tables: outcome, timing, options, versions, findings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from html import escape
from typing import Any

import numpy as np

from mappo_unity.reports.document import table
from mappo_unity.reports.groups import run_names, set_apart, varied
from mappo_unity.reports.reading import CONFIG, METRICS, Run, default_options

_COPIED_S = 60
"""Between a start and the date of its config.yaml: where more seconds lie, the folder was copied."""


def outcome(runs: Sequence[Run]) -> str:
    """Return how the runs ended, or how far they are; of several a table, best first, with their options."""
    keys, values = set_apart(runs)
    extras = [
        (metric, title)
        for metric, title in (("Self-play/ELO", "Elo"), ("rating", "rating"))
        if any(metric in run.metrics for run in runs)
    ]
    heads = ["return", "best return", "at decision", "status", "decisions", "time", "decisions/s"]
    heads += [title for _, title in extras]
    figures = [[*_outcome(run), *(figure(last(run, metric)) for metric, _ in extras)] for run in runs]
    if len(runs) == 1:
        facts = (
            f"<div><dt>{head}</dt><dd>{escape(cell)}</dd></div>" for head, cell in zip(heads, figures[0])
        )
        return f"<dl class='facts'>{''.join(facts)}</dl>"

    # the options beside the return, which they are read with
    rows = [
        [name, row[0], *(one[key] for key in keys), *row[1:]]
        for name, one, row in zip(run_names(runs), values, figures)
    ]
    heads = ["run", heads[0], *keys, *heads[1:]]
    order = sorted(range(len(runs)), key=lambda number: _from_best(runs[number]))
    return table(heads, [rows[number] for number in order], 1)


def timing(runs: Sequence[Run]) -> str:
    """Return where the time went: seconds and shares, a row a run."""
    rows = []
    for run, name in zip(runs, run_names(runs)):
        collect, update, rest = (seconds(run)[part] for part in ("collect", "update", "rest"))
        whole = sum(part for part in (collect, update, rest) if math.isfinite(part))
        shares = [
            f"{duration(part)} ({100 * part / whole:.0f} %)" if math.isfinite(part) and whole > 0 else "-"
            for part in (collect, update, rest)
        ]
        rows.append([name, *shares])
    note = (
        "<p>Collect: playing the environment, or waiting for those who do. Update: learning. Rest: start, "
        "matches, checkpoints, writing; known of runs that were started once, in the folder they were "
        "trained in.</p>"
    )
    return table(["run", "collect", "update", "rest"], rows, 1) + note


def options(runs: Sequence[Run]) -> str:
    """Return the options that differ from the defaults or between runs, with all values that they have."""
    defaults, keys = default_options(), set(varied([run.options for run in runs]))
    shown = [
        key
        for key in dict.fromkeys(key for run in runs for key in run.options)
        if key in keys or runs[0].options.get(key) != defaults.get(key)
    ]
    rows = []
    for key in shown:
        values = dict.fromkeys(run.options.get(key, "-") for run in runs)
        rows.append([key, ", ".join(values), defaults.get(key, "-")])
    return table(["option", "value", "default"], rows, 3)


def command_lines(runs: Sequence[Run]) -> str:
    """Return how each run was started and resumed."""
    rows = [
        [name, " ".join(map(str, start["overrides"])), str(start.get("date", ""))[:16].replace("T", " ")]
        for run, name in zip(runs, run_names(runs))
        for start in run.starts
    ]
    return table(["run", "options given", "date"], rows, 2)


def versions(runs: Sequence[Run]) -> str:
    """Return what the runs were trained with; several values where runs differ."""
    names = dict.fromkeys(name for run in runs for name in run.versions)
    rows = [[name, ", ".join(dict.fromkeys(str(run.versions.get(name)) for run in runs))] for name in names]
    return table(["package", "version"], rows, 2)


def findings(records: Sequence[Mapping[str, Any]]) -> str:
    """Return findings of a diagnosis as a list: each has a text, and may have evidence and a cure."""
    items = []
    for record in records:
        lines = [f"<strong>{escape(str(record['text']))}</strong>"]
        lines += [escape(str(record[key])) for key in ("evidence", "cure") if record.get(key)]
        items.append(f"<li>{'<br>'.join(lines)}</li>")
    return f"<ul class='findings'>{''.join(items)}</ul>"


def status(run: Run) -> str:
    """Return how a run ended: as its sweep notes it, unless it was resumed since; else by its decisions."""
    done, wanted = last(run, "agent_steps"), run.options.get("max_steps", "")
    noted = run.result.get("agent_steps")
    is_older = isinstance(noted, (int, float)) and done > noted
    if "status" in run.result and not is_older:
        return str(run.result["status"])
    if not wanted.isdigit():
        return "-"
    # a run that is being trained, was interrupted or has reached its return: its files do not say which
    return "finished" if done >= int(wanted) else f"{100 * done / int(wanted):.0f} % of {amount(int(wanted))}"


def seconds(run: Run) -> dict[str, float]:
    """Return the seconds of collecting and learning, and of the rest, NaN where it is not known."""
    parts = {}
    for part in ("collect", "update"):
        column = run.columns.get(f"{part}_s", np.empty(0))
        parts[part] = float(column[np.isfinite(column)].sum())
    parts["rest"] = _elapsed(run) - parts["collect"] - parts["update"]
    return parts if parts["rest"] >= 0 else {**parts, "rest": math.nan}


def last(run: Run, metric: str) -> float:
    """Return the newest number of a metric, NaN without one."""
    column = run.columns.get(metric, np.empty(0))
    there = column[np.isfinite(column)]
    return float(there[-1]) if len(there) else math.nan


def amount(value: float) -> str:
    """Return a count with thousands apart."""
    return f"{value:,.0f}" if math.isfinite(value) else "-"


def figure(value: float) -> str:
    """Return a figure with four significant digits."""
    if not math.isfinite(value):
        return "-"
    return f"{value:,.1f}" if abs(value) >= 1000 else f"{value:.4g}"


def duration(value: float) -> str:
    """Return seconds as 41 s, 5:03 min or 2:05 h."""
    if not math.isfinite(value):
        return "-"
    if value < 60:
        return f"{value:.3g} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes}:{rest:02} min" if minutes < 60 else f"{minutes // 60}:{minutes % 60:02} h"


def _elapsed(run: Run) -> float:
    """Return the seconds from a run's start to its last row, by its files' dates; NaN where these lie."""
    try:
        (start,) = run.starts  # a resumed run stood still in between
        begun = datetime.fromisoformat(str(start["date"])).timestamp()
        if abs((run.folder / CONFIG).stat().st_mtime - begun) > _COPIED_S:
            return math.nan
        return (run.folder / METRICS).stat().st_mtime - begun
    except (OSError, ValueError, KeyError):
        return math.nan


def _outcome(run: Run) -> list[str]:
    steps, wall_s = last(run, "agent_steps"), last(run, "wall_s")
    best, at = _best(run)
    rate = steps / wall_s if wall_s > 0 else math.nan
    returns = [figure(last(run, "return_mean")), figure(best), amount(at)]
    return [*returns, status(run), amount(steps), duration(wall_s), amount(rate)]


def _from_best(run: Run) -> float:
    mean = last(run, "return_mean")
    return math.inf if math.isnan(mean) else -mean


def _best(run: Run) -> tuple[float, float]:
    """Return the highest mean return of a full window, where there was one, and the decisions then.

    A window of the first few episodes to end holds the lucky ones (`RecentEpisodes.score`).
    """
    column = run.columns.get("return_mean", np.empty(0))
    if not np.isfinite(column).any():
        return math.nan, math.nan

    text = run.options.get("log.return_window", "1")
    window = float(text) if text.isdecimal() else 1.0
    is_full = run.columns.get("episodes", np.full(len(column), math.inf)) >= window
    if np.isfinite(column[is_full]).any():
        column = np.where(is_full, column, math.nan)
    row = int(np.nanargmax(column))
    return float(column[row]), float(run.columns["agent_steps"][row])
