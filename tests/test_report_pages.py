"""Pages about runs: what is out of the ordinary, such as names of a game's own, odd folders, long runs."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from test_reports import ROWS, get, page_of, rows_of, write_run

from mappo_unity.cli import report_main
from mappo_unity.config.schema import LogConfig
from mappo_unity.reports import data
from mappo_unity.reports.dashboard import dashboard


def test_a_games_statistics_may_be_named_as_our_headings_are(tmp_path: Path) -> None:
    names = ["Episodes/won", "Constant/size", "episode_length_mean", "Episodes/lost", "return_mean"]
    assert data.chart_headings(names) == [
        ("Episodes", ["return_mean", "episode_length_mean", "Episodes/won", "Episodes/lost"]),
        ("Constant", ["Constant/size"]),
    ]
    assert data.chart_headings(["kl", "kl_low"], {"kl_low"}) == [("Learning", ["kl"])]

    write_run(tmp_path / "run", rows=[{**row, "Episodes/won": row["agent_steps"]} for row in ROWS])
    assert report_main([str(tmp_path / "run")]) == 0


def test_curves_of_seeds_are_thinned_as_runs_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "ALL_ROWS", 200)
    for seed in range(2):
        rows = rows_of(list(range(400)), [float(seed)] * 400)
        for row in rows[::2]:
            row["kl"] = 0.01 * row["agent_steps"]
        write_run(tmp_path / str(seed), [f"seed={seed}"], rows, seed=seed)
    page = page_of(tmp_path)
    assert "one row in 4" in page.text

    (group,) = page.data["groups"]
    curve = group["curves"]["return_mean"]["decisions"]
    assert curve["x"] == page.data["runs"][0]["columns"]["agent_steps"] == [*range(0, 400, 4), 399]
    assert curve["mean"] == [0.5] * 101 and curve["spread"] == [pytest.approx(0.5**0.5)] * 101

    # of a metric with few numbers, as of one whose runs share no places, every place stays
    assert group["curves"]["kl"]["decisions"]["x"] == list(range(0, 400, 2))


@pytest.mark.skipif(os.name != "posix", reason="names of files are texts elsewhere")
def test_a_folder_whose_name_is_no_utf8_has_its_pages(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/run\xff"))
    try:
        write_run(folder, rows=ROWS)
    except OSError:
        pytest.skip("this file system takes no such name")
    assert report_main([str(tmp_path)]) == 0  # on a command line such a name is refused
    assert "run\\udcff" in (tmp_path / "report.html").read_text(encoding="utf-8")

    with dashboard(LogConfig(dashboard=True), folder) as url:
        code, text = get(str(url))
    assert code == 200 and "run\\udcff" in text.decode()
