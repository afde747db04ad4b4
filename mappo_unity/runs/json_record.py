"""JSON files of records: of a run, which shows and plays without them; of what goes on in a folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mappo_unity.errors import ConfigError


def read_json(path: Path) -> dict[str, Any]:
    """Return what a file holds; nothing where it is missing, damaged or no mapping."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def record_to_resume(folder: Path, name: str, kind: str) -> dict[str, Any] | None:
    """Return the record of what goes on in the folder that is given as `out`, None where it may begin.

    Args:
        folder: for the results.
        name: of the record in it.
        kind: what it is a record of, for messages: "league".

    Raises:
        ConfigError: it is no folder, holds something else, or its record is damaged.
    """
    record = folder / name
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"out={folder} is a file: give a folder for the results")
    if not record.is_file():
        if folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir()):
            raise ConfigError(f"out={folder} is not empty and holds no {kind}: give a new folder")
        return None

    saved = read_json(record)
    if not saved:
        raise ConfigError(f"{record} is no record of a {kind} any more: give a new folder as out")
    return saved
