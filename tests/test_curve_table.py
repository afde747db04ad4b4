"""scripts/curve_table.py: the curves of runs as tables."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import curve_table

ROWS = [(100, 1.0), (200, 3.0), (300, "nan"), (400, 600.0), (500, 6.0)]


def write(run: Path, rows: list[tuple[int, object]] = ROWS) -> Path:
    """Write metrics of a run that took a minute for each row."""
    run.mkdir()
    lines = [f"{steps},{value},{60 * number}" for number, (steps, value) in enumerate(rows, 1)]
    (run / "metrics.csv").write_text("\n".join(["agent_steps,return_mean,wall_s", *lines]) + "\n")
    return run


def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> str:
    monkeypatch.setattr(sys, "argv", ["curve_table.py", *map(str, words)])
    curve_table.main()
    return capsys.readouterr().out


def test_a_window_has_the_mean_of_its_rows_and_the_minutes_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = printed(monkeypatch, capsys, 200, write(tmp_path / "a"), "--metrics", "return_mean").splitlines()
    assert lines[0] == "| a | 0.00 M | 0.00 M | 0.00 M |"
    assert lines[2:] == ["| return_mean | 2 | 600 | 6 |", "| minutes | 2 | 4 | 5 |"]


@pytest.mark.parametrize(
    ("size", "counts"),
    [
        (100, [1, 1, 1, 1, 1]),
        (150, [1, 2, 2]),
        (250, [2, 3]),
        (400, [5]),
        (500, [5]),
        (1000, [5]),
        (2000, [5]),
    ],
)
def test_what_is_left_over_is_a_window_from_half_of_one_on(size: float, counts: list[int]) -> None:
    rows = [{"agent_steps": steps} for steps, _ in ROWS]
    assert [len(part) for part in curve_table.windows(rows, size)] == counts


def test_a_window_without_a_value_has_a_dash(tmp_path: Path) -> None:
    rows = curve_table.read_metrics(write(tmp_path / "a") / "metrics.csv")
    assert curve_table.table("a", rows, 100, ["return_mean"])[2] == "| return_mean | 1 | 3 | - | 600 | 6 |"


def test_a_metric_may_begin_later_and_stand_in_few_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [(100, ""), (200, 0.5), (300, ""), (400, 999.6)]
    lines = printed(monkeypatch, capsys, 100, write(tmp_path / "a", rows), "--metrics", "return_mean")
    assert lines.splitlines()[2] == "| return_mean | - | 0.5 | - | 1,000 |"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("1e6", "RUN", "--metrics", "nope"), "has no column nope; it has agent_steps, return_mean, wall_s"),
        (("1e6", "EMPTY"), "does not exist, or holds no metrics yet"),
        (("0", "RUN"), "a window of 0 must be 1 decision or more"),
        (("nan", "RUN"), "a window of nan must be 1 decision or more"),
    ],
)
def test_a_mistake_is_told_in_a_line(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    runs = {"RUN": write(tmp_path / "a"), "EMPTY": write(tmp_path / "b", [])}
    with pytest.raises(SystemExit) as ended:
        printed(monkeypatch, capsys, *(runs.get(word, word) for word in words))
    assert ended.value.code == 2
    assert said in capsys.readouterr().err
