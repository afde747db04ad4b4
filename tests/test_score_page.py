"""The tables that scripts/score_table.py writes: what stands in README is what was measured."""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import decisions_to
import score_page
import score_table
from learn_scene import thin
from score_measures import MEASURES, Measure, mean_return

from mappo_unity.config.compose import compose_config
from mappo_unity.runs.folder import write_record

LESSONS = "{lessons: [{value: 2, completion: {measure: progress, threshold: 0.5}}, {value: 14.715}]}"


def test_the_table_in_readme_is_that_of_the_measured_scores() -> None:
    readme = score_page.README.read_text(encoding="utf-8")
    assert score_page.with_summary(readme) == readme, "python scripts/score_table.py --draw writes it anew"


def test_every_scene_with_a_target_has_a_row() -> None:
    readme = score_page.README.read_text(encoding="utf-8")
    table = readme.partition(score_page.BEGIN)[2].partition(score_page.END)[0].splitlines()[2:]
    assert [row.split(" | ")[1] for row in table] == [measure.name for measure in MEASURES]


@pytest.fixture
def curves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write curves of two seeds and of the one kept aside: decisions, minutes, value."""
    rows: list[dict[str, Any]] = []
    for seed, points in {
        "0": [(100, 1.0, 0.9), (200, 2.0, 0.3), (300, 3.0, 0.8)],
        "1": [(100, 1.5, 0.1), (400, 4.0, 0.4)],
        "3": [(100, 1.0, 1.0), (300, 3.0, 1.0)],
    }.items():
        for decisions, minutes, value in points:
            rows.append(
                {"scene": "Probe", "column": "return_mean", "seed": seed, "decisions": decisions}
                | {"minutes": minutes, "value": value}
            )

    path = tmp_path / "curves.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    monkeypatch.setattr(score_page, "CURVES", path)


@pytest.mark.parametrize(
    ("target", "is_lower_better", "expected"),
    [
        (0.5, False, [(100.0, 1.0, 0.9)]),
        (0.95, False, []),
        (0.5, True, [(200.0, 2.0, 0.3), (100.0, 1.5, 0.1)]),
    ],
)
def test_a_target_is_reached_where_the_curve_first_stands_there(
    target: float, is_lower_better: bool, expected: list[tuple[float, float, float]], curves: None
) -> None:
    measure = Measure("Probe", "return", mean_return, target, is_lower_better=is_lower_better)
    assert score_page.first_reached(measure) == expected


def test_a_row_says_how_many_seeds_there_are(curves: None) -> None:
    def row(policy: str, value: float, sampled: str = "True") -> dict[str, str]:
        return {"policy": policy, "value": str(value), "sampled": sampled}

    rows = [row("0", 0.8), row("0", 0.2, "False"), row("1", 0.4), row("3", 1.0), row("random", -1.0)]
    cells = score_page.summary_row(Measure("Probe", "return", mean_return, 0.5), rows).split(" | ")
    assert cells[1:-1] == ["return", "-1", "**0.6** (of 2)", "-", ">= 0.5"]
    assert cells[-1].startswith("0.00 M decisions, 1.0 min (1 of 2 seeds)")
    alone = score_page.summary_row(Measure("Probe", "return", mean_return, 0.5), [row("3", 1.0)])
    assert alone.split(" | ")[2:5] == ["-", "-", "-"]


def test_own_matches_are_played_by_one_policy_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(score_table, "mappo_eval", lambda *lines, timeout_s: asked.extend(lines) or {})
    own = next(measure for measure in MEASURES if measure.opponent == "own")

    arguments = argparse.Namespace(episodes=None, unity=None)
    assert score_table.evaluate(arguments, own, ["run=some/run"], False) == {}
    assert {"run=some/run", "opponent=some/run"} <= set(asked)
    assert score_table.is_taken(arguments, own, "0", False)
    assert not score_table.is_taken(arguments, own, "random", False)


def test_what_an_interruption_left_out_is_measured_by_the_next_call(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, ...]] = []

    def evaluate(*lines: str, timeout_s: float) -> dict[str, Any]:
        if len(asked) == 2:
            raise KeyboardInterrupt
        asked.append(lines)
        return {"won_of_decided": 0.9, "won_of_decided_low95": 0.8, "won_of_decided_high95": 1.0}

    monkeypatch.setattr(score_table, "SCORES", tmp_path / "scores.csv")
    monkeypatch.setattr(score_table, "mappo_eval", evaluate)
    arguments = argparse.Namespace(episodes=None, unity=tmp_path)
    call = (arguments, "SoccerTwos", "0", ["run=some/run"], {})

    with pytest.raises(KeyboardInterrupt):
        score_table.score(*call)
    random, unity = "opponent=random", f"opponent={tmp_path}"
    assert [(lines[2], lines[3]) for lines in asked] == [
        ("deterministic=false", random),
        ("deterministic=false", unity),
    ]

    asked.append(())  # past the interruption
    score_table.score(*call)
    assert [(lines[2], lines[3]) for lines in asked[3:]] == [
        ("deterministic=true", random),
        ("deterministic=true", unity),
    ]
    assert not score_table.missing(arguments, "SoccerTwos", "0")

    # for what was not asked before, a run that is gone is not trained again
    (tmp_path / "scores.csv").write_text(
        "scene,measure,policy,sampled\nSoccerTwos,won against random,0,True\n"
    )
    monkeypatch.setattr(score_table, "train", lambda *given: pytest.fail("it trains again"))
    score_table.measure_seed(
        argparse.Namespace(episodes=None, unity=tmp_path, out=tmp_path), "SoccerTwos", 0, []
    )


def test_a_thinned_curve_keeps_its_last_point_and_the_first_one_at_the_target() -> None:
    points = list(range(100))
    assert thin(points, 10) == [*range(0, 100, 10), 99]
    assert thin(points, 10, lambda point: point in (43, 47)) == [
        0,
        10,
        20,
        30,
        40,
        43,
        50,
        60,
        70,
        80,
        90,
        99,
    ]
    assert thin([], 10, bool) == []


def note_options(folder: Path, *options: str) -> None:
    """Write the record of a run."""
    write_record(folder, compose_config(list(options)).config, list(options))


def test_a_run_is_evaluated_in_its_last_lesson_wherever_it_stands(tmp_path: Path) -> None:
    note_options(tmp_path, "env=CooperativePushBlock", f"env.params.gravity={LESSONS}")
    assert score_table.last_lesson(tmp_path) == ["env.params.gravity=14.715"]

    note_options(tmp_path, "env=Basic")
    assert score_table.last_lesson(tmp_path) == []


def test_a_curve_is_of_the_last_lesson(tmp_path: Path) -> None:
    note_options(tmp_path, "env=CooperativePushBlock", f"env.params.gravity={LESSONS}")
    rows = [(100, 0, 9.0), (140, 1, 8.0), (339, 1, 7.0), (340, 1, 6.0), (400, 1, 5.0)]
    lines = [f"{episodes},{lesson},{value}" for episodes, lesson, value in rows]
    (tmp_path / "metrics.csv").write_text("\n".join(["episodes,lesson/gravity,return_mean", *lines]) + "\n")
    assert [row["return_mean"] for row in decisions_to.read_last_lesson(tmp_path)] == [6.0, 5.0]
