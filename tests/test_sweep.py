"""Sweeps: one folder a job, a table, failures that stay alone, the plugins."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import fake_training
import pytest

from mappo_unity.cli import train_main
from mappo_unity.config.compose import compose_config, load_config
from mappo_unity.errors import ConfigError
from mappo_unity.training import sweep_signals as stopping
from mappo_unity.training.plan import plan_jobs
from mappo_unity.training.sweep import run_sweep


@pytest.fixture(autouse=True)
def _training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "mappo_unity.training.trainer", fake_training)
    monkeypatch.chdir(tmp_path)


def only_sweep(name: str = "3DBall") -> Path:
    (folder,) = Path("outputs/multirun", name).iterdir()
    return folder


def results(folder: Path) -> list[dict[str, str]]:
    with (folder / "results.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_grid_runs_every_combination_and_ranks_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-m", "seed=0,1", "ppo.lr=1e-4,3e-4", "env.params.mass=2"]) == 0
    folder = only_sweep()
    rows = results(folder)
    assert [(row["seed"], row["ppo.lr"]) for row in rows] == [
        ("1", "0.0001"),
        ("1", "0.0003"),
        ("0", "0.0001"),
        ("0", "0.0003"),
    ]
    assert [float(row["return_mean"]) for row in rows] == pytest.approx([0.9, 0.7, -0.1, -0.3])
    out = capsys.readouterr().out
    assert "best first" in out and str(folder) in out
    assert f"\nreport:       mappo-report {folder}\npicture:      mappo-plot {folder}\n" in out
    assert "\n[job 2] half way\n" in out
    assert out.index("│   2 │ 1") < out.index("│   1 │ 0")
    for number in range(4):
        job = folder / str(number)
        assert {"config.yaml", "overrides.yaml", "versions.json", "result.json"} <= {
            p.name for p in job.iterdir()
        }
    assert json.loads((folder / "3" / "result.json").read_text()) == {
        "job": 3,
        "overrides": ["seed=1", "ppo.lr=0.0003", "env.params.mass=2"],
        "status": "finished",
        "return_mean": 0.7,
        "agent_steps": 400_000,  # the preset of 3DBall
        "wall_s": 0.5,
        "error": None,
    }


def test_a_failed_job_stops_no_other(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-m", "seed=13,5"]) == 1
    rows = results(only_sweep())
    assert [(row["seed"], row["status"]) for row in rows] == [("5", "finished"), ("13", "failed")]
    assert "unlucky" in rows[1]["error"]
    assert "RuntimeError: unlucky" in capsys.readouterr().err
    assert "unlucky" in (only_sweep() / "0" / "error.txt").read_text()


def test_a_sweep_in_which_nothing_trained_has_no_report(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-m", "seed=13"]) == 1
    out = capsys.readouterr().out
    assert f"sweep folder: {only_sweep()}\n" in out and "mappo-report" not in out


def test_a_signal_ends_the_sweep(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-m", "seed=0,15,2"]) == 143
    status = {row["seed"]: row["status"] for row in results(only_sweep())}
    assert status == {"0": "finished", "15": "interrupted", "2": "no result"}


def test_sweeps_never_collide() -> None:
    folders = [run_sweep(["seed=0,1"]).folder for _ in range(3)]
    assert len(set(folders)) == 3
    assert all(len(list(folder.glob("*/result.json"))) == 2 for folder in folders)


def test_a_sweep_over_environments_has_one_folder() -> None:
    lines = ["env=3DBall,custom", "env.factory=builtins:dict"]
    assert run_sweep(lines).exit_code == 0
    names = [(only_sweep("several") / str(job) / "config.yaml").read_text() for job in range(2)]
    assert ["name: 3DBall" in names[0], "name: custom" in names[1]] == [True, True]


def test_a_sweep_over_options_of_a_behavior(capsys: pytest.CaptureFixture[str]) -> None:
    lines = ["behaviors.3DBall.ppo.lr=1e-3,1e-4", "behaviors.3DBall.model.hidden=[8],[4,4]"]
    lines += ["behaviors.3DBall.ppo.optimizer=adamw", "behaviors={3DBall: {ppo: {gamma: 0.9}}}"]
    assert train_main(["-m", *lines]) == 0
    saved = [load_config(only_sweep() / str(job) / "config.yaml").behaviors["3DBall"] for job in range(4)]
    values = [(behavior["ppo"]["lr"], behavior["model"]["hidden"]) for behavior in saved]
    assert values == [(1e-3, [8]), (1e-3, [4, 4]), (1e-4, [8]), (1e-4, [4, 4])]
    assert all(
        (behavior["ppo"]["optimizer"], behavior["ppo"]["gamma"]) == ("adamw", 0.9) for behavior in saved
    )
    columns = ("behaviors.3DBall.ppo.lr", "behaviors.3DBall.model.hidden")
    rows = [tuple(row[column] for column in columns) for row in results(only_sweep())]
    assert sorted(rows) == [("0.0001", "[4,4]"), ("0.0001", "[8]"), ("0.001", "[4,4]"), ("0.001", "[8]")]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["seed=0,x"], ["seed=x", "a whole number"]),
        (["seed=0,1", "ppo.gamma=0.9,7"], ["ppo.gamma=7", "from 0 to 1", "in the job seed=0 ppo.gamma=7"]),
        (["env=3DBall,Nope"], ["env=Nope does not exist"]),
        (["sed=1,2"], ["did you mean seed"]),
        (["seed=0,1", "env.file_name=Game"], ["env.file_name=Game has no effect", "env.backend=player"]),
        (["ppo.lr=interval(1e-4,1e-3)"], ["interval", "mappo-search"]),
        (["resume=x", "seed=1,2"], ["resume cannot be swept"]),
        (["hydra/sweeper=optuna", "seed=1,2"], ["hydra/sweeper=optuna was replaced by mappo-search"]),
        (["hydra/sweeper=ax", "seed=1,2"], ["hydra/sweeper=ax: a sweep is a grid; type mappo-search"]),
    ],
)
def test_wrong_options_start_no_job(
    lines: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(["-m", *lines]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and list(tmp_path.iterdir()) == []
    for word in words:
        assert word in captured.err


def test_a_named_sweep_folder_is_never_overwritten() -> None:
    lines = ["seed=0,1", "hydra.sweep.dir='my sweep'"]
    assert run_sweep(lines).folder == Path("my sweep")
    with pytest.raises(ConfigError, match="my sweep is not empty"):
        run_sweep(lines)


def test_planned_jobs_are_the_combinations() -> None:
    assert plan_jobs(["seed=range(0,3)", "ppo.epochs=2"]).jobs == [
        [f"seed={seed}", "ppo.epochs=2"] for seed in range(3)
    ]


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["seed=range(0,100000)"], ["100,000 jobs (100,000 of seed)", "max_jobs=1000", "max_jobs=100000"]),
        (["seed=range(0,3)", "ppo.epochs=1,2", "max_jobs=5"], ["6 jobs (3 of seed x 2 of ppo.epochs)"]),
        (["seed=range(0,5,0)"], ["seed=range(0,5,0)", "the range has no end"]),
        (["seed=range(0,inf)"], ["the range has no end"]),
        (["seed=range(5,0)"], ["seed=range(5,0) has no value", "empty"]),
        (["seed=range(-1,5)"], ["seed=-1 is out of range"]),
        (["seed=range(0,5,0.5)"], ["seed=0.0 does not fit", "a whole number"]),
        (["seed=glob(*)"], ["glob chooses presets", "seed=a,b,c"]),
        (["hydra.sweeper.max_batch_size=0", "seed=1,2"], ["max_batch_size=0 is out of range", ">= 1"]),
        (["hydra/launcher=basic,joblib"], ["belongs to the sweep itself and has one value"]),
    ],
)
def test_a_grid_that_cannot_be_run_is_refused_at_once(lines: list[str], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        run_sweep(lines)
    assert not Path("outputs").exists()
    for word in words:
        assert word in str(caught.value)


def test_no_processes_are_refused() -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    with pytest.raises(ConfigError, match="hydra.launcher.n_jobs=0 is out of range"):
        run_sweep(["hydra/launcher=joblib", "hydra.launcher.n_jobs=0", "seed=0,1"])


def test_a_long_check_is_announced_and_finds_each_jobs_own_options() -> None:
    said: list[str] = []
    plan = plan_jobs(["env=3DBall,Basic", "seed=range(0,60)", "ppo.epochs=1,2"], say=said.append)
    assert said == ["checking the options of 240 jobs ..."]
    assert len(plan.jobs) == len(plan.configs) == 240
    for job in (0, 1, 119, 120, 239):
        assert plan.configs[job] == compose_config(plan.jobs[job]).config
    plan = plan_jobs(["behaviors={A: {ppo: {lr: 1}}},{}", "ppo.epochs=1,2"])
    assert [(config.ppo.epochs, list(config.behaviors)) for config in plan.configs] == [
        (1, ["A"]),
        (2, ["A"]),
        (1, []),
        (2, []),
    ]
    with pytest.raises(ConfigError, match=r"seed=-1 is out of range.*\(in the job seed=-1 env.num_areas=3"):
        plan_jobs(["seed=0,1,-1", "env.num_areas=3"])


@pytest.mark.parametrize(
    ("lines", "seen"),
    [
        (["env=WallJump", "parameters=WallJump_curriculum", "seed=0,1"], [(0, False, True)] * 2),
        (["env=Walker", "model.memory=lstm", "seed=0,1"], [(1, True, False)] * 2),
        (["env=DungeonEscape", "model.critic=central,poca"], [(0, False, True), (0, False, False)]),
        (["env=Pyramids", "env.num_areas=64,65"], [(2, True, True), (1, True, True)]),
    ],
)
def test_a_presets_options_give_way_in_each_job(lines: list[str], seen: list[tuple[int, bool, bool]]) -> None:
    configs = plan_jobs(lines).configs
    assert [(c.collect.workers, c.collect.overlap, c.model.mirror.use) for c in configs] == seen

    assert train_main(["-m", *lines, "hydra.sweep.dir=swept"]) == 0
    trained = [load_config(Path("swept") / str(number) / "config.yaml") for number in range(len(seen))]
    assert [(c.collect.workers, c.collect.overlap, c.model.mirror.use) for c in trained] == seen


def test_a_sampler_of_the_command_line_is_whole_in_each_job() -> None:
    lines = [
        "env=3DBall",
        "parameters=3DBall_randomize",
        "env.params.mass={sampler: uniform, max: 5}",
        "seed=0,1",
    ]
    assert train_main(["-m", *lines, "hydra.sweep.dir=swept"]) == 0
    masses = [load_config(Path(f"swept/{number}/config.yaml")).env.params["mass"] for number in (0, 1)]
    assert masses == [{"sampler": "uniform", "max": 5}] * 2


def test_presets_are_chosen_by_their_names() -> None:
    jobs = plan_jobs(["recipe=glob(m*)"]).jobs
    assert jobs == [["recipe=mappo_paper"], ["recipe=mlagents"]]


def start_with_fake_training(tmp_path: Path, *lines: str) -> subprocess.Popen[str]:
    """Start a sweep; every process of its interpreter has the fake training in the place of the real one."""
    starter = "import sys, fake_training\nsys.modules['mappo_unity.training.trainer'] = fake_training\n"
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "sitecustomize.py").write_text(starter)
    tests = Path(__file__).resolve().parent
    paths = [str(tmp_path / "start"), str(tests), str(tests.parent)]
    code = "import sys; from mappo_unity.cli import train_main; sys.exit(train_main())"
    return subprocess.Popen(
        [sys.executable, "-c", code, "-m", *lines],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        start_new_session=True,
    )


def interrupt_two_jobs(
    process: subprocess.Popen[str], tmp_path: Path, send: Callable[[int, int], None], number: int
) -> str:
    """Send a signal when two jobs train; return what was written to stderr."""
    try:
        deadline = time.monotonic() + 60
        while len(list(tmp_path.rglob("metrics.csv"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        send(process.pid, number)
        return process.communicate(timeout=60)[1]
    finally:
        process.kill()


@pytest.mark.skipif(os.name != "posix", reason="signals of process groups")
@pytest.mark.parametrize(
    ("send", "number"), [(os.killpg, signal.SIGINT), (os.killpg, signal.SIGTERM), (os.kill, signal.SIGTERM)]
)
def test_joblib_waits_for_the_checkpoints_of_its_jobs(
    send: Callable[[int, int], None], number: signal.Signals, tmp_path: Path
) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    process = start_with_fake_training(
        tmp_path, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=91,92,93"
    )
    errors = interrupt_two_jobs(process, tmp_path, send, number)
    assert process.returncode == 128 + number, errors
    assert "once more to stop at once" in errors
    status = {row["seed"]: row["status"] for row in results(only_sweep())}
    assert status == {"91": "interrupted", "92": "interrupted", "93": "no result"}
    assert len(list(only_sweep().rglob("checkpoint"))) == 2


def test_a_second_signal_waits_no_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopping, "_hand_on", lambda number: None)
    patience = stopping.SweepSignalHandler()
    with stopping.sweep_signals(patience, parallel=True):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # to the process, and to its group: that is one
        monkeypatch.setattr(stopping, "DUPLICATE_SIGNAL_S", -1.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert patience.number == signal.SIGINT
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_wait_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopping, "_hand_on", lambda number: None)
    monkeypatch.setattr(stopping, "GRACE_S", 0.1)
    monkeypatch.setattr(stopping, "DUPLICATE_SIGNAL_S", 0.05)
    with (
        pytest.raises(KeyboardInterrupt),
        stopping.sweep_signals(stopping.SweepSignalHandler(), parallel=True),
    ):
        signal.raise_signal(signal.SIGTERM)
        time.sleep(5)


def test_joblib_runs_jobs_in_processes_of_their_own(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    process = start_with_fake_training(tmp_path, "hydra/launcher=joblib", "seed=0,1,13,5")
    output, errors = process.communicate(timeout=120)
    assert process.returncode == 1, errors
    assert "UserWarning" not in errors
    for job in range(2):
        assert f"[job {job}] half way beside others\n" in output
    rows = results(only_sweep())
    assert [(row["seed"], row["status"]) for row in rows] == [
        ("5", "finished"),
        ("1", "finished"),
        ("0", "finished"),
        ("13", "failed"),
    ]
    assert "unlucky" in errors
