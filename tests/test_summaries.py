"""What an evaluation's table says for people, and its JSON line for programs."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from mappo_unity.cli.summaries import console, eval_table, json_line

RESULT = {
    "policy": "best.pt",
    "behaviors": {
        "Small?team=0": {"episodes": 8, "stderr": 0.25, "interrupted": 0.625},
        "Big?team=0": {"episodes": 8, "stderr": 0.5, "interrupted": 1.0},
    },
}


def printed(result: dict) -> str:
    text = io.StringIO()
    Console(file=text, width=120).print(eval_table(result))
    return text.getvalue()


def test_a_share_is_no_count() -> None:
    text = printed(RESULT)
    rows = [" ".join(line.strip("│┃ ").split()) for line in text.splitlines()]
    assert "behaviors.Small?team=0.ended by the time limit │ 62.5 %" in rows
    assert "behaviors.Big?team=0.ended by the time limit │ 100 %" in rows
    assert "behaviors.Big?team=0.standard error of the mean │ 0.5" in rows
    assert "interrupted" not in text
    matches = printed({"won_of_decided": 0.5, "won_of_decided_low95": float("nan")})
    assert "50 %" in matches and "-" in matches


def test_an_option_is_called_as_it_is_set() -> None:
    text = printed({"env.params": {"ball_touch": 0.1}, "mean_return": 2.0})
    assert "env.params.ball_touch" in text and "mean return" in text


def test_a_path_is_whole_in_a_narrow_terminal() -> None:
    path = "outputs/3DBall/2026-11-23_05-10-46/checkpoints/best.pt"
    text = io.StringIO()
    Console(file=text, width=60).print(eval_table({"policy": path, "agent_steps": 204800}))
    values = [line.split("│")[2].strip() for line in text.getvalue().splitlines() if line.count("│") == 3]
    assert "".join(values) == f"{path}204,800"


def test_brackets_and_colons_of_a_user_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    console().print(
        eval_table({"policy": "runs/[a]/[/b].pt", "opponent": "[random]", "env.params": {":cat:": 1}})
    )
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("runs/[a]/[/b].pt", "[random]", "env.params.:cat:"))


def test_programs_read_the_same_names_as_before() -> None:
    assert json.loads(json_line(RESULT))["behaviors"]["Big?team=0"]["interrupted"] == 1.0
