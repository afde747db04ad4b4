"""The commands from outside: help, exit codes, run folders, resume, evaluation."""

from __future__ import annotations

import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import fake_training
import pytest
import yaml
from fake_training import Outcome

from mappo_unity import __version__
from mappo_unity.cli import eval_main, report_main, train_main
from mappo_unity.config.option_table import option_table
from mappo_unity.config.presets import all_groups, describe_choices
from mappo_unity.config.schema import Config, EvalConfig
from mappo_unity.errors import ConfigError
from mappo_unity.runs import lock as run_lock
from mappo_unity.runs.folder import create_folder, find_run
from mappo_unity.runs.lock import locked
from mappo_unity.runs.versions import read_versions


class FakeTraining:
    """Stand in for mappo_unity.training.trainer and mappo_unity.runs.checkpoint; keep the calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[Config, Path, Path | None]] = []
        self.outcome = Outcome()
        self.error: BaseException | None = None
        self.writes = True

    def train(self, cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Outcome:
        self.calls.append((cfg, folder, checkpoint))
        if self.writes:
            (folder / "metrics.csv").write_text("agent_steps\n10\n")
        if self.error is not None:
            raise self.error
        return self.outcome

    def newest_good(self, where: Path) -> tuple[Path, list[str]]:
        if where.name == "empty":
            raise ConfigError(f"{where} holds no checkpoint")
        return where / "checkpoints" / "step_1.pt", ["step_2.pt is damaged"]


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> FakeTraining:
    fake = FakeTraining()
    fakes = {"training.trainer": [fake.train, fake_training.why_over], "runs.checkpoint": [fake.newest_good]}
    for name, functions in fakes.items():
        module = ModuleType(f"mappo_unity.{name}")
        for function in functions:
            setattr(module, function.__name__, function)
        monkeypatch.setitem(sys.modules, f"mappo_unity.{name}", module)
    monkeypatch.chdir(tmp_path)
    return fake


def new_run() -> Path:
    (folder,) = Path("outputs/3DBall").iterdir()
    return folder


# --- help


@pytest.mark.parametrize("command", ["train_main", "eval_main"])
def test_help_comes_at_once_without_torch(command: str) -> None:
    # these take seconds to import
    check = "assert not {'torch', 'torchrl', 'mujoco', 'mlagents_envs'} & set(sys.modules)"
    code = f"import sys; from mappo_unity.cli import {command} as m; m(['-h']); {check}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    table = option_table(Config if command == "train_main" else EvalConfig)
    for key, option in table.items():
        assert (f"{key}.*" if option.is_section else f"{key}: ") in done.stdout
        assert re.sub(r"\s+", " ", option.description) in re.sub(r"\s+", " ", done.stdout)


def test_help_lists_every_choice(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["-h"]) == 0
    text = capsys.readouterr().out
    for group in all_groups():
        assert f"{group}={'|'.join(describe_choices(group))}" in text
    assert "hydra/launcher=basic|joblib" in text
    assert "ppo.lr: float = 0.0003" in text
    assert "model.hidden: [int] = [128,128]" in text


def test_choices_are_described_in_a_sentence_or_two_without_their_name() -> None:
    """What a preset's file says below the first paragraph of its comment is not for --help."""
    for group in (*all_groups(), "search"):
        for name, text in describe_choices(group).items():
            assert 0 < len(text) < 240 and not text.startswith(f"{name}:"), f"{group}={name}: {text}"
    assert describe_choices("env")["CooperativePushBlock"].endswith("(group reward)")


@pytest.mark.parametrize("command", ["train", "eval", "play", "export", "league", "report", "hub", "search"])
def test_examples_of_help_name_options_that_exist(command: str) -> None:
    text = importlib.import_module(f"mappo_unity.cli.{command}").help_text()
    known = {*re.findall(r"^  ([\w.]+): ", text, re.M), *option_table(Config), *all_groups()}

    examples = text.split("Examples:\n")[1].split("\n\n")[0].splitlines()
    assert all(line.startswith("  mappo-") for line in examples)
    for line in examples:
        for option in re.findall(r" ([\w./]+)=", line):
            assert option in known or option.startswith("env.params."), line


def test_a_mistake_is_told_without_torch(tmp_path: Path) -> None:
    code = (
        "import sys; from mappo_unity.cli import train_main; code = train_main(['ppo.gama=1']);"
        "assert 'torch' not in sys.modules; sys.exit(code)"
    )
    root = str(Path(__file__).resolve().parents[1])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": root},
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "did you mean ppo.gamma" in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_option_of_another_backend_is_refused(
    training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(["env=3DBall", "env.file_name=builds/3DBall"]) == 2
    assert "it needs env.backend=player" in capsys.readouterr().err
    assert training.calls == [] and list(tmp_path.iterdir()) == []


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["--version"]) == 0
    assert capsys.readouterr().out == f"mappo-train {__version__}\n"


# --- a run


def test_a_run_leaves_its_record(training: FakeTraining, capsys: pytest.CaptureFixture[str]) -> None:
    assert train_main(["seed=4", "ppo.lr=1e-3"]) == 0
    folder = new_run()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", folder.name)
    config, given_folder, checkpoint = training.calls[0]
    assert (config.seed, config.ppo.lr, given_folder, checkpoint) == (4, 1e-3, folder, None)
    saved = yaml.safe_load((folder / "config.yaml").read_text())
    assert saved["ppo"]["lr"] == 1e-3 and saved["log"]["loggers"] == ["tensorboard"]
    assert set(saved) == set(vars(Config()))
    assert yaml.safe_load((folder / "overrides.yaml").read_text())[0]["overrides"] == [
        "seed=4",
        "ppo.lr=1e-3",
    ]
    assert json.loads((folder / "versions.json").read_text())["mappo-unity"] == __version__
    out = capsys.readouterr().out
    for word in (
        "1,000 agent steps",
        "500/s",
        "12.5",
        f"mappo-eval run={folder}",
        f"resume={folder}",
        "tensorboard",
    ):
        assert word in out


def test_runs_never_collide(training: FakeTraining) -> None:
    wanted = Path("outputs/x/now")
    names = [create_folder(wanted).path.name for _ in range(4)]
    assert names == ["now", "now_1", "now_2", "now_3"]


def test_a_folder_that_the_user_names_is_never_overwritten(
    training: FakeTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(["hydra.run.dir=mine"]) == 0
    before = (Path("mine") / "overrides.yaml").read_text()
    assert train_main(["hydra.run.dir=mine"]) == 2
    message = capsys.readouterr().err
    assert "mine is not empty" in message and "resume=mine" in message
    assert (Path("mine") / "overrides.yaml").read_text() == before


def test_a_place_that_cannot_be_written_is_told(
    training: FakeTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken").write_text("a file")
    assert train_main(["output_dir="]) == 2 and "output_dir= is empty" in capsys.readouterr().err
    assert train_main(["output_dir=taken"]) == 2
    message = capsys.readouterr().err
    assert "taken" in message and "output_dir=" in message
    assert training.calls == [] and Path("taken").read_text() == "a file"


@pytest.mark.parametrize(
    "line", ["env=Nope", "ppo.gamma=7", "seed=x", "sed=1", "seed", "ppo.lr=[", "seed=1,2"]
)
def test_a_mistake_makes_nothing(
    line: str, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main([line]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("mappo-train: ")
    assert training.calls == [] and list(tmp_path.iterdir()) == []


def test_a_mistake_that_the_training_finds_leaves_nothing(
    training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    training.writes, training.error = False, ConfigError("device=cuda: there is none")
    assert train_main(["device=cuda"]) == 2
    assert "device=cuda: there is none" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        (["hydra.run.dir=null"], "hydra.run.dir=null: "),
        (["hydra.run.dir=runs/${env.nme}"], "hydra.run.dir: "),
        (["-m", "seed=0,1", "hydra.sweep.dir=x/${env.nme}"], "hydra.sweep.dir: "),
        ([f"output_dir={'a' * 300}"], "output_dir=FOLDER sets another place"),
        ([f"ppo.lr=1{'0' * 400}"], "does not fit: ppo.lr must be a number"),
    ],
)
def test_places_and_numbers_that_cannot_be(
    training: FakeTraining, lines: list[str], word: str, capsys: Any
) -> None:
    assert train_main(lines) == 2
    assert word in capsys.readouterr().err and not list(Path().iterdir())


def test_a_pattern_that_the_shell_left_is_told(capsys: Any) -> None:
    assert report_main(["???"]) == 2
    assert "runs is not given" in capsys.readouterr().err


@pytest.mark.parametrize("logs", ["players", "run_logs"])
@pytest.mark.parametrize("named", [False, True])
def test_players_that_came_up_in_vain_leave_nothing(training: FakeTraining, named: bool, logs: str) -> None:
    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Outcome:
        log = folder / logs / "Player-0.log"
        log.parent.mkdir()
        log.write_text("a player's words")
        raise ConfigError(f"its log: {log}" if named else "matches need two sides")

    sys.modules["mappo_unity.training.trainer"].train = train  # type: ignore[attr-defined]
    assert train_main(["hydra.run.dir=mine"]) == 2
    assert Path("mine").exists() == named


def test_a_refused_continuation_with_players_keeps_its_options(training: FakeTraining) -> None:
    train_main(["hydra.run.dir=mine"])
    before = Path("mine/config.yaml").read_text()

    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Outcome:
        (folder / "players").mkdir()
        (folder / "players" / "Player-0.log").write_text("a player's words")
        raise ConfigError("another network")

    sys.modules["mappo_unity.training.trainer"].train = train  # type: ignore[attr-defined]
    assert train_main(["resume=mine", "model.hidden=[3]"]) == 2
    assert Path("mine/config.yaml").read_text() == before


def test_what_a_run_has_done_outlives_its_error(training: FakeTraining) -> None:
    training.error = ConfigError("the disk is full")
    assert train_main([]) == 2
    assert (new_run() / "metrics.csv").is_file()


def test_a_run_folder_that_is_removed_meanwhile(
    training: FakeTraining, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Outcome:
        shutil.rmtree(folder)
        raise ConfigError("the run folder was removed")

    monkeypatch.setattr(sys.modules["mappo_unity.training.trainer"], "train", train)
    assert train_main([]) == 2
    assert capsys.readouterr().err == "mappo-train: the run folder was removed\n"
    assert train_main(["-m", "seed=1,2"]) == 1  # the jobs fail, and the table says so
    assert capsys.readouterr().err.count("failed: the run folder was removed") == 2


def test_a_bug_shows_itself(training: FakeTraining) -> None:
    training.error = RuntimeError("a bug")
    with pytest.raises(RuntimeError, match="a bug"):
        train_main([])


@pytest.mark.parametrize(("signal", "name", "code"), [(2, "SIGINT", 130), (15, "SIGTERM", 143)])
def test_signals_have_their_exit_codes(
    signal: int, name: str, code: int, training: FakeTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    training.outcome = Outcome("interrupted", signal, last_checkpoint=Path("step_7.pt"))
    assert train_main([]) == code
    message = capsys.readouterr().err
    assert name in message and "step_7.pt" in message and f"resume={new_run()}" in message


def test_an_interruption_before_the_start_leaves_nothing(training: FakeTraining, tmp_path: Path) -> None:
    training.writes, training.error = False, KeyboardInterrupt()
    assert train_main([]) == 130
    assert list(tmp_path.iterdir()) == []


# --- going on


def test_a_run_goes_on_in_its_folder(training: FakeTraining, capsys: pytest.CaptureFixture[str]) -> None:
    train_main(["seed=4", "max_steps=10"])
    folder = new_run()
    assert train_main([f"resume={folder}", "max_steps=20"]) == 0
    config, given_folder, checkpoint = training.calls[1]
    assert (config.seed, config.max_steps) == (4, 20)
    assert given_folder == folder and checkpoint == folder / "checkpoints" / "step_1.pt"
    assert new_run() == folder
    captured = capsys.readouterr()
    assert "step_2.pt is damaged" in captured.err
    history = yaml.safe_load((folder / "overrides.yaml").read_text())
    assert [entry["overrides"] for entry in history] == [
        ["seed=4", "max_steps=10"],
        [f"resume={folder}", "max_steps=20"],
    ]
    saved = yaml.safe_load((folder / "config.yaml").read_text())
    assert saved["max_steps"] == 20 and saved["resume"] is None


@pytest.mark.parametrize("name", ["sp ace", "a=b,c (d)", "o'clock"])
def test_printed_commands_can_be_pasted(
    name: str, training: FakeTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main([f'output_dir="{name}"']) == 0
    (folder,) = (Path(name) / "3DBall").iterdir()
    (hint,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("resume:"))
    command, *lines = shlex.split(hint.partition(":")[2])
    assert command == "mappo-train" and train_main(lines) == 0
    assert training.calls[1][1] == folder


def test_a_refused_continuation_changes_nothing(training: FakeTraining) -> None:
    train_main([])
    folder = new_run()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    training.writes, training.error = False, ConfigError("another network")
    assert train_main([f"resume={folder}", "model.hidden=[3]"]) == 2
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_run_in_training_takes_no_second_one(
    training: FakeTraining, capsys: pytest.CaptureFixture[str]
) -> None:
    train_main(["hydra.run.dir=mine"])
    before = {path.name: path.read_bytes() for path in Path("mine").iterdir()}
    code = (
        "from pathlib import Path; from mappo_unity.runs.lock import locked\n"
        "with locked(Path('mine')): print('locked', flush=True); input()"
    )
    root = str(Path(__file__).resolve().parents[1])
    other = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": root},
    )
    assert other.stdout is not None and other.stdout.readline() == b"locked\n"
    assert train_main(["resume=mine"]) == 2
    message = capsys.readouterr().err
    assert f"mine is being trained by another process (process {other.pid})" in message
    after = {path.name: path.read_bytes() for path in Path("mine").iterdir()}
    assert after | {".lock": b""} == before | {".lock": b""} and len(training.calls) == 1
    other.kill()
    other.communicate()
    assert train_main(["resume=mine"]) == 0  # nothing is left of the lock


def test_a_run_holds_its_lock_while_it_trains(training: FakeTraining) -> None:
    seen: list[str] = []

    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Outcome:
        with pytest.raises(ConfigError, match="is being trained by another process"), locked(folder):
            pass
        seen.append(folder.name)
        return Outcome()

    sys.modules["mappo_unity.training.trainer"].train = train  # type: ignore[attr-defined]
    assert train_main(["hydra.run.dir=mine"]) == train_main(["resume=mine"]) == 0
    assert train_main(["-m", "seed=0,1"]) == 0
    assert seen == ["mine", "mine", "0", "1"]
    with locked(Path("mine")) as warning:
        assert warning is None


def test_a_place_without_locks_stops_no_run(
    training: FakeTraining, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(file: Any) -> None:
        raise OSError(37, "No locks available")

    monkeypatch.setattr(run_lock, "_lock", refuse)
    assert train_main([]) == 0
    assert "cannot be locked (No locks available): take care" in capsys.readouterr().err


def test_what_cannot_go_on_is_told(training: FakeTraining, capsys: pytest.CaptureFixture[str]) -> None:
    train_main(["hydra.run.dir=empty"])
    capsys.readouterr()
    Path("other").mkdir()
    for line, words in (
        ("resume=", ["resume= is empty", "a run folder or a checkpoint"]),
        ("resume=nowhere", ["resume=nowhere does not exist", "empty"]),
        ("resume=other", ["resume=other is neither a run folder nor a checkpoint"]),
        ("resume=empty", ["empty holds no checkpoint"]),
    ):
        assert train_main([line]) == 2
        message = capsys.readouterr().err
        for word in words:
            assert word in message
    assert len(training.calls) == 1
    assert train_main([f"resume={Path('empty')}", "env=custom"]) == 2
    assert "env=custom" in capsys.readouterr().err


def test_the_run_of_a_checkpoint_is_found(training: FakeTraining) -> None:
    train_main(["hydra.run.dir=mine"])
    Path("mine/checkpoints").mkdir()
    file = Path("mine/checkpoints/step_1.pt")
    file.touch()
    assert find_run(file, "resume") == find_run(file.parent, "resume") == find_run(Path("mine"), "resume")


def test_versions_name_what_the_run_stands_on() -> None:
    import numpy

    versions = read_versions()
    assert versions["numpy"] == numpy.__version__
    assert versions["python"] == ".".join(map(str, sys.version_info[:3]))
    for package in ("torch", "torchrl", "tensordict", "mujoco", "mlagents-envs", "hydra-core"):
        assert versions[package]
    root = Path(__file__).resolve().parents[1]
    if (root / ".git").exists():
        head = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True)
        assert versions["git_commit"] == head.stdout.strip() and isinstance(versions["git_dirty"], bool)


# --- evaluation


def test_evaluation_prints_a_table_and_one_line_of_json(
    training: FakeTraining, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls: list[tuple[Path, dict[str, Any]]] = []

    def evaluate(run: Path, **options: Any) -> dict[str, Any]:
        calls.append((run, options))
        return {"return_mean": 99.5, "return_stderr": float("nan"), "3DBall": {"length_mean": 1000.0}}

    module = ModuleType("mappo_unity.policies.evaluate")
    vars(module)["evaluate"] = evaluate
    monkeypatch.setitem(sys.modules, "mappo_unity.policies.evaluate", module)
    monkeypatch.setattr("mappo_unity.policies.first_checks.check_evaluation", lambda *options: None)
    train_main(["hydra.run.dir=mine"])
    capsys.readouterr()
    assert eval_main(["run=mine", "episodes=20", "deterministic=true"]) == 0
    assert calls[0][0] == "mine"
    assert calls[0][1].items() >= {"episodes": 20, "deterministic": True, "seed": 0, "opponent": None}.items()
    lines = capsys.readouterr().out.splitlines()
    assert json.loads(lines[-1]) == {
        "return_mean": 99.5,
        "return_stderr": None,
        "3DBall": {"length_mean": 1000.0},
    }
    assert any("return mean" in line and "99.5" in line for line in lines)
    assert any("3DBall.length mean" in line for line in lines)


@pytest.mark.parametrize(
    ("lines", "word"),
    [
        ([], "run is not given"),
        (["run="], "run= is empty"),
        (["run=nowhere"], "run=nowhere does not exist"),
        (["run=nowhere", "episodes=x"], "episodes=x does not fit: episodes must be a whole number"),
        (["run=a", "episodes=0"], "episodes=0 is out of range"),
        (["run=a", "opponent=random", "episodes=1"], "episodes=1 must be >= 2 with an opponent"),
        (["run=a", "episods=3"], "did you mean episodes"),
    ],
)
def test_a_mistake_in_an_evaluation_is_told(
    lines: list[str],
    word: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert eval_main(lines) == 2
    assert word in capsys.readouterr().err


def test_what_a_file_system_refuses_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(lines: list[str]) -> int:
        raise PermissionError(13, "Permission denied", "somewhere/config.yaml")

    monkeypatch.setattr("mappo_unity.cli.eval.run", fail)
    assert eval_main(["run=a"]) == 2
    assert capsys.readouterr().err == "mappo-eval: somewhere/config.yaml: Permission denied\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_an_output_that_is_full_is_one_line() -> None:
    code = "import sys; from mappo_unity.cli import eval_main; sys.exit(eval_main(['--version']))"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True)
    assert (done.returncode, done.stderr) == (2, "mappo-eval: its output: No space left on device\n")
