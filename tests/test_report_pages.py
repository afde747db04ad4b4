"""Pages about runs: what is out of the ordinary, such as names of a game's own, odd folders, long runs."""

from __future__ import annotations

from pathlib import Path

from test_reports import ROWS, write_run

from mappo_unity.cli import report_main
from mappo_unity.reports import data


def test_a_games_statistics_may_be_named_as_our_headings_are(tmp_path: Path) -> None:
    names = ["Episodes/won", "Constant/size", "episode_length_mean", "Episodes/lost", "return_mean"]
    assert data.chart_headings(names) == [
        ("Episodes", ["return_mean", "episode_length_mean", "Episodes/won", "Episodes/lost"]),
        ("Constant", ["Constant/size"]),
    ]
    assert data.chart_headings(["kl", "kl_low"], {"kl_low"}) == [("Learning", ["kl"])]

    write_run(tmp_path / "run", rows=[{**row, "Episodes/won": row["agent_steps"]} for row in ROWS])
    assert report_main([str(tmp_path / "run")]) == 0
