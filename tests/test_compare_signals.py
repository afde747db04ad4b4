"""The table of scripts/compare_signals.py: what stands in docs/rewards.md is what was measured."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import compare_signals
from compare_signals import SIGNALS, Signal
from learn_scene import append
from pages import assert_page_is_written

PRESET = Signal("Hallway", "none", "the preset")


def test_the_table_of_the_page_is_that_of_the_measured_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_page_is_written(compare_signals, tmp_path, monkeypatch)


def test_options_of_every_signal_are_taken_by_its_scene() -> None:
    from mappo_unity.config.compose import compose_config

    for signal in SIGNALS:
        demos = [f"{signal.demos}=[recorded.demo]"] if signal.demos else []
        compose_config([f"env={signal.scene}", *signal.options, *demos])


def metrics(*rows: tuple[int, int, float]) -> list[dict[str, Any]]:
    """Return rows of a run: decisions, episodes, mean return; a minute each."""
    return [
        {"agent_steps": steps, "episodes": episodes, "return_mean": value, "wall_s": 60.0 * place}
        for place, (steps, episodes, value) in enumerate(rows)
    ]


def test_a_run_reaches_the_benchmark_after_a_hundred_episodes_at_the_soonest() -> None:
    rows = metrics((100, 20, 0.9), (200, 100, 0.6), (300, 140, 0.7), (400, 180, 0.8))
    first = compare_signals.first_at(rows, compare_signals.BENCHMARK["Hallway"])
    assert first is not None and first["agent_steps"] == 300
    assert compare_signals.first_at(rows[:2], compare_signals.BENCHMARK["Hallway"]) is None


def test_a_signal_s_cells_are_of_its_own_rows_by_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = {"scene": "Hallway", "signal": "none", "decisions": 500_000, "value": 0.9}
    rows = [
        {**row, "seed": 1, "reached": "", "reached_minutes": ""},  # never at the benchmark
        {**row, "seed": 0, "reached": 200_000, "reached_minutes": 1.4, "value": 0.8},
        {**row, "seed": 2, "signal": "gail", "reached": 1, "reached_minutes": 1},
        {**row, "seed": 2, "scene": "Pyramids", "reached": 1, "reached_minutes": 1},
    ]
    for line in rows:
        append(tmp_path / "signals.csv", line)
    monkeypatch.setattr(compare_signals, "ROWS", tmp_path / "signals.csv")

    assert compare_signals.cells(compare_signals.rows_of(PRESET)) == [
        "0, 1",
        "0.20 M, never",
        "1.4, -",
        "**0.85** (0.80, 0.90)",
        "0.50 M, 0.50 M",
    ]


@pytest.mark.parametrize("words", [[], ["--demos", "nowhere"]])
def test_without_its_recordings_nothing_is_trained(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["compare_signals.py", *words])
    with pytest.raises(SystemExit) as end:
        compare_signals.main()
    assert end.value.code == 2
    assert "--demos" in capsys.readouterr().err.splitlines()[-1]
