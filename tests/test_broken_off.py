"""Runs that end before an iteration, or in what follows their last one: what they leave, how they resume."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from test_learn import BALL, SMALL
from test_self_play import GAME

from mappo_unity.cli import learn_main, train_main
from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_policy import OnnxPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.runs.folder import CONFIG
from mappo_unity.signals import DUPLICATE_SIGNAL_S, Interrupted
from mappo_unity.training import match_series, trainer
from mappo_unity.training.setup import TrainingSetup

BATCH = 64
LINES = [*GAME, "hydra.run.dir=run", f"max_steps={3 * BATCH}", "env.params.games=8"]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def interrupt(*arguments: Any, **options: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("how", ["interrupted", "killed"])
def test_self_play_without_an_iteration_can_be_started_again(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(TrainingSetup, "learn", interrupt)
        if how == "killed":
            patch.setattr("mappo_unity.runs.folder.discard_folder", lambda *arguments: None)
        assert train_main(LINES) == 130
    assert Path("run/pool").exists() == Path("run").exists() == (how == "killed")

    assert train_main(LINES) == 0, capsys.readouterr().err
    # the pool of a run that has learnt is no leftover
    assert train_main(LINES) == 2 and "is not empty" in capsys.readouterr().err


@pytest.mark.parametrize("pool", ["as before", "begun anew"])
def test_options_of_a_resume_without_an_iteration_do_not_last(
    monkeypatch: pytest.MonkeyPatch, pool: str
) -> None:
    assert train_main([*LINES, *(["self_play.save_steps=null"] if pool == "begun anew" else [])]) == 0
    before = Path("run", CONFIG).read_bytes()

    resume = ["resume=run", "max_steps=1000", "ppo.lr=0.5", "self_play.save_steps=64"]
    with monkeypatch.context() as patch:  # a signal that comes before the first iteration
        patch.setattr(trainer, "_status", lambda *arguments: "interrupted")
        assert train_main(resume) == 0
    assert Path("run", CONFIG).read_bytes() == before

    assert train_main(["resume=run", "max_steps=256", "ppo.lr=0.5"]) == 0
    assert Path("run", CONFIG).read_bytes() != before


def test_what_the_system_refuses_a_rescue_is_said_beside_the_reason(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    learn = TrainingSetup.learn
    calls = []

    def refused(*arguments: Any) -> None:
        raise PermissionError("the folder belongs to somebody else")

    def broken(setup: TrainingSetup, *arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 3:
            monkeypatch.setattr(checkpoint, "save_in", refused)
            raise ConfigError("the first reason")
        return learn(setup, *arguments, **options)

    monkeypatch.setattr(TrainingSetup, "learn", broken)
    assert train_main([*LINES, "checkpoint_interval=1000000"]) == 2
    out, errors = capfd.readouterr()
    assert "the first reason" in errors and "somebody else" in out


# --- the last series of matches


@pytest.mark.parametrize("ends", ["interrupted", "failed"])
def test_the_last_series_of_matches_is_played_by_resuming(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], ends: str
) -> None:
    lines = [*LINES, f"matches.interval={2 * BATCH}", "matches.count=4", "matches.opponents=0"]
    assert train_main([*lines, "hydra.run.dir=whole"]) == 0
    play, calls = match_series.play_matches, []

    def broken_off(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise Interrupted(signal.SIGINT) if ends == "interrupted" else ConfigError("the player ended")
        return play(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(match_series, "play_matches", broken_off)
        assert train_main(lines) == (0 if ends == "interrupted" else 2)
    assert newest("run")["matches"]["missing"]

    rows = Path("run", "metrics.csv").read_text()
    capfd.readouterr()
    assert train_main(["resume=run"]) == 0
    assert f"{newest('run')['agent_steps']} steps: of 4 matches" in capfd.readouterr().out
    assert Path("run", "metrics.csv").read_text() == rows  # no iteration of its own
    for part in ("matches", "agent_steps", "iteration", "best_score"):
        assert newest("run")[part] == newest("whole")[part]
    assert (
        checkpoint.load(Path("run", "checkpoints", "best.pt"))["iteration"]
        == (checkpoint.load(Path("whole", "checkpoints", "best.pt"))["iteration"])
    )

    assert train_main(["resume=run"]) == 0
    assert "nothing to train, and nothing was changed" in capfd.readouterr().out


def test_a_last_series_that_is_no_longer_wanted_is_not_played(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(match_series, "play_matches", interrupt)
        assert train_main([*LINES, "matches.interval=1000"]) == 130
    assert newest("run")["matches"]["missing"]
    assert train_main(["resume=run", "matches.interval=null"]) == 0
    assert "nothing to train, and nothing was changed" in capfd.readouterr().out


def newest(run: str) -> dict[str, Any]:
    return checkpoint.load(checkpoint.newest_good(Path(run))[0])


# --- mappo-learn


RUN = Path("results", "first")
LEARN = ["my.yaml", "--run-id=first", "--seed=5", *SMALL, "checkpoint_interval=1000000"]
RESUME = ["my.yaml", "--run-id=first", "--resume", *SMALL[1:], "checkpoint_interval=1000000"]


def stop_at_once(patch: pytest.MonkeyPatch, iteration: int) -> None:
    """Let Ctrl-C come twice while this iteration is learnt, counted from the start of the process."""
    learn = TrainingSetup.learn
    calls = []

    def interrupted(setup: TrainingSetup, *arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == iteration:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1.1 * DUPLICATE_SIGNAL_S)
            os.kill(os.getpid(), signal.SIGINT)
        return learn(setup, *arguments, **options)

    patch.setattr(TrainingSetup, "learn", interrupted)


def published_steps() -> int | None:
    return OnnxPolicy(RUN / "3DBall.onnx", deterministic=True).agent_steps


def test_a_run_that_is_stopped_at_once_publishes_its_last_complete_iteration(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("my.yaml").write_text(BALL)
    with monkeypatch.context() as patch:
        stop_at_once(patch, iteration=3)
        assert learn_main([*LEARN, "max_steps=2400"]) == 130
    assert f"policy: {RUN / '3DBall.onnx'}" in capsys.readouterr().out
    assert published_steps() == 480 and (RUN / "3DBall" / "3DBall-480.onnx").is_file()

    with monkeypatch.context() as patch:
        stop_at_once(patch, iteration=2)
        assert learn_main([*RESUME, "max_steps=2400"]) == 130
    assert published_steps() == 720

    # nothing was trained: what is there stays
    status = (RUN / "run_logs" / "training_status.json").read_bytes()
    with monkeypatch.context() as patch:
        stop_at_once(patch, iteration=1)
        assert learn_main([*RESUME, "max_steps=2400"]) == 130
    assert (RUN / "run_logs" / "training_status.json").read_bytes() == status and published_steps() == 720


def test_a_policy_that_cannot_be_exported_is_not_replaced_by_an_older_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("my.yaml").write_text(BALL)
    assert learn_main([*LEARN, "max_steps=240"]) == 0
    status = (RUN / "run_logs" / "training_status.json").read_bytes()
    capsys.readouterr()

    def fail(*arguments: Any) -> None:
        raise ConfigError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr("mappo_unity.policies.export.export_checkpoint", fail)
        stop_at_once(patch, iteration=2)
        assert learn_main([*RESUME, "max_steps=2400"]) == 130
    out, errors = capsys.readouterr()
    assert "the disk is full" in out and "policy:" not in out
    assert f"step_{480:012d}.pt was written: {RUN / '3DBall.onnx'} is older" in errors
    assert not (RUN / "3DBall" / "3DBall-480.onnx").exists() and published_steps() == 240
    assert (RUN / "run_logs" / "training_status.json").read_bytes() == status
