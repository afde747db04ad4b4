"""scripts/score_table.py and the scripts that train as it does: what is written of a run, what is resumed."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import learn_scene
import score_table
from score_measures import Measure, mean_return


def test_rows_are_appended_all_or_none(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    learn_scene.append(path)
    assert not path.exists()

    learn_scene.append(path, {"scene": "a, b", "value": 1}, {"scene": "c", "value": 2})
    learn_scene.append(path, {"scene": "d", "value": 3})
    with pytest.raises(ValueError, match="unknown"):
        learn_scene.append(path, {"scene": "e", "value": 4}, {"scene": "f", "unknown": 5})
    assert path.read_bytes() == b'scene,value\r\n"a, b",1\r\nc,2\r\nd,3\r\n'


def test_a_curve_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(score_table, "CURVES", tmp_path / "curves.csv")
    measure = Measure("Probe", "return", mean_return, 0.5)
    rows: list[dict[str, Any]] = [
        {"agent_steps": 100 * n, "episodes": 100 * n, "wall_s": 60.0 * n, "return_mean": 0.1 * n}
        for n in (1, 2)
    ]
    broken = {"agent_steps": 300, "episodes": 300, "return_mean": 0.3}  # as good as an interruption there

    with pytest.raises(KeyError):
        score_table.append_curve(measure, 0, [*rows, broken])
    assert not score_table.CURVES.exists(), "what stands there is taken for the whole curve"

    score_table.append_curve(measure, 0, rows)
    score_table.append_curve(measure, 0, rows)
    with open(score_table.CURVES, newline="") as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["0.1", "0.2"]
