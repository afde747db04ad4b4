"""Videos of run folders, put into a page whole, up to a size."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

from mappo_unity.reports.groups import run_names
from mappo_unity.reports.reading import Run

KINDS = {".mp4": "video/mp4", ".webm": "video/webm", ".gif": "image/gif"}
FILE_BYTES, ALL_BYTES = 8 << 20, 24 << 20
"""The largest video, and the most of all, that a page takes in."""


def video_section(runs: Sequence[Run]) -> str:
    """Return the videos that lie in the runs' folders, as HTML; those that are too large by their names."""
    shown, left, room = [], [], ALL_BYTES
    for run, name in zip(runs, run_names(runs)):
        for path in _videos(run.folder):
            label = f"{name}/{path.relative_to(run.folder).as_posix()}"
            size = path.stat().st_size
            if size > min(FILE_BYTES, room):
                left.append(f"{label} ({size / 2**20:.1f} MB)")
                continue
            room -= size
            shown.append(_figure(path, label))

    if not shown and not left:
        return ""
    note = f"<p>Too large for this page: {escape(', '.join(left))}.</p>" if left else ""
    return f"<section id='videos'><h2>Videos</h2>{''.join(shown)}{note}</section>"


def _videos(folder: Path) -> list[Path]:
    found = [*folder.glob("*"), *folder.glob("*/*")]
    return sorted(path for path in found if path.suffix.lower() in KINDS and path.is_file())


def _figure(path: Path, label: str) -> str:
    kind = KINDS[path.suffix.lower()]
    source = f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
    if kind.startswith("image/"):
        player = f"<img alt='{escape(label)}' src='{source}'>"
    else:
        player = f"<video controls loop muted playsinline preload='metadata' src='{source}'></video>"
    return f"<figure>{player}<figcaption>{escape(label)}</figcaption></figure>"
