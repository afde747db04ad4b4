"""Metrics out of a run: files read back with independent readers, kills at every byte, the progress line."""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from mappo_unity.config.extras import install_command
from mappo_unity.config.schema import LogConfig, LoggerKind
from mappo_unity.errors import ConfigError
from mappo_unity.runs.logger import RunLog, read_metrics
from mappo_unity.runs.metrics_csv import MetricsFile, keep_until
from mappo_unity.runs.progress import Progress, describe, job_of_sweep

NAN = math.nan
TENSORBOARD = LogConfig(loggers=[LoggerKind.tensorboard], progress=False)
CSV_ONLY = LogConfig(loggers=[], progress=False)


def row(iteration: int, **more: Any) -> dict[str, Any]:
    """Return a row as the trainer logs it: 100 agent steps an iteration."""
    return {
        "iteration": iteration,
        "agent_steps": 100 * iteration,
        "return_mean": NAN if iteration == 1 else 10.0 * iteration,
        "episode_length_mean": 50.5,
        "steps_per_s": 1000.0,
        **more,
    }


def write(folder: Path, iterations: range, cfg: LogConfig = TENSORBOARD, **options: Any) -> None:
    with RunLog(cfg, folder, 1000, **options) as log:
        for iteration in iterations:
            log.log(row(iteration))


def read_events(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return every scalar event of a run by tag, with tensorboard's own loader, repeated ones included."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader
    from tensorboard.util.tensor_util import make_ndarray

    curves: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for path in sorted((folder / "tensorboard").iterdir()):
        assert "tfevents" in path.name, f"left over: {path}"
        for event in EventFileLoader(str(path)).Load():
            for value in event.summary.value:
                curves[value.tag].append((event.step, float(make_ndarray(value.tensor))))
    return {tag: sorted(points) for tag, points in curves.items()}


def steps_of(folder: Path) -> list[int | float]:
    return [entry["agent_steps"] for entry in read_metrics(folder / "metrics.csv")]


# metrics.csv


def test_csv_is_what_the_standard_reader_says(tmp_path: Path) -> None:
    write(tmp_path, range(1, 3), CSV_ONLY)
    with (tmp_path / "metrics.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [
            ["iteration", "agent_steps", "return_mean", "episode_length_mean", "steps_per_s"],
            ["1", "100", "nan", "50.5", "1000.0"],
            ["2", "200", "20.0", "50.5", "1000.0"],
        ]


def test_floats_come_back_to_the_bit_and_integers_as_integers(tmp_path: Path) -> None:
    import numpy as np

    values = {
        "agent_steps": np.int64(7),
        "a": 0.1 + 0.2,
        "b": np.float32(0.1),
        "c": 1e-300,
        "d": -math.inf,
        "e": -3,
    }
    with RunLog(CSV_ONLY, tmp_path, 10) as log:
        log.log(values)
    (back,) = read_metrics(tmp_path / "metrics.csv")
    assert back == {**values, "b": 0.10000000149011612}
    assert isinstance(back["agent_steps"], int) and isinstance(back["e"], int)


def test_every_row_is_on_file_at_once(tmp_path: Path) -> None:
    with RunLog(TENSORBOARD, tmp_path, 1000) as log:
        for iteration in range(1, 4):
            log.log(row(iteration))
            assert steps_of(tmp_path) == [100 * i for i in range(1, iteration + 1)]
            assert len(read_events(tmp_path)["steps_per_s"]) == iteration


def test_new_columns_rewrite_the_file_with_the_union(tmp_path: Path) -> None:
    with RunLog(CSV_ONLY, tmp_path, 1000) as log:
        log.log({"agent_steps": 1, "a": 1.5})
        log.log({"agent_steps": 2, "b,c": 2.5})
        log.log({"a": 3.5, "agent_steps": 3})
    assert (tmp_path / "metrics.csv").read_text() == 'agent_steps,a,"b,c"\n1,1.5,\n2,,2.5\n3,3.5,\n'
    assert read_metrics(tmp_path / "metrics.csv") == [
        {"agent_steps": 1, "a": 1.5},
        {"agent_steps": 2, "b,c": 2.5},
        {"agent_steps": 3, "a": 3.5},
    ]
    assert os.listdir(tmp_path) == ["metrics.csv"]


def test_full_disk_while_columns_are_added_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = MetricsFile(tmp_path / "metrics.csv")
    file.append({"agent_steps": 1})

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space"):
        file.append({"agent_steps": 2, "new": 1.0})
    assert (tmp_path / "metrics.csv").read_text() == "agent_steps\n1\n"
    assert os.listdir(tmp_path) == ["metrics.csv"]


@pytest.mark.parametrize("cfg", [TENSORBOARD, CSV_ONLY])
def test_a_removed_folder_is_told_in_one_line(
    cfg: LogConfig, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with RunLog(cfg, tmp_path / "run", 1000) as log:
        log.log(row(1))
        shutil.rmtree(tmp_path / "run")
        with pytest.raises(ConfigError, match=r"run folder .*run was removed or moved"):
            log.log(row(2))
    assert not (tmp_path / "run").exists() and capfd.readouterr().err == ""


def test_a_removed_event_folder_is_told_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    hook = threading.excepthook
    with RunLog(TENSORBOARD, tmp_path, 1000) as log:
        log.log(row(1))
        shutil.rmtree(tmp_path / "tensorboard")
        with pytest.raises(ConfigError, match=r"metrics in .* cannot be written \(No such file"):
            log.log(row(2))
    assert threading.excepthook is hook and capfd.readouterr().err == ""


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise OSError(28, "No space left on device")

    with RunLog(CSV_ONLY, tmp_path, 1000) as log:
        log.log(row(1))
        monkeypatch.setattr(MetricsFile, "append", fail)
        monkeypatch.setattr(MetricsFile, "close", fail)
        with pytest.raises(ConfigError, match=r"No space left on device\), and there is no checkpoint yet"):
            log.log(row(2))
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / "step_000000000001.pt").touch()
        with pytest.raises(ConfigError, match=r"No space left on device.*resume with resume="):
            log.log(row(2))


def test_damaged_csv_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_text("agent_steps,a\n1,2\n2,x\n")
    with pytest.raises(ValueError, match=r"metrics\.csv, line 3: 'x' is not a number"):
        read_metrics(path)
    path.write_text("agent_steps,a\n1\n2,3\n")
    with pytest.raises(ValueError, match="line 2: 1 cells, the header has 2"):
        read_metrics(path)
    with pytest.raises(FileNotFoundError, match=r"none\.csv"):
        read_metrics(tmp_path / "none.csv")


def test_a_new_run_does_not_write_into_an_old_one(tmp_path: Path) -> None:
    write(tmp_path, range(1, 3), CSV_ONLY)
    before = (tmp_path / "metrics.csv").read_bytes()
    with pytest.raises(ConfigError, match=r"metrics\.csv exists already.*resume="):
        RunLog(CSV_ONLY, tmp_path, 1000)
    assert (tmp_path / "metrics.csv").read_bytes() == before


# Resume


def test_resumed_run_has_the_rows_of_an_undisturbed_one(tmp_path: Path) -> None:
    both = LogConfig(loggers=[LoggerKind.csv, LoggerKind.tensorboard], progress=False)
    write(tmp_path / "whole", range(1, 7), both)
    write(tmp_path / "resumed", range(1, 6), both)
    write(tmp_path / "resumed", range(4, 7), both, resume_steps=300)
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    assert (resumed / "metrics.csv").read_bytes() == (whole / "metrics.csv").read_bytes()
    assert read_events(resumed) == read_events(whole)
    assert read_events(resumed)["return_mean"] == [(s, s / 10) for s in (200, 300, 400, 500, 600)]
    scalars = sorted(path.name for path in (whole / "csv" / "scalars").iterdir())
    assert "return_mean.csv" in scalars
    for name in scalars:
        assert (resumed / "csv/scalars" / name).read_bytes() == (whole / "csv/scalars" / name).read_bytes()


def test_resuming_at_the_last_row_changes_no_byte(tmp_path: Path) -> None:
    write(tmp_path, range(1, 4))
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    before = {path: (path.read_bytes(), path.stat().st_ino) for path in files}
    keep_until(tmp_path, 300)
    assert {path: (path.read_bytes(), path.stat().st_ino) for path in files} == before


def test_resuming_before_the_first_row_keeps_none(tmp_path: Path) -> None:
    write(tmp_path, range(1, 4))
    write(tmp_path, range(1, 2), resume_steps=0)
    assert steps_of(tmp_path) == [100]
    assert read_events(tmp_path)["steps_per_s"] == [(100, 1000.0)]


def test_resuming_without_files_begins_them(tmp_path: Path) -> None:
    write(tmp_path, range(4, 6), resume_steps=300)
    assert steps_of(tmp_path) == [400, 500]


def test_a_cut_at_any_byte_is_mended(tmp_path: Path) -> None:
    """A kill can end a file anywhere: what was whole up to the checkpoint stays, nothing else does."""
    whole = tmp_path / "whole"
    write(whole, range(1, 4))
    table = (whole / "metrics.csv").read_bytes()
    (event_file,) = (whole / "tensorboard").iterdir()
    events = event_file.read_bytes()
    line_ends = [i + 1 for i, byte in enumerate(table) if byte == ord("\n")]
    folder = tmp_path / "cut"
    for cut in range(len(table)):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / "metrics.csv").write_bytes(table[:cut])
        assert len(read_metrics(folder / "metrics.csv")) == max(sum(end <= cut for end in line_ends) - 1, 0)
        write(folder, range(9, 10), CSV_ONLY, resume_steps=200)
        complete = sum(end <= cut for end in line_ends) - 1
        assert steps_of(folder) == [*[100, 200][: max(complete, 0)], 900], cut
    (folder / "tensorboard").mkdir()
    target = folder / "tensorboard" / event_file.name
    lengths = set()
    for cut in range(len(events)):
        target.write_bytes(events[:cut])
        keep_until(folder, 200)
        lengths.add(target.stat().st_size)
        assert events.startswith(target.read_bytes())
        assert len(target.read_bytes()) <= cut
        if cut % 50 == 0:
            read_events(folder)  # tensorboard reads what is left without a complaint
    # No record, the file's version, 3 scalars of the first row (its return is NaN), 4 of the second.
    assert len(lengths) == 1 + 1 + 3 + 4


def test_damaged_event_file_keeps_what_stands_before_the_damage(tmp_path: Path) -> None:
    write(tmp_path, range(1, 4))
    (path,) = (tmp_path / "tensorboard").iterdir()
    data = path.read_bytes()
    for zeroed in (len(data) // 2, len(data) // 2 + 7, len(data) - 30):
        path.write_bytes(data[:zeroed] + bytes(len(data) - zeroed))
        keep_until(tmp_path, 300)
        assert 0 < path.stat().st_size < zeroed + 16
        assert data.startswith(path.read_bytes()[:zeroed])


@pytest.mark.parametrize("garbage", ["xxx,,,", "1", 'a"b', "\x00\xff", "", "4,oops,1,2,3", "7,,1,2,3"])
@pytest.mark.parametrize("at", [2, 4])
def test_damaged_rows_are_left_out_and_the_file_is_kept(tmp_path: Path, garbage: str, at: int) -> None:
    path = tmp_path / "metrics.csv"
    write(tmp_path, range(1, 4), CSV_ONLY)
    lines = path.read_text().splitlines()
    lines.insert(at, garbage)
    damaged = "\n".join([*lines, ""])
    path.write_text(damaged)
    console, text = plain_console()
    write(tmp_path, range(4, 6), CSV_ONLY, resume_steps=300, console=console)
    assert steps_of(tmp_path) == [100, 200, 300, 400, 500]
    copy = tmp_path / "metrics.csv.damaged"
    assert copy.read_text() == damaged
    assert text.getvalue() == (
        f"{path}: 1 damaged line (line {at + 1}) left out; the file as it was: {copy}\n"
    )
    path.write_text(path.read_text() + "x\nx\n")
    (note,) = keep_until(tmp_path, 500)
    assert "2 damaged lines (line 7 to 8)" in note
    assert sorted(os.listdir(tmp_path)) == ["metrics.csv", "metrics.csv.damaged", "metrics.csv.damaged1"]


def test_a_table_without_steps_is_set_aside(tmp_path: Path) -> None:
    (tmp_path / "metrics.csv").write_text("garbage\n100,1\n")
    write(tmp_path, range(4, 6), CSV_ONLY, resume_steps=300, console=plain_console()[0])
    assert steps_of(tmp_path) == [400, 500]
    assert (tmp_path / "metrics.csv.damaged").read_text() == "garbage\n100,1\n"


def test_damaged_scalars_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "csv" / "scalars" / "return_mean.csv"
    path.parent.mkdir(parents=True)
    path.write_text("100,1.0\nxxx\n200,2.0\n300,3.0\n40")
    (note,) = keep_until(tmp_path, 200)
    assert path.read_text() == "100,1.0\n200,2.0\n" and "line 2" in note
    assert keep_until(tmp_path, 200) == []


def test_killed_writer_loses_no_row(tmp_path: Path) -> None:
    """kill -9 right after `log` returned: the row is in both files, and the next run appends to it."""
    code = f"""
import os, signal
from pathlib import Path
from mappo_unity.config.schema import LoggerKind, LogConfig
from mappo_unity.runs.logger import RunLog
log = RunLog(LogConfig(loggers=[LoggerKind.tensorboard], progress=False), Path({str(tmp_path)!r}), 1000)
for i in range(1, 6):
    log.log({{"iteration": i, "agent_steps": 100 * i, "x": i / 2}})
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == -signal.SIGKILL
    assert read_events(tmp_path)["x"] == [(100 * i, i / 2) for i in range(1, 6)]
    write(tmp_path, range(5, 7), resume_steps=400)
    assert steps_of(tmp_path) == [100, 200, 300, 400, 500, 600]
    assert [step for step, _ in read_events(tmp_path)["iteration"]] == [100, 200, 300, 400, 500, 600]


# Loggers


def test_events_hold_the_numbers_without_nan(tmp_path: Path) -> None:
    write(tmp_path, range(1, 4))
    curves = read_events(tmp_path)
    assert set(curves) == {"iteration", "return_mean", "episode_length_mean", "steps_per_s"}
    assert curves["return_mean"] == [(200, 20.0), (300, 30.0)]
    assert curves["episode_length_mean"] == [(100, 50.5), (200, 50.5), (300, 50.5)]


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_missing_logger_names_the_extra(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda package: None)
    with pytest.raises(ConfigError, match=rf"log\.loggers has {name}") as caught:
        RunLog(LogConfig(loggers=[LoggerKind[name]]), tmp_path / "run", 1000)
    assert install_command(name) in str(caught.value)
    assert not (tmp_path / "run").exists()


def test_wandb_offline_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    cfg = LogConfig(loggers=[LoggerKind.wandb], progress=False)
    write(tmp_path, range(1, 3), cfg)
    name = (tmp_path / "wandb_id").read_text()
    write(tmp_path, range(3, 4), cfg, resume_steps=200)
    assert (tmp_path / "wandb_id").read_text() == name
    assert len(list((tmp_path / "wandb").rglob(f"run-{name}.wandb"))) == 2


def test_mlflow_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    cfg = LogConfig(loggers=[LoggerKind.mlflow], progress=False, project="balls")
    write(tmp_path / "run", range(1, 4), cfg)
    assert mlflow.active_run() is None
    (run,) = mlflow.search_runs(experiment_names=["balls"], output_format="list")
    history = mlflow.MlflowClient().get_metric_history(run.info.run_id, "return_mean")
    assert [(metric.step, metric.value) for metric in history] == [(200, 20.0), (300, 30.0)]


def test_importing_the_log_leaves_torch_alone() -> None:
    code = "import sys, mappo_unity.runs.logger; print('torch' in sys.modules, 'tensorboard' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout.split() == ["False", "False"], done.stderr


# Progress


def test_progress_line_by_hand() -> None:
    line = describe(row(3, return_mean=12.346, steps_per_s=41230.4), 1000, steps_per_s=0.1)
    assert line == "300/1,000 steps  41,230/s  return 12.35  length 50  1:56:40 left"  # 700 steps / 0.1 per s


def test_progress_line_before_an_episode_has_ended() -> None:
    line = describe({"agent_steps": 1, "return_mean": NAN, "episode_length_mean": NAN}, 10, NAN)
    assert line == "1/10 steps  -/s  return -  length -  - left"


def test_progress_line_of_a_million_steps_fits_eighty_columns() -> None:
    values = {
        "agent_steps": 1_000_000,
        "steps_per_s": 123_456.0,
        "return_mean": 100.0,
        "episode_length_mean": 1000.0,
    }
    assert len(describe(values, 1_000_000, 277.0)) < 80


class Clock:
    """A clock that the test sets, in seconds."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def plain_console() -> tuple[Console, io.StringIO]:
    text = io.StringIO()
    return Console(file=text, width=200), text


def test_without_a_terminal_lines_are_seldom_and_the_last_is_there() -> None:
    console, text = plain_console()
    clock = Clock()
    progress = Progress(console, 1000, clock)
    for iteration in range(1, 11):  # one row every 0.5 s: 0.5, 2.5, 4.5 s, and the last, at 5 s
        clock.now = iteration * 0.5
        progress.update(row(iteration))
    progress.close()
    progress.close()
    assert [line.split("/")[0] for line in text.getvalue().splitlines()] == ["100", "500", "900", "1,000"]


def test_the_lines_of_a_job_name_it(tmp_path: Path) -> None:
    console, text = plain_console()
    with (
        job_of_sweep(3, is_beside_others=False),
        RunLog(LogConfig(loggers=[]), tmp_path, 1000, console=console) as log,
    ):
        log.message("run folder: here")
        log.log(row(1))
    first, second = text.getvalue().splitlines()
    assert first == "[job 3] run folder: here" and second.startswith("[job 3] 100/1,000 steps")


def test_jobs_side_by_side_update_no_line_in_place() -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=100, _environ={"TERM": "xterm"})
    with job_of_sweep(3, is_beside_others=True):
        progress = Progress(console, 1000)
    progress.update(row(1))
    progress.close()
    assert text.getvalue().startswith("[job 3] 100/1,000 steps") and "\x1b" not in text.getvalue()


def time_left(*rows: tuple[float, int]) -> str:
    """Return what the last line says is left of 10,000 steps after rows of seconds and steps."""
    console, text = plain_console()
    clock = Clock()
    progress = Progress(console, 10_000, clock)
    for seconds, steps in rows:
        clock.now = seconds
        progress.update({"agent_steps": steps})
    return text.getvalue().splitlines()[-1].split("  ")[-1]


def test_time_left_is_reckoned_from_the_last_five_minutes() -> None:
    slow, then = (0, 0), [(1000 + 100 * place, 100 + 1000 * place) for place in range(4)]
    assert time_left(slow, *then) == "11:30 left"  # 6900 at 10 a second


def test_matches_between_two_rows_hardly_lengthen_the_time_left() -> None:
    steady = [(10.0 * place, 200 * place) for place in range(1, 21)]
    assert time_left(*steady) == "5:00 left"  # 6000 at 20 a second
    # a series took 60 s: 5800 steps at 4000 in 260 s
    assert time_left(*steady, (270.0, 4200)) == "6:17 left"


def test_on_a_terminal_one_line_is_updated_and_messages_stand_above(tmp_path: Path) -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=True, width=100, _environ={"TERM": "xterm"})
    cfg = LogConfig(loggers=[])
    with RunLog(cfg, tmp_path, 1000, console=console) as log:
        log.log(row(1))
        log.message("rolled back [an update] 100% of 3")
        log.log(row(2))
    raw = text.getvalue()
    assert show(raw) == [
        "rolled back [an update] 100% of 3",
        "200/1,000 steps  1,000/s  return 20.00  length 50",
    ]
    assert raw.rindex("\x1b[?25h") > raw.rindex("\x1b[?25l")  # the cursor is shown again


def show(raw: str) -> list[str]:
    """Return the lines a terminal shows after this output (moves and erasures of whole lines only)."""
    lines, at = [""], 0
    rest = raw
    while rest:
        for code, rows in (("\x1b[1A", -1), ("\n", 1)):
            if rest.startswith(code):
                at += rows
                lines += [""] * (at + 1 - len(lines))
                rest = rest[len(code) :]
                break
        else:
            if rest.startswith("\x1b[2K"):
                lines[at], rest = "", rest[4:]
            elif rest.startswith("\x1b[?25"):
                rest = rest[6:]
            else:
                if rest[0] != "\r":
                    lines[at] += rest[0]
                rest = rest[1:]
    return [line.rsplit("  ", 1)[0] if " left" in line else line.rstrip() for line in lines if line.strip()]


def test_progress_off_prints_nothing_but_messages(tmp_path: Path) -> None:
    console, text = plain_console()
    with RunLog(CSV_ONLY, tmp_path, 1000, console=console) as log:
        log.log(row(1))
        log.message("a line")
    assert text.getvalue() == "a line\n"


def test_closing_twice_and_after_an_error(tmp_path: Path) -> None:
    console, text = plain_console()
    log = RunLog(LogConfig(loggers=[LoggerKind.tensorboard]), tmp_path, 1000, console=console)
    with pytest.raises(RuntimeError, match="from the loop"), log:
        log.log(row(1))
        log.log(row(2))
        raise RuntimeError("from the loop")
    log.close()
    assert len(text.getvalue().splitlines()) == 2
    assert steps_of(tmp_path) == [100, 200]
