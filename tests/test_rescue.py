"""Whatever ends a run, its last complete iteration is saved first, and a line says where."""

import os
import sys

import pytest
import torch

from mappo_unity.cli import train_main
from mappo_unity.errors import ConfigError
from mappo_unity.runs import checkpoint
from mappo_unity.runs.folder import CONFIG
from mappo_unity.runs.logger import RunLog
from mappo_unity.training import memory, stop_signals
from mappo_unity.training.memory import check_free, is_out_of_memory, show_size
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import TrainingSetup

ITERATION = 16 * 16  # decisions: 16 rounds of 16 agents
FAILING = [
    *("env=custom", "env.factory=failing_env:make", "env.params.at=70", "collect.rounds=16"),
    *("ppo.minibatch_size=256", "model.hidden=[8]", "log.loggers=[]", "hydra.run.dir=run"),
    *("max_steps=100000", "checkpoint_interval=1000000", "export_onnx=false", "seed=5"),
]
BASIC = [
    *("env=Basic", "env.num_areas=16", "collect.rounds=16", "ppo.minibatch_size=256", "model.hidden=[8]"),
    *("log.loggers=[]", "hydra.run.dir=run", "export_onnx=false"),
]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def saved_iterations():
    return [checkpoint.load(path)["iteration"] for path in checkpoint.checkpoints_in(folder())]


def folder():
    from pathlib import Path

    return Path("run")


@pytest.mark.parametrize(
    ("how", "code", "said"),
    [
        ("raises", 3, "env.factory=failing_env:make: its step raised ValueError: the game broke"),
        ("leaves", 3, "env.factory=failing_env:make: its step raised SystemExit: 7"),
        ("runs_out_of_memory", 3, "env.factory=failing_env:make: its step raised MemoryError"),
        ("sends_nan", 2, "its sensor obs_0 (vector) holds nan in a decision step"),
    ],
)
def test_an_environment_that_fails_costs_no_iteration(how, code, said, capfd):
    assert train_main([*FAILING, f"env.params.how={how}", "env.params.marker=good"]) == code
    out, errors = capfd.readouterr()
    assert said in errors
    if code == 3:  # the user's own frames, and none of ours
        assert f"in {how}" in errors and "mappo_unity/" not in errors
    assert saved_iterations() == [1, 4]  # at step 70 the fifth iteration of 16 rounds is under way
    assert f"saved the last complete iteration, 4 ({4 * ITERATION:,} steps): run/checkpoints/" in out
    assert "resume with: mappo-train resume=run" in out

    open("good", "w").close()
    assert train_main(["resume=run", f"max_steps={6 * ITERATION}"]) == 0
    assert saved_iterations() == [1, 4, 6]


def test_a_bug_of_ours_is_saved_from_too(monkeypatch, capfd):
    learn = TrainingSetup.learn
    calls = []

    def broken(setup, batch, progress):
        calls.append(1)
        if len(calls) == 3:
            raise AssertionError("a bug of ours")
        return learn(setup, batch, progress)

    monkeypatch.setattr(TrainingSetup, "learn", broken)
    with pytest.raises(AssertionError, match="a bug of ours"):
        train_main([*BASIC, "max_steps=5000", "checkpoint_interval=1000000"])
    assert saved_iterations() == [1, 2]
    assert "saved the last complete iteration, 2" in capfd.readouterr().out


def test_what_a_rescue_saved_goes_on_as_if_nothing_had_been(monkeypatch):
    arguments = [*BASIC, f"max_steps={5 * ITERATION}", "checkpoint_interval=1000000"]
    assert train_main([*arguments, "hydra.run.dir=whole"]) == 0
    collect = RunState.count_crashed
    calls = []

    def broken(state, batch):
        calls.append(1)
        if len(calls) == 3:  # after a batch was collected: the scene and the random numbers have moved on
            raise AssertionError("a bug of ours")
        return collect(state, batch)

    monkeypatch.setattr(RunState, "count_crashed", broken)
    with pytest.raises(AssertionError):
        train_main(arguments)
    assert train_main(["resume=run"]) == 0
    first, second = (
        checkpoint.load(checkpoint.checkpoints_in(folder().parent / name)[-1]) for name in ("whole", "run")
    )
    assert first["agent_steps"] == second["agent_steps"] == 5 * ITERATION
    weights = [state["learners"]["Basic"]["actor"] for state in (first, second)]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])


def test_a_full_disk_for_the_metrics_costs_no_iteration(monkeypatch, capfd):
    log = RunLog.log

    def full(run_log, row, *more):
        if row["iteration"] == 3:
            raise ConfigError("the metrics cannot be written (No space left on device)")
        log(run_log, row, *more)

    monkeypatch.setattr(RunLog, "log", full)
    assert train_main([*BASIC, "max_steps=5000", "checkpoint_interval=1000000"]) == 2
    assert "No space left on device" in capfd.readouterr().err
    assert saved_iterations() == [1, 3]


def test_a_checkpoint_that_cannot_be_written_either_is_said_beside_the_reason(monkeypatch, capfd):
    def full(path, state):
        raise checkpoint.CheckpointError(f"checkpoint {path} could not be written")

    learn = TrainingSetup.learn
    calls = []

    def broken(setup, batch, progress):
        calls.append(1)
        if len(calls) == 3:
            monkeypatch.setattr(checkpoint, "save", full)
            raise ConfigError("the first reason")
        return learn(setup, batch, progress)

    monkeypatch.setattr(TrainingSetup, "learn", broken)
    assert train_main([*BASIC, "max_steps=5000", "checkpoint_interval=1000000"]) == 2
    out, errors = capfd.readouterr()
    assert "the first reason" in errors and "could not be written" in out


def test_a_failure_in_the_first_iteration_says_that_there_is_nothing_to_resume(capfd):
    assert train_main([*FAILING, "env.params.at=3"]) == 3
    assert "no iteration was complete: there is nothing to resume" in capfd.readouterr().out


def test_the_first_checkpoint_comes_after_the_first_iteration_and_leaves_the_rhythm_alone():
    interval = f"checkpoint_interval={2 * ITERATION}"
    assert train_main([*BASIC, f"max_steps={6 * ITERATION}", "keep_checkpoints=9", interval]) == 0
    assert saved_iterations() == [1, 2, 4, 6]


def test_a_signal_ends_a_batch_that_takes_too_long(monkeypatch, capfd):
    monkeypatch.setattr(stop_signals, "PATIENCE_S", 0.7)
    # 1000 rounds of 0.05 s would take 50 s
    long = ["env.params.how=is_terminated", "env.params.at=1100", "collect.rounds=1000"]
    assert train_main([*FAILING, *long]) == 128 + 15
    out, errors = capfd.readouterr()
    assert "stopping after this iteration, or in 0.7 s with the one before it" in out
    assert "ended by SIGTERM; checkpoint run/checkpoints/step_" in errors
    assert saved_iterations() == [1]


def test_a_signal_before_the_first_iteration_is_complete_leaves_no_checkpoint(monkeypatch, capfd):
    monkeypatch.setattr(stop_signals, "PATIENCE_S", 0.7)
    long = ["env.params.how=is_terminated", "env.params.at=3", "collect.rounds=1000"]
    assert train_main([*FAILING, *long]) == 128 + 15
    assert "no iteration was complete" in capfd.readouterr().out


# --- updates that were rolled back


@pytest.mark.parametrize("lr", ["1e3", "1e38"])
def test_a_run_whose_updates_were_rolled_back_says_so_and_has_an_exit_code_of_its_own(lr, capfd):
    assert train_main([*BASIC, f"max_steps={5 * ITERATION}", f"ppo.lr={lr}"]) == 4
    out = capfd.readouterr().out
    assert "iteration 1: the update of Basic was rolled back" in out and "; 1 of 1 so far" in out
    assert "diverged: 1,280 agent steps" in out and "finished" not in out
    assert "updates rolled back (what was collected for them taught nothing): 5 of 5 of Basic" in out
    assert "what helps: a smaller ppo.lr" in out


def test_the_policy_whose_update_was_rolled_back_is_named(capfd):
    arguments = [
        *("env=StrikersVsGoalie", "env.num_areas=2", "collect.rounds=20", "ppo.minibatch_size=20"),
        *("model.hidden=[8]", "log.loggers=[]", "hydra.run.dir=run", "export_onnx=false", "max_steps=240"),
        *("matches.interval=null", "behaviors.Goalie.ppo.lr=1e3", "update_threads=1"),
    ]
    assert train_main(arguments) == 4
    out = capfd.readouterr().out
    assert "the update of Goalie was rolled back" in out and "the update of Striker" not in out
    assert "taught nothing): 2 of 2 of Goalie\n" in out


# --- resuming a run that is over, and options that cannot change


def record():
    return {path.name: path.read_bytes() for path in folder().iterdir() if path.is_file()}


@pytest.mark.parametrize("options", [[], ["max_steps=300"], ["max_steps=1000", "stop_at_return=-1000"]])
def test_a_continuation_that_trains_nothing_changes_nothing_and_says_so(options, capfd):
    assert train_main([*BASIC, "max_steps=512", "log.return_window=1"]) == 0
    before = record()
    assert train_main(["resume=run", *options]) == 0
    assert "nothing to train, and nothing was changed: the run in run is over" in capfd.readouterr().out
    assert record() == before


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("seed=3", "seed=3 cannot change with resume: the run has seed=0"),
        ("env.num_areas=3", "cannot change with resume: the snapshot has num_areas=16"),
        ("env.max_teams=40", "cannot change with resume: the snapshot has agent slots"),
        ("model.hidden=[9]", "holds another network: model.hidden=[8] there, [9] here"),
        ("env.name=Walker", "env.name cannot change with resume"),
    ],
)
def test_options_that_cannot_change_are_refused_and_the_record_stays(option, said, capfd):
    assert train_main([*BASIC, "max_steps=512"]) == 0
    before = record()
    assert train_main(["resume=run", "max_steps=2000", option]) == 2
    assert said in capfd.readouterr().err
    assert record() == before
    assert train_main(["resume=run", "max_steps=1000"]) == 0


def test_a_resume_that_breaks_before_an_iteration_is_complete_leaves_the_options_alone(monkeypatch):
    assert train_main([*BASIC, "max_steps=512"]) == 0
    before = (folder() / CONFIG).read_bytes()

    def broken(setup, batch, progress):
        raise AssertionError("a bug of ours")

    monkeypatch.setattr(TrainingSetup, "learn", broken)
    with pytest.raises(AssertionError):
        train_main(["resume=run", "max_steps=2000", "ppo.lr=0.5"])
    assert (folder() / CONFIG).read_bytes() == before


# --- memory


def test_a_batch_and_networks_that_cannot_fit_are_refused_before_the_first_step(capfd):
    assert train_main([*BASIC, "collect.rounds=null", "collect.batch_size=999999999999"]) == 2
    errors = capfd.readouterr().err
    assert "collect.batch_size=999999999999: learning from a batch of 62,500,000,000 rounds" in errors
    assert "lower collect.batch_size" in errors
    assert train_main([*BASIC, "model.hidden=[100000,100000]"]) == 2
    assert "model.hidden=[100000, 100000]" in capfd.readouterr().err
    assert not os.path.exists("run")


def test_memory_that_runs_out_all_the_same_is_one_line(monkeypatch, capfd):
    def broken(setup, batch, progress):
        torch.empty(2**60)

    monkeypatch.setattr(TrainingSetup, "learn", broken)
    assert train_main([*BASIC, "max_steps=512"]) == 2
    errors = capfd.readouterr().err
    assert "memory ran out" in errors
    sizes = "env.num_areas=16, collect.batch_size=256, ppo.minibatch_size=256 or model.hidden=[8]"
    assert f"lower {sizes}" in errors


def test_sizes_and_limits_of_memory(monkeypatch):
    assert [show_size(size) for size in (12, 2048, 3.5 * 2**30, 300 * 2**40)] == [
        *("12 bytes", "2.0 KiB", "3.5 GiB", "300 TiB"),
    ]
    monkeypatch.setattr(memory, "free_memory", lambda: 1024)
    check_free(1024, "a=1", "lower a")
    with pytest.raises(ConfigError, match="a=1 takes about 2.0 KiB, but 1.0 KiB are free; lower a"):
        check_free(2048, "a=1", "lower a")
    monkeypatch.setattr(memory, "free_memory", lambda: None)  # nobody knows: nothing is refused
    check_free(1e30, "a=1", "lower a")
    assert is_out_of_memory(MemoryError()) and not is_out_of_memory(RuntimeError("something else"))


def test_free_memory_is_more_than_nothing():
    free = memory.free_memory()
    if sys.platform == "linux":
        assert free is not None
    assert free is None or free > 2**20
