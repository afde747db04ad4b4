"""A sweep of real trainings, each on a player of its own."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mappo_unity.cli.player import run as player_main

COMMAND = "import sys; from mappo_unity.cli import train_main; sys.exit(train_main())"


@pytest.mark.slow
def test_four_jobs_two_at_a_time_fight_over_no_port(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    player_main(["build", "3DBall", str(tmp_path)])
    player = ["env=3DBall", "env.backend=player", f"env.file_name={tmp_path / '3DBall'}", "env.num_areas=12"]
    small = ["max_steps=6000", "collect.batch_size=2048", "log.loggers=[]", "log.progress=false"]
    sweep = ["-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1,2,3"]
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, *sweep, *player, *small],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "outputs" / "multirun" / "3DBall").iterdir()
    with (folder / "results.csv").open(newline="") as file:
        assert sorted((row["seed"], row["status"]) for row in csv.DictReader(file)) == [
            (str(seed), "finished") for seed in range(4)
        ]
    for job in range(4):
        with (folder / str(job) / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert int(float(rows[-1]["agent_steps"])) >= 6000
        assert {float(row["restarts"]) for row in rows} == {0.0}
        assert [log.name for log in (folder / str(job) / "players").glob("*.log")] == ["Player-0.log"]
