"""Sweeps whose jobs submitit starts: on this machine here, in SLURM elsewhere; one that is started again."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from test_sweep import only_sweep, results, start_with_fake_training
from test_workers import SMALL, children, wait_for

from mappo_unity.cli import train_main
from mappo_unity.runs.metrics_csv import read_metrics

LOCAL = "hydra/launcher=submitit_local"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="submitit runs elsewhere")


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
def test_jobs_of_submitit_have_folders_and_a_table(tmp_path: Path) -> None:
    process = start_with_fake_training(tmp_path, LOCAL, "seed=0,13")
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1, errors
    rows = results(only_sweep())
    assert [(row["seed"], row["status"]) for row in rows] == [("0", "finished"), ("13", "failed")]
    assert "unlucky" in errors and "Traceback" not in errors
    (said,) = [path.read_text() for path in only_sweep().rglob("*_log.out") if "seed=0" in path.read_text()]
    assert "[job 0] half way beside others\n" in said


@pytest.mark.skipif(shutil.which("srun") is not None, reason="a machine of a SLURM cluster")
def test_without_slurm_a_sweep_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-m", "hydra/launcher=submitit_slurm", "seed=0,1"]) == 2
    said = capsys.readouterr().err
    assert "the sweep cannot start: " in said and "srun" in said and said.count("\n") == 1
    assert not Path("outputs").exists()


@pytest.mark.slow
def test_a_job_that_is_started_again_goes_on_from_its_checkpoint() -> None:
    lines = ["env=3DBall", "env.num_areas=2", "collect.rounds=64", *SMALL, "seed=0,1", "max_steps=6400"]
    code = "import sys; from mappo_unity.cli import train_main; sys.exit(train_main(sys.argv[1:]))"
    sweep = subprocess.Popen([sys.executable, "-c", code, "-m", LOCAL, *lines])
    try:
        wait_for(lambda: len(list(Path().rglob("1/checkpoints/step_*.pt"))) > 1)
        (metrics,) = Path().rglob("1/metrics.csv")
        (task,) = {pid for pid in tasks(sweep.pid) if f"/{metrics.parent}" in opened(pid)}
        os.kill(task, signal.SIGUSR2)  # as SLURM does before the time is over
        assert sweep.wait(300) == 0
    finally:
        sweep.kill()

    rows = results(only_sweep())
    assert [row["status"] for row in rows] == ["finished", "finished"]
    assert [row["iteration"] for row in read_metrics(metrics)] == [*range(1, 6400 // 128 + 1)]
    said = [path.read_text() for path in only_sweep().rglob("*_log.out")]
    assert sorted(text.count("resuming from") for text in said) == [0, 1]


def tasks(pid: int) -> list[int]:
    """Return the processes of submitit's jobs below a process."""
    return [task for controller in children(pid) for task in children(controller)]


def opened(pid: int) -> str:
    """Return the files that a process has open, one a line."""
    names = []
    for file in Path(f"/proc/{pid}/fd").iterdir():
        try:
            names.append(os.readlink(file))
        except OSError:
            continue
    return "\n".join(names)
