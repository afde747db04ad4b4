"""A page about runs, written into their folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mappo_unity.errors import ConfigError
from mappo_unity.reports.figure import check_place
from mappo_unity.reports.groups import run_names
from mappo_unity.reports.page import report_page
from mappo_unity.reports.reading import Run, read_runs
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.folder import find_run

PAGE = "report.html"
Diagnosis = Callable[[Sequence[Run], Sequence[str]], Sequence[dict[str, str]]]
"""Findings about runs, which have these names."""


def write_report(
    paths: Sequence[str], out: Path | None = None, diagnosis: Diagnosis | None = None
) -> tuple[Path, int]:
    """Write the page about the runs of folders; return its path and how many runs are in it.

    Args:
        paths: run folders, folders of runs.
        out: the page; None: report.html in the folder, where there is a single one.
        diagnosis: returns findings about the runs, as `report_page` takes them; None: the page has none.

    Raises:
        ConfigError: a path leads to no run with metrics, or the page cannot be written.
    """
    if out is None and len(paths) > 1:
        raise ConfigError(f"out= is not given: of {len(paths)} folders none is the page's own; out=FILE.html")

    runs, notes = read_runs(paths)
    top = Path(paths[0])
    if out is None:
        out = (find_run(top, "runs") if top.is_file() else top) / PAGE
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"out={out} must end in .html")
    check_place(out)

    env = dict.fromkeys(run.options["env.name"] for run in runs)
    named = top.resolve().name if len(paths) == 1 else f"{len(paths)} folders"
    try:
        findings = diagnosis(runs, run_names(runs)) if diagnosis is not None else []
        page = report_page(runs, f"{', '.join(env)}: {named}", notes, findings)
        # names of files need not be UTF-8
        write_atomically(out, page.encode(errors="backslashreplace"))
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written ({error.strerror or error})") from error
    return out, len(runs)
