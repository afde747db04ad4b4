"""Runs shown to people: groups of seeds, mean and spread, the picture, the page, the page of a live run."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import math
import os
import re
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from mappo_unity.cli import plot_main, report_main
from mappo_unity.config.compose import check_effect, compose_config
from mappo_unity.config.schema import Config, LogConfig, XAxis
from mappo_unity.errors import ConfigError
from mappo_unity.reports import data, videos
from mappo_unity.reports.curves import curve_of, mean_curve
from mappo_unity.reports.dashboard import Answers, dashboard
from mappo_unity.reports.groups import group_runs
from mappo_unity.reports.page import report_page
from mappo_unity.reports.parallel import parallel_coordinates
from mappo_unity.reports.reading import Run, default_options, find_runs, read_run, read_runs
from mappo_unity.reports.sections import outcome, seconds, status
from mappo_unity.reports.writing import write_report

HOSTILE = "</script><script>alert(1)</script>&'\""


def write_run(
    folder: Path, lines: list[str] | None = None, rows: list[dict[str, Any]] | None = None, **options: Any
) -> Path:
    """Write a run folder as a training run leaves it; `options` by their names, dots as __."""
    folder.mkdir(parents=True)
    config = OmegaConf.structured(Config)
    for key, value in {"env__name": "Basic", **options}.items():
        OmegaConf.update(config, key.replace("__", "."), value, force_add=True)
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(config), encoding="utf-8")

    starts = [{"date": "2026-11-20T12:00:00+00:00", "overrides": lines or []}]
    (folder / "overrides.yaml").write_text(OmegaConf.to_yaml(OmegaConf.create(starts)), encoding="utf-8")
    (folder / "versions.json").write_text('{"python": "3.11.7", "torch": "2.13.0"}')
    if rows is not None:
        write_rows(folder, rows)
    return folder


def write_rows(folder: Path, rows: list[dict[str, Any]]) -> None:
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def rows_of(steps: list[int], returns: list[float], **more: Any) -> list[dict[str, Any]]:
    return [
        {"agent_steps": step, "wall_s": step / 100, "return_mean": value, **more}
        for step, value in zip(steps, returns)
    ]


def with_columns(steps: list[float], values: list[float]) -> Run:
    columns = {"agent_steps": np.array(steps, float), "m": np.array(values, float)}
    return Run(Path("run"), {}, columns, {}, [], {})


ROWS = rows_of([100, 200], [1.0, 2.0])


# Which runs


def test_runs_of_a_sweep_are_found_in_the_order_of_their_jobs(tmp_path: Path) -> None:
    for job in (0, 2, 10):
        write_run(tmp_path / "sweep" / str(job), rows=ROWS)
    (tmp_path / "sweep" / "other").mkdir()
    (tmp_path / "sweep" / "other" / "config.yaml").write_text("a: 1")  # some other program's
    assert [path.name for path in find_runs(tmp_path, "runs")] == ["0", "2", "10"]


def test_a_checkpoint_stands_for_its_run_and_no_run_is_read_twice(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", rows=ROWS)
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "best.pt").touch()
    runs, notes = read_runs([str(run / "checkpoints" / "best.pt"), str(run), str(tmp_path)])
    assert [one.folder for one in runs] == [run] and notes == []


def test_a_run_without_metrics_is_left_out_with_a_note(tmp_path: Path) -> None:
    write_run(tmp_path / "a", rows=ROWS)
    write_run(tmp_path / "b")
    runs, notes = read_runs([str(tmp_path)])
    assert [run.folder.name for run in runs] == ["a"] and notes == [f"{tmp_path / 'b'}: no metrics, left out"]


def test_the_best_return_is_that_of_a_full_window() -> None:
    columns = {
        "agent_steps": [100.0, 200.0, 300.0, 400.0],
        "return_mean": [9.0, 1.0, 3.0, 2.0],  # at first of a few lucky episodes
        "episodes": [3.0, 99.0, 150.0, 200.0],
        "wall_s": [1.0, 2.0, 3.0, 4.0],
    }
    arrays = {name: np.array(values) for name, values in columns.items()}
    page = outcome([Run(Path("run"), default_options(), arrays, {}, [], {})])
    cells = dict(re.findall("<dt>(.*?)</dt><dd>(.*?)</dd>", page))
    assert (cells["best return"], cells["at decision"]) == ("3", "300")


def test_cells_without_a_number_are_nan_and_damaged_records_cost_nothing(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", rows=[*ROWS, {"agent_steps": 300, "wall_s": 3.0, "kl": 0.5}])
    (folder / "versions.json").write_text("{")
    (folder / "overrides.yaml").write_text("a: [")
    run = read_run(folder)
    np.testing.assert_array_equal(run.columns["return_mean"], [1, 2, np.nan])
    np.testing.assert_array_equal(run.columns["kl"], [np.nan, np.nan, 0.5])
    assert run.versions == {} and run.starts == []


# Groups


def labels(folder: Path) -> list[tuple[str, int]]:
    return [(group.label, len(group.runs)) for group in group_runs(read_runs([str(folder)])[0])]


def test_runs_that_differ_only_in_seed_are_one_group(tmp_path: Path) -> None:
    for job, (seed, lr) in enumerate([(0, 1e-3), (1, 1e-3), (0, 1e-4)]):
        lines = ["env=Basic", f"seed={seed}", f"ppo.lr={lr}", f"log.progress={job == 0}"]
        write_run(tmp_path / str(job), lines, ROWS, seed=seed, ppo__lr=lr, log__progress=job == 0)
    assert labels(tmp_path) == [("ppo.lr=0.001", 2), ("ppo.lr=0.0001", 1)]


def test_the_same_value_typed_otherwise_makes_no_group(tmp_path: Path) -> None:
    write_run(tmp_path / "0", ["ppo.lr=1e-3"], ROWS, ppo__lr=1e-3)
    write_run(tmp_path / "1", ["ppo.lr=0.001", "output_dir=x"], ROWS, ppo__lr=0.001, output_dir="x")
    assert labels(tmp_path) == [("Basic", 2)]


def test_an_older_run_has_the_defaults_of_options_it_does_not_know(tmp_path: Path) -> None:
    write_run(tmp_path / "new", [], ROWS)
    old = write_run(tmp_path / "old", [], ROWS)
    text = (old / "config.yaml").read_text()
    shorter = text.replace("  gamma: 0.99\n", "", 1)
    assert shorter != text
    (old / "config.yaml").write_text(shorter)
    assert labels(tmp_path) == [("Basic", 2)]


def test_labels_name_choices_of_presets_else_options_else_folders(tmp_path: Path) -> None:
    changes = {"ppo__lr": 1e-3, "ppo__epochs": 9, "ppo__gamma": 0.9, "ppo__gae_lambda": 0.5, "max_steps": 7}
    write_run(tmp_path / "recipes" / "a", ["recipe=none"], ROWS)
    write_run(tmp_path / "recipes" / "b", ["recipe=mlagents"], ROWS, **changes)
    assert labels(tmp_path / "recipes") == [("recipe=none", 1), ("recipe=mlagents", 1)]

    write_run(tmp_path / "files" / "a", [], ROWS)  # by --config: nothing stands on the command line
    write_run(tmp_path / "files" / "b", [], ROWS, ppo__epochs=9)
    assert labels(tmp_path / "files") == [("ppo.epochs=3", 1), ("ppo.epochs=9", 1)]

    write_run(tmp_path / "many" / "a", [], ROWS)
    write_run(tmp_path / "many" / "b", [], ROWS, **changes)
    assert labels(tmp_path / "many") == [("a", 1), ("b", 1)]


# Mean and spread, by hand


def test_mean_and_spread_at_the_same_places() -> None:
    runs = [with_columns([10, 20, 30], values) for values in ([1, 2, 6], [3, 2, np.nan], [5, 2, np.nan])]
    curve = mean_curve(runs[:2], "m", XAxis.decisions)
    np.testing.assert_allclose(curve.mean[:2], [2, 2])
    curve = mean_curve(runs, "m", XAxis.decisions)
    # 1, 3, 5: mean 3, squares 4 + 0 + 4 over n - 1 = 2
    assert (curve.mean[0], curve.spread[0]) == (3, 2)


def test_between_a_runs_own_places_the_line_counts_and_behind_its_end_it_does_not() -> None:
    short, long = with_columns([0, 10], [0, 10]), with_columns([0, 5, 20], [0, 1, 7])
    curve = mean_curve([short, long], "m", XAxis.decisions)
    # places 0, 10, 20 (as many as the longest has rows); the long run at 10: 1 + (7 - 1) / 3 = 3
    np.testing.assert_allclose(curve.x, [0, 10, 20])
    np.testing.assert_allclose(curve.mean, [0, (10 + 3) / 2, 7])
    np.testing.assert_allclose(curve.spread, [0, 7 / np.sqrt(2), np.nan])


def test_no_place_between_runs_that_do_not_meet() -> None:
    curve = mean_curve(
        [with_columns([0, 1, 2], [1, 1, 1]), with_columns([8, 9, 10], [3, 3, 3])], "m", XAxis.decisions
    )
    np.testing.assert_allclose(curve.x, [0, 5, 10])
    np.testing.assert_allclose(curve.mean, [1, np.nan, 3])


def test_a_curve_over_time_leaves_rows_without_numbers_out(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "a", rows=rows_of([100, 200, 300], [1.0, float("nan"), 3.0])))
    x, y = curve_of(run, "return_mean", XAxis.time)
    assert x.tolist() == [1.0, 3.0] and y.tolist() == [1.0, 3.0]
    assert len(mean_curve([run], "nothing", XAxis.time).x) == 0


def test_runs_are_shown_without_torch(tmp_path: Path) -> None:
    write_run(tmp_path / "run", rows=ROWS)
    code = f"""import sys
from mappo_unity.cli import plot_main, report_main
plot_main(["--help"]), report_main(["--help"])
code = report_main([{str(tmp_path / "run")!r}])
sys.exit(code or bool({{'torch', 'matplotlib', 'mujoco', 'mlagents_envs'}} & set(sys.modules)))"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "x: decisions|time = decisions" in done.stdout and "report.html: 1 run, " in done.stdout


# The picture


def test_a_picture_names_its_groups(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    for job, lr in enumerate((1e-3, 1e-3, 1e-4)):
        write_run(tmp_path / "s" / str(job), [f"seed={job}", f"ppo.lr={lr}"], ROWS, seed=job, ppo__lr=lr)
    assert (
        plot_main([str(tmp_path / "s"), "x=time", "metric=return_mean, wall", f"out={tmp_path}/a.svg"]) == 2
    )
    assert plot_main([str(tmp_path / "s"), "x=time", f"out={tmp_path}/a.svg"]) == 0
    assert plot_main([str(tmp_path / "s" / "0"), str(tmp_path / "s" / "2"), f"out={tmp_path}/a.png"]) == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    drawn = (tmp_path / "a.svg").read_text()
    assert "ppo.lr=0.001 (2 runs)" in drawn and "ppo.lr=0.0001 -->" in drawn and "seconds" in drawn
    assert "ppo.lr=0.001: 2 runs" in capsys.readouterr().out


# The page


class Page(HTMLParser):
    """Tags with their attributes, and the texts of scripts by their type."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: dict[str | None, str] = {}
        self.text = ""
        self._script: str | None = None
        self._is_script = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._is_script = tag == "script"
        self._script = dict(attrs).get("type")

    def handle_endtag(self, tag: str) -> None:
        self._is_script = False

    def handle_data(self, data: str) -> None:
        if self._is_script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data
        else:
            self.text += data

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self.scripts["application/json"])


def page_of(folder: Path, **options: Any) -> Page:
    return Page(report_page(read_runs([str(folder)])[0], "title", **options))


def test_the_page_holds_what_metrics_csv_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        {"agent_steps": 10 * row, "wall_s": row / 7, "return_mean": row**2 / 3, "SoccerTwos?team=1/x": -row}
        for row in range(50)
    ]
    rows[3]["return_mean"] = float("nan")
    write_run(tmp_path / "run", rows=rows)
    assert report_main([str(tmp_path / "run")]) == 0
    size = round((tmp_path / "run" / "report.html").stat().st_size / 1000)
    assert capsys.readouterr().out == f"{tmp_path / 'run' / 'report.html'}: 1 run, {size} kB\n"
    (run,) = Page((tmp_path / "run" / "report.html").read_text(encoding="utf-8")).data["runs"]

    with (tmp_path / "run" / "metrics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    for name in table[0]:
        wanted = [float(row[name]) for row in table]
        shown = [np.nan if value is None else value for value in run["columns"][name]]
        np.testing.assert_allclose(shown, wanted, rtol=1e-6)


def test_long_runs_are_thinned_and_keep_their_last_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(data, "ALL_ROWS", 100)
    write_run(tmp_path / "run", rows=rows_of(list(range(250)), [0.0] * 250))
    page = page_of(tmp_path)
    steps = page.data["runs"][0]["columns"]["agent_steps"]
    assert steps[:3] == [0, 3, 6] and steps[-2:] == [246, 249] and "one row in 3" in page.text


def test_seeds_have_their_mean_and_spread_in_the_page(tmp_path: Path) -> None:
    for seed, returns in enumerate(([1.0, 2.0], [3.0, 2.0])):
        write_run(tmp_path / str(seed), [f"seed={seed}"], rows_of([100, 200], returns), seed=seed)
    (group,) = page_of(tmp_path).data["groups"]
    assert group["curves"]["return_mean"]["decisions"] == {
        "x": [100, 200],
        "mean": [2, 2],
        "spread": [pytest.approx(np.sqrt(2), rel=1e-6), 0],
    }
    assert group["curves"]["return_mean"]["time"]["x"] == [1, 2]


def test_hostile_texts_stay_texts(tmp_path: Path) -> None:
    for job, note in enumerate((HOSTILE, "b")):
        folder = write_run(tmp_path / str(job), [f"env.note={note}"], ROWS, env__note=note)
        write_rows(folder, [{**row, HOSTILE: 1.0 + row["agent_steps"]} for row in ROWS])
    page = page_of(tmp_path, findings=[{"text": HOSTILE, "evidence": "<b>", "cure": "<i>"}], notes=[HOSTILE])
    assert sorted(page.scripts, key=str) == [None, "application/json"]  # ours, and no other one
    assert "alert" not in page.scripts[None]
    assert page.text.count("alert(1)") >= 4 and not {"b", "i"} & {tag for tag, _ in page.tags}
    assert HOSTILE in page.data["runs"][0]["columns"]
    assert page.data["groups"][0]["label"] == f"env.note={HOSTILE}"


def test_the_page_loads_nothing(tmp_path: Path) -> None:
    write_run(tmp_path / "run", rows=ROWS)
    (tmp_path / "run" / "match.gif").write_bytes(b"GIF89a")
    page = page_of(tmp_path)
    sources = [
        value for _, attributes in page.tags for key in ("src", "href") if (value := attributes.get(key))
    ]
    assert sources == ["data:image/gif;base64,R0lGODlh"]

    script = page.scripts[None]
    (policy,) = [a["content"] for _, a in page.tags if a.get("http-equiv") == "Content-Security-Policy"]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy is not None and f"script-src 'sha256-{digest}';" in policy
    assert "default-src 'none'" in policy and "connect-src" not in policy  # not even its own server
    urls = set(re.findall(r"https?://[^\"'\s]*", script))
    assert urls == {"http://www.w3.org/2000/svg"}  # a name, which nobody fetches


@pytest.mark.slow
def test_a_browser_draws_every_chart(tmp_path: Path) -> None:
    browser = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium here")
    names = ("return_mean", "kl", "Self-play/ELO")
    for seed in range(2):
        rows = [{**row, **dict.fromkeys(names, row["return_mean"] + seed)} for row in ROWS]
        write_run(tmp_path / "runs" / str(seed), [f"seed={seed}"], rows, seed=seed)
    write_report([str(tmp_path / "runs")])

    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--window-size=360,800"]
    flags += ["--disable-background-networking", f"--user-data-dir={tmp_path / 'browser'}"]
    page = (tmp_path / "runs" / "report.html").as_uri()
    done = subprocess.run(
        [browser, *flags, "--virtual-time-budget=2000", "--dump-dom", page], capture_output=True, timeout=60
    )
    drawn = done.stdout.decode()
    # two headings are open: return_mean and the Elo rating, a mean and a band each; kl is folded away
    assert drawn.count('class="chart"') == 3
    assert drawn.count('class="line"') == 2 and drawn.count('class="band"') == 2
    assert "(2 runs)" not in drawn  # a legend of one group says nothing


def test_findings_have_a_place_and_none_need_it(tmp_path: Path) -> None:
    write_run(tmp_path / "run", rows=ROWS)
    page = page_of(tmp_path, findings=[{"text": "KL is high", "evidence": "0.3", "cure": "a smaller ppo.lr"}])
    assert "Diagnosis" in page.text and "a smaller ppo.lr" in page.text
    assert "Diagnosis" not in page_of(tmp_path).text


def test_videos_come_along_up_to_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(videos, "FILE_BYTES", 10)
    folder = write_run(tmp_path / "run", rows=ROWS)
    (folder / "videos").mkdir()
    (folder / "videos" / "a.mp4").write_bytes(b"0123456789")
    (folder / "b.webm").write_bytes(b"0123456789x")
    page = page_of(tmp_path)
    (video,) = [attributes for tag, attributes in page.tags if tag == "video"]
    assert video["src"] == "data:video/mp4;base64,MDEyMzQ1Njc4OQ=="
    assert "Too large for this page: run/b.webm (0.0 MB)" in page.text


def test_options_that_differ_from_the_defaults_are_shown(tmp_path: Path) -> None:
    write_run(tmp_path / "run", ["ppo.lr=0.002"], ROWS, ppo__lr=0.002, env__params={"mass": 2})
    text = page_of(tmp_path).text
    assert "ppo.lr0.0020.0003" in text and "env.params.mass2-" in text and "ppo.gamma" not in text


def test_headings_keep_an_interval_together_and_constants_apart(tmp_path: Path) -> None:
    names = [
        "return_mean",
        "rating",
        "rating_low",
        "rating_high",
        "lesson/mass",
        "kl",
        "A?team=0/return_mean",
    ]
    assert data.chart_headings(names, {"kl"}) == [
        ("Episodes", ["return_mean"]),
        ("Lessons", ["lesson/mass"]),
        ("Matches and self-play", ["rating"]),
        ("A?team=0", ["A?team=0/return_mean"]),
        ("Constant", ["kl"]),
    ]


def test_time_is_split_and_the_rest_is_known_only_where_the_files_lie_as_written(tmp_path: Path) -> None:
    rows = [{**row, "collect_s": 2.0, "update_s": 3.0} for row in ROWS]
    folder = write_run(tmp_path / "run", rows=rows)
    begun = 1_795_176_000  # 2026-11-20 12:00 UTC
    os.utime(folder / "config.yaml", (begun + 1, begun + 1))
    os.utime(folder / "metrics.csv", (begun + 17, begun + 17))
    assert seconds(read_run(folder)) == {"collect": 4, "update": 6, "rest": 7}
    os.utime(folder / "config.yaml", (begun + 9999, begun + 9999))  # a copy
    assert np.isnan(seconds(read_run(folder))["rest"])


def test_how_a_run_ended(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", rows=ROWS, max_steps=400)
    assert status(read_run(folder)) == "50 % of 400"
    (folder / "result.json").write_text('{"status": "solved"}')
    assert status(read_run(folder)) == "solved"
    assert status(read_run(write_run(tmp_path / "over", rows=ROWS, max_steps=200))) == "finished"


def test_parallel_coordinates_place_values(tmp_path: Path) -> None:
    for job, (lr, kind) in enumerate([(1e-4, "mean"), (1e-3, "local"), (1e-2, "mean")]):
        lines = [f"ppo.lr={lr}", f"model.critic={kind}", f"seed={job}"]
        write_run(
            tmp_path / str(job), lines, rows_of([1], [float(job)]), ppo__lr=lr, model__critic=kind, seed=job
        )
    drawing = parallel_coordinates(read_runs([str(tmp_path)])[0])
    points = re.findall(r"points='([^']*)'", drawing)
    heights = sorted([float(point.split(",")[1]) for point in line.split()] for line in points)
    # lr by its logarithm: the middle one half way between 34 and 260; critic: two places; return as it is
    assert heights == [[34.0, 260.0, 34.0], [147.0, 34.0, 147.0], [260.0, 260.0, 260.0]]
    assert ">seed<" not in drawing and "model.critic" in drawing


def test_a_run_without_a_return_has_no_place_on_its_axis(tmp_path: Path) -> None:
    for job, (lr, value) in enumerate([(0.1, 5.0), (0.2, math.nan)]):
        write_run(tmp_path / str(job), [f"ppo.lr={lr}"], rows_of([1], [value]), ppo__lr=lr)
    points = re.findall(r"points='([^']*)'", parallel_coordinates(read_runs([str(tmp_path)])[0]))
    assert sorted(len(line.split()) for line in points) == [1, 2]


# A run that trains


def get(url: str, **headers: str) -> tuple[int, bytes]:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, b""


def test_a_dashboard_serves_its_run_and_goes(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    with dashboard(LogConfig(dashboard=True), folder) as url:
        assert url is not None and url.startswith("http://127.0.0.1:")
        code, text = get(url)
        page = Page(text.decode())
        assert code == 200 and page.data is None and "id='state'" in text.decode()
        (policy,) = [a["content"] for _, a in page.tags if a.get("http-equiv")]
        assert policy is not None and "connect-src 'self'" in policy and "default-src 'none'" in policy

        assert json.loads(get(f"{url}data.json")[1])["message"] == "no metrics yet"
        write_rows(folder, ROWS)
        answer = json.loads(get(f"{url}data.json")[1])
        assert answer["data"]["runs"][0]["columns"]["return_mean"] == [1, 2] and answer["refresh_s"] >= 3
        assert "finished" not in answer["sections"]["outcome"]

        assert get(f"{url}metrics.csv")[0] == 404 and get(f"{url}../config.yaml")[0] == 404
        assert get(url, Host="evil.example")[0] == 403  # a name elsewhere that was pointed here
        assert get(url, Host="localhost:1234")[0] == 200  # the other end of a tunnel
    with pytest.raises(urllib.error.URLError):
        get(url)


def test_a_dashboard_outlives_what_it_cannot_read(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    (folder / "metrics.csv").write_text("agent_steps\nx\n")
    with dashboard(LogConfig(dashboard=True), folder) as url:
        assert "cannot be read now" in json.loads(get(f"{url}data.json")[1])["message"]
        write_rows(folder, ROWS)
        assert json.loads(get(f"{url}data.json")[1])["data"] is not None


def test_a_page_that_takes_long_to_build_is_asked_for_rarely(tmp_path: Path) -> None:
    write_run(tmp_path / "run", rows=ROWS)
    clock = iter([10.0, 10.5])
    assert json.loads(Answers(tmp_path / "run", lambda: next(clock)).newest())["refresh_s"] == 25


def test_nothing_is_built_while_nothing_is_new(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", rows=ROWS)
    answers = Answers(folder)
    first = answers.newest()
    assert answers.newest() is first
    write_rows(folder, [*ROWS, {"agent_steps": 300, "wall_s": 3.0, "return_mean": 9.0}])
    assert json.loads(answers.newest())["data"]["runs"][0]["columns"]["return_mean"] == [1, 2, 9]


def test_a_port_that_is_taken_is_refused(tmp_path: Path) -> None:
    with dashboard(LogConfig(dashboard=True), tmp_path) as url:
        port = int(str(url).rstrip("/").rpartition(":")[2])
        taken = LogConfig(dashboard=True, dashboard_port=port)
        with pytest.raises(ConfigError, match=rf"log\.dashboard_port={port} cannot be had \(Address already"):
            with dashboard(taken, tmp_path):
                pass
    with pytest.raises(ConfigError, match="dashboard_port"):
        LogConfig(dashboard_port=0)
    with dashboard(LogConfig(), tmp_path) as nothing:
        assert nothing is None


def test_a_port_without_a_dashboard_is_refused() -> None:
    lines = ["env=Basic", "log.dashboard_port=8000"]
    with pytest.raises(
        ConfigError, match=r"log\.dashboard_port=8000 has no effect without log\.dashboard=true"
    ):
        check_effect(lines, [compose_config(lines).config])
    check_effect(lines, [compose_config([*lines, "log.dashboard=true"]).config])


def test_a_training_run_is_followed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    from mappo_unity.api import train

    seen = []

    def look(state: Any) -> None:
        address = re.search(r"dashboard: (\S+)", capfd.readouterr().out)
        if address:
            seen.append(address[1])
        if seen and state.iteration == 2:
            seen.append(json.loads(get(f"{seen[0]}data.json")[1]))

    lines = ["env=Basic", "collect.batch_size=32", "max_steps=64", "log.loggers=[]", "export_onnx=false"]
    train(
        *lines, "log.dashboard=true", f"hydra.run.dir={tmp_path / 'run'}", progress=True, after_iteration=look
    )
    url, answer = seen
    assert answer["data"]["runs"][0]["columns"]["agent_steps"] == [32, 64]
    with pytest.raises(urllib.error.URLError):
        get(url)


# Mistakes


@pytest.mark.parametrize("main", [plot_main, report_main])
def test_what_is_no_run_is_told(main: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    write_run(tmp_path / "young")
    damaged = write_run(tmp_path / "damaged")
    (damaged / "metrics.csv").write_text("agent_steps,a\n1,x\n")
    out = f"out={tmp_path}/a.{'png' if main is plot_main else 'html'}"
    for lines, message in [
        ([], "no run is named"),
        ([f"{tmp_path}/gone"], r"gone does not exist; newest runs"),
        ([f"{tmp_path}/empty"], r"empty is no run folder, and there is none below it: .*config\.yaml"),
        ([f"{tmp_path}/young"], r"young: no metrics yet; metrics\.csv is written after"),
        ([f"{tmp_path}/damaged"], r"metrics\.csv, line 2: 'x' is not a number"),
        ([f"{tmp_path}/young", "colour=red"], "colour is not an option; choices: runs, "),
        ([out, f"{tmp_path}/young"], "stands behind out=.*the runs come first"),
    ]:
        assert main([*lines, out] if out not in lines else lines) == 2
        assert re.search(message, capsys.readouterr().err), message


def test_mistakes_of_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    run = str(write_run(tmp_path / "run", rows=ROWS))
    for line, message in [
        ("x=foo", "x must be one of decisions, time"),
        (
            "metric=retrun_mean",
            r"no run has numbers of it \(did you mean return_mean\?\); choices: return_mean$",
        ),
        ("metric=", "metric"),
        (f"out={tmp_path}/a.pdf", r"must end in \.png or \.svg"),
        (f"out={tmp_path}/no/a.png", "there is no folder"),
    ]:
        assert plot_main([run, line]) == 2
        assert re.search(message, capsys.readouterr().err, re.MULTILINE), message


def test_a_picture_without_matplotlib_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from mappo_unity.reports import figure

    monkeypatch.setattr(figure.importlib.util, "find_spec", lambda name: None)
    assert plot_main([str(tmp_path), f"out={tmp_path}/a.png"]) == 2
    error = capsys.readouterr().err
    assert "needs matplotlib, which is not installed" in error and "plot" in error


def test_mistakes_of_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = (str(write_run(tmp_path / name, rows=ROWS)) for name in ("a", "b"))
    (tmp_path / "folder.html").mkdir()
    for lines, message in [
        ([one, two], "out= is not given: of 2 folders none is the page's own"),
        ([one, f"out={tmp_path}/page.txt"], r"must end in \.html"),
        ([one, f"out={tmp_path}/folder.html"], "is a folder: name a file in it"),
        ([one, f"out={tmp_path}/no/page.html"], "there is no folder"),
    ]:
        assert report_main(lines) == 2
        assert re.search(message, capsys.readouterr().err), message


def test_a_page_that_cannot_be_written_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*arguments: Any) -> None:
        raise PermissionError(13, "Permission denied")

    run = str(write_run(tmp_path / "run", rows=ROWS))
    monkeypatch.setattr(os, "replace", refuse)
    assert report_main([run]) == 2
    assert re.search(r"out=.*report\.html cannot be written \(Permission denied\)", capsys.readouterr().err)
