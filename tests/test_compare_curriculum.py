"""The table of scripts/compare_curriculum.py: what stands on WallJump's page is what was measured."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import compare_curriculum
from compare_curriculum import BENCHMARK, FULL_HEIGHT, LAST_LESSON, WAYS, Way, first_at_both
from learn_scene import append
from pages import assert_page_is_written

WITHOUT, WITH = WAYS


def test_the_table_of_the_page_is_that_of_the_measured_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert_page_is_written(compare_curriculum, tmp_path, monkeypatch)


def test_the_walls_of_the_last_lesson_are_those_that_are_evaluated() -> None:
    params = env_of(WITH).params
    for text in FULL_HEIGHT:
        name, _, height = text.removeprefix("env.params.").partition("=")
        lessons = params[name]["lessons"]
        assert len(lessons) == LAST_LESSON + 1
        assert lessons[LAST_LESSON]["value"] == int(height)

    assert not env_of(WITHOUT).params


def env_of(way: Way) -> Any:
    """Return the options of the environment that a way trains."""
    from mappo_unity.config.compose import compose_config

    return compose_config([f"env={compare_curriculum.SCENE}", *way.options]).config.env


def row(small: float, big: float, episodes: int = 200, **lessons: int) -> dict[str, Any]:
    """Return a row of metrics: both mean returns, and lessons by the parameter's name."""
    return {
        "episodes": episodes,
        "return_mean": (small + big) / 2,
        "SmallWallJump?team=0/return_mean": small,
        "BigWallJump?team=0/return_mean": big,
        **{f"lesson/{name}": number for name, number in lessons.items()},
    }


def test_both_behaviors_must_stand_at_the_benchmark_at_once() -> None:
    rows = [row(0.9, 0.7), row(0.7, 0.9), row(math.nan, 0.9), row(0.9, 0.9, episodes=40), row(0.8, 0.8)]
    assert first_at_both(rows, BENCHMARK) is rows[-1]
    assert first_at_both(rows[:-1], BENCHMARK) is None


def test_low_walls_do_not_count() -> None:
    low = row(0.9, 0.9, small_wall_height=2, big_wall_height=2)
    half = row(0.9, 0.9, small_wall_height=3, big_wall_height=2)
    full = [row(0.9, 0.9, n, small_wall_height=3, big_wall_height=3) for n in (300, 499, 500)]
    assert first_at_both([low, half, *full], BENCHMARK) is full[2], "the first 200 began before, or by luck"
    assert first_at_both([low, half, *full[:2]], BENCHMARK) is None


def test_cells_are_of_a_way_s_own_rows_by_seed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = {"way": "with", "decisions": 8_000_000, "small": 0.95, "big": 0.81}
    for measured in (
        {**line, "seed": 1, "reached": "", "reached_minutes": ""},  # never at both benchmarks
        {**line, "seed": 0, "reached": 5_700_000, "reached_minutes": 53.4},
        {**line, "seed": 2, "way": "without", "reached": 1, "reached_minutes": 1},
    ):
        append(tmp_path / "curriculum.csv", measured)
    monkeypatch.setattr(compare_curriculum, "ROWS", tmp_path / "curriculum.csv")

    assert [compare_curriculum.cells(row) for row in compare_curriculum.rows_of(WITH)] == [
        ["0", "5.70 M", "53", "0.950, 0.810", "8.00 M"],
        ["1", "never", "-", "0.950, 0.810", "8.00 M"],
    ]
