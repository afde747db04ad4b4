"""Runs as one page of HTML that holds everything it shows: tables as text, curves as data for its script.

`page.js` draws the curves; `page.css` is its style. The page of a run that is being trained is the same, and
asks its own server for what is new.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from mappo_unity.reports import sections
from mappo_unity.reports.data import as_json, page_data, stride
from mappo_unity.reports.document import document
from mappo_unity.reports.groups import group_runs
from mappo_unity.reports.parallel import parallel_coordinates
from mappo_unity.reports.reading import Run
from mappo_unity.reports.videos import video_section

_HERE = Path(__file__).parent
_WITHOUT_SCRIPT = (
    "<noscript><p>The curves need JavaScript; mappo-plot draws them as a picture.</p></noscript>"
)


def report_page(
    runs: Sequence[Run], title: str, notes: Sequence[str] = (), findings: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Return the page about runs.

    Args:
        runs: with metrics.
        title: of the page.
        notes: lines for the reader, such as what was left out.
        findings: of a diagnosis, each with text, evidence and cure; none: no such section.
    """
    content = page_content(runs)
    return _page(title, content, [*notes, *_thinned(runs)], findings, video_section(runs), live=False)


def live_page(title: str) -> str:
    """Return the page that asks its server for everything it shows."""
    return _page(title, {"sections": {}, "data": None}, [], [], "", live=True)


def page_content(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the tables of a page, as HTML by section, and the data of its curves."""
    groups = group_runs(runs)
    texts = {
        "outcome": sections.outcome(runs),
        "sweep": parallel_coordinates(runs) if len(groups) > 1 else "",
        "timing": sections.timing(runs),
        "options": sections.options(runs),
        "starts": sections.command_lines(runs),
        "versions": sections.versions(runs),
    }
    return {"sections": texts, "data": page_data(runs, groups)}


def _page(
    title: str,
    content: Mapping[str, Any],
    notes: Sequence[str],
    findings: Sequence[Mapping[str, Any]],
    videos: str,
    live: bool,
) -> str:
    def section(name: str, heading: str) -> str:
        text = content["sections"].get(name, "")
        hidden = "" if text else " hidden"
        return f"<section id='{name}'{hidden}><h2>{heading}</h2><div>{text}</div></section>"

    diagnosis = f"<section id='findings'><h2>Diagnosis</h2>{sections.findings(findings)}</section>"
    parts = [
        f"<h1>{escape(title)}</h1>",
        "<p id='state' role='status'></p>" if live else "",
        *(f"<p>{escape(note)}</p>" for note in notes),
        section("outcome", "Outcome"),
        diagnosis if findings else "",
        f"<section id='curves'><h2>Curves</h2>{_WITHOUT_SCRIPT}</section>",
        videos,
        section("sweep", "Options and return"),
        section("timing", "Where the time went"),
        section("options", "Options"),
        section("starts", "Command lines"),
        section("versions", "Versions"),
        f"<script type='application/json' id='data'>{as_json(content['data'])}</script>",
    ]
    style, script = ((_HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    return document(title, [part for part in parts if part], style, script, live)


def _thinned(runs: Sequence[Run]) -> list[str]:
    every = stride(runs)
    return [f"The curves show one row in {every} of metrics.csv, and the last."] if every > 1 else []
