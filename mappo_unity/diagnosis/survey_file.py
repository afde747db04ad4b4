"""survey.json in a run's folder: what its batches held, by policy name; read without torch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.json_record import read_json

FILE = "survey.json"


def write_survey(folder: Path, facts: dict[str, Any]) -> None:
    """Write it in one piece; raise OSError where it cannot be."""
    write_atomically(folder / FILE, json.dumps(facts, indent=1).encode())


def read_survey(folder: Path) -> dict[str, Any]:
    """Return what it says by policy name; nothing where it is missing or damaged."""
    found = read_json(folder / FILE)
    is_whole = all(isinstance(facts, dict) and "decisions" in facts for facts in found.values())
    return found if is_whole else {}
