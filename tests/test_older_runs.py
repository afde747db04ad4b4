"""What was made before the rooms still works: a run resumes and is evaluated, a player folder starts.

``data/run_of_0_1_0`` is a run folder that version 0.1.0 wrote: Basic, two agents, networks of four units.
"""

import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.cli import eval_main, train_main

OLDER = Path(__file__).parent / "data" / "run_of_0_1_0"


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(OLDER, tmp_path / "run")
    return tmp_path / "run"


def test_an_older_run_is_resumed(run, capfd):
    assert train_main(["resume=run", "max_steps=128"]) == 0
    assert "finished: 128 agent steps" in capfd.readouterr().out
    with (run / "metrics.csv").open(newline="") as file:
        assert [row["agent_steps"] for row in csv.DictReader(file)] == ["32", "64", "96", "128"]


def test_an_older_checkpoint_is_evaluated(run, capfd):
    assert eval_main([f"run={run}", "episodes=3"]) == 0
    figures = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert figures["episodes"] == 3 and figures["agent_steps"] == 64


def test_what_an_older_player_folder_starts_is_there():
    command = [sys.executable, "-m", "mappo_unity.player", "3DBall", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "mappo-player SCENE" in done.stdout
