"""Runs: the same seed gives the same run; a run that is cut goes on to the same end, to the bit."""

import csv
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest
import torch

from mappo_unity.cli import train_main
from mappo_unity.config.schema import (
    CollectConfig,
    Config,
    EnvConfig,
    LogConfig,
    MatchConfig,
    ModelConfig,
    PPOConfig,
)
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.policies.matches import Score
from mappo_unity.runs import checkpoint
from mappo_unity.runs.checkpoint import CheckpointError
from mappo_unity.training import match_series as series
from mappo_unity.training import stop_signals
from mappo_unity.training.setup import TrainingSetup
from mappo_unity.training.trainer import train

TIMES = {"wall_s", "steps_per_s", "collect_s", "update_s"}
AREAS, ROUNDS = 6, 20
BATCH = AREAS * ROUNDS
SOCCER_BATCH = 2 * 4 * ROUNDS
TINY = [
    "env=3DBall",
    f"env.num_areas={AREAS}",
    f"collect.rounds={ROUNDS}",
    "ppo.minibatch_size=60",
    "model.hidden=[16]",
    "log.loggers=[csv]",
]


def options(iterations, **changes):
    cfg = Config(
        env=EnvConfig(num_areas=AREAS),
        model=ModelConfig(hidden=[16]),
        ppo=PPOConfig(minibatch_size=60),
        collect=CollectConfig(rounds=ROUNDS),
        log=LogConfig(loggers=[], progress=False),
        max_steps=iterations * BATCH,
        checkpoint_interval=BATCH,
    )
    return replace(cfg, **changes)


def soccer(iterations, **changes):
    return options(
        iterations,
        env=EnvConfig(name="SoccerTwos", num_areas=2),
        matches=MatchConfig(interval=2 * SOCCER_BATCH, count=2, opponents=0),
        max_steps=iterations * SOCCER_BATCH,
        **changes,
    )


def rows(folder):
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]


def without_times(state):
    return {k: v for k, v in state.items() if k not in ("wall_s",)}


def assert_same(a, b, where="state"):
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list):
        assert len(a) == len(b), where
        for index, (x, y) in enumerate(zip(a, b)):
            assert_same(x, y, f"{where}[{index}]")
    elif isinstance(a, torch.Tensor):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True, msg=where)
    else:
        assert a == b or (a != a and b != b), where


def test_the_same_seed_gives_the_same_run(tmp_path):
    train(options(4), tmp_path / "a")
    train(options(4), tmp_path / "b")
    train(options(4, seed=1), tmp_path / "c")
    assert len(rows(tmp_path / "a")) == 4
    assert rows(tmp_path / "a") == rows(tmp_path / "b")
    assert rows(tmp_path / "a") != rows(tmp_path / "c")


def test_four_iterations_are_two_saved_and_two_more_to_the_bit(tmp_path):
    whole = train(options(4), tmp_path / "whole")
    # the schedules look at max_steps, so the first half is cut after two iterations, not shortened
    train(
        options(4),
        tmp_path / "parts",
        after_iteration=lambda state: "interrupted" if state.iteration == 2 else None,
    )
    path, warnings = checkpoint.newest_good(tmp_path / "parts")
    assert path.name == f"step_{2 * BATCH:012d}.pt" and not warnings
    resumed = train(options(4), tmp_path / "parts", path)
    assert rows(tmp_path / "whole") == rows(tmp_path / "parts")
    first, second = (checkpoint.load(o.last_checkpoint) for o in (whole, resumed))
    assert_same(without_times(first), without_times(second))


def test_resume_refuses_another_env_network_or_minibatch(tmp_path):
    outcome = train(options(1), tmp_path)
    other_model = options(2, model=ModelConfig(hidden=[8]))
    with pytest.raises(CheckpointError, match=r"another network: model\.hidden=\[16\] there, \[8\] here"):
        train(other_model, tmp_path, outcome.last_checkpoint)
    state = checkpoint.load(outcome.last_checkpoint)
    checkpoint.save(tmp_path / "other.pt", state | {"env_name": "Walker"})
    with pytest.raises(CheckpointError, match="env=Walker, not for env=3DBall"):
        train(options(2), tmp_path, tmp_path / "other.pt")
    with pytest.raises(ConfigError, match="ppo.num_minibatches=121 is larger than the batch.*120 team rows"):
        train(options(1, ppo=PPOConfig(num_minibatches=121)), tmp_path / "x")


def test_a_minibatch_larger_than_the_batch_follows_it_with_a_note(tmp_path, capfd):
    train(options(2, ppo=PPOConfig(minibatch_size=121)), tmp_path / "a")
    said = "note: ppo.minibatch_size=121 is larger than the batch of 3DBall: 20 rounds x 6 agents"
    assert said in capfd.readouterr().out
    train(options(2, ppo=PPOConfig(minibatch_size=120)), tmp_path / "b")
    assert rows(tmp_path / "a") == rows(tmp_path / "b")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has CUDA")
def test_cuda_without_cuda(tmp_path):
    with pytest.raises(ConfigError, match="device=cuda: this torch finds no CUDA device"):
        train(options(1, device="cuda"), tmp_path)


def test_stop_at_return_ends_the_run_when_the_mean_holds(tmp_path):
    outcome = train(options(200, stop_at_return=0.0, log=LogConfig(loggers=[], return_window=5)), tmp_path)
    assert outcome.status == "solved"
    assert outcome.agent_steps < 200 * BATCH
    assert outcome.return_mean >= 0.0


def test_checkpoints_come_at_their_interval_and_rotate(tmp_path):
    train(options(10, checkpoint_interval=2 * BATCH, keep_checkpoints=3), tmp_path)
    steps = [int(p.stem.split("_")[1]) // BATCH for p in checkpoint.checkpoints_in(tmp_path)]
    assert steps == [6, 8, 10]


def command(*arguments):
    return [
        sys.executable,
        "-c",
        "from mappo_unity.cli import train_main; raise SystemExit(train_main())",
        *arguments,
    ]


def start(folder, *arguments, **kwargs):
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command(*arguments),
        cwd=folder,
        env=environment,
        text=True,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        **kwargs,
    )


def wait_for_rows(folder, count, process):
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        files = list(folder.glob("**/metrics.csv"))
        if files and len(files[0].read_text().splitlines()) > count:
            return files[0].parent
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    raise AssertionError("the run wrote no metrics")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGUSR1"])
def test_signals_end_with_a_checkpoint_a_line_and_their_exit_code(tmp_path, name):
    number = getattr(signal, name)
    process = start(tmp_path, *TINY, "max_steps=100000000", "checkpoint_interval=100000000")
    run = wait_for_rows(tmp_path, 3, process)
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + number
    assert f"ended by {name}" in errors and f"resume={run.relative_to(tmp_path)}" in errors
    assert "Traceback" not in errors
    last = checkpoint.checkpoints_in(run)[-1]
    assert checkpoint.load(last)["iteration"] == len(rows(run))


def test_a_signal_to_the_process_and_to_its_group_is_one(tmp_path, monkeypatch):
    learn = TrainingSetup.learn

    def signalled(setup, batch, progress):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        return learn(setup, batch, progress)

    monkeypatch.setattr(TrainingSetup, "learn", signalled)
    outcome = train(options(4), tmp_path)
    assert (outcome.status, outcome.signal) == ("interrupted", signal.SIGINT)
    assert outcome.last_checkpoint.is_file()
    monkeypatch.setattr(stop_signals, "DUPLICATE_SIGNAL_S", -1.0)
    with pytest.raises(KeyboardInterrupt):
        train(options(4), tmp_path / "other")


@pytest.mark.slow
def test_twenty_kills_end_like_an_undisturbed_run(tmp_path):
    steps = ["max_steps=60000", "checkpoint_interval=1500", "hydra.run.dir=run"]
    (tmp_path / "whole").mkdir()
    process = start(tmp_path / "whole", *TINY, *steps)
    process.communicate(timeout=300)
    assert process.returncode == 0
    generator = random.Random(0)
    kills, reached, folder = 0, 15, tmp_path / "cut"
    folder.mkdir()
    arguments = [*TINY, *steps]
    while kills < 20:
        process = start(folder, *arguments)
        if kills % 4 == 3:  # while it starts, or loads
            time.sleep(generator.uniform(0.2, 3.0))
        else:
            wait_for_rows(folder, reached + generator.randint(1, 20), process)
            time.sleep(generator.uniform(0.0, 0.1))
        if process.poll() is not None:
            break
        process.kill()
        process.communicate()
        kills += 1
        reached = len((folder / "run" / "metrics.csv").read_text().splitlines())
        arguments = ["resume=run"]
    process = start(folder, "resume=run")
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert rows(folder / "run") == rows(tmp_path / "whole" / "run")
    assert kills == 20


def test_the_best_checkpoint_of_a_two_sided_run_has_the_weights_that_won_most(tmp_path, monkeypatch, capfd):
    scores = iter([Score(wins=3, losses=7), Score(wins=8, losses=2), Score(wins=2, losses=8)])
    monkeypatch.setattr(series, "play_matches", lambda *args: {"blue": next(scores)})
    train(soccer(5, checkpoint_interval=10**6), tmp_path)
    with open(tmp_path / "metrics.csv", newline="") as file:
        won = [row["win_rate_vs_random"] for row in csv.DictReader(file)]
    assert won == ["", "0.3", "", "0.8", "0.2"]  # every second iteration, and after the last one
    best = checkpoint.load(tmp_path / "checkpoints" / "best.pt")
    assert best["agent_steps"] == 4 * SOCCER_BATCH
    said = "640 steps: of 10 matches against a random side 8 won, 0 drawn, 2 lost"
    assert said in capfd.readouterr().out


@pytest.mark.parametrize(
    ("played", "best_at"),
    [
        ([Score(wins=10), Score(wins=10), Score(wins=10)], 6),  # as good as before: the newer weights
        ([Score(draws=10), Score(losses=10), Score(draws=9, losses=1)], 2),  # a draw is half a win
        ([Score(losses=10), Score(losses=10), Score(losses=10)], 2),  # more lost matches prove nothing
    ],
)
def test_ties_draws_and_losses_of_series(tmp_path, monkeypatch, played, best_at):
    scores = iter(played)
    monkeypatch.setattr(series, "play_matches", lambda *args: {"blue": next(scores)})
    train(soccer(6), tmp_path)
    assert checkpoint.load(tmp_path / "checkpoints" / "best.pt")["agent_steps"] == best_at * SOCCER_BATCH


def test_sides_of_different_names_are_chosen_by_their_matches_too(tmp_path, monkeypatch):
    scores = iter([Score(wins=9, losses=1), Score(wins=1, losses=9)])
    monkeypatch.setattr(series, "play_matches", lambda *args: {"blue": next(scores)})
    batch = 2 * 3 * ROUNDS
    env, matches = (
        EnvConfig(name="StrikersVsGoalie", num_areas=2),
        MatchConfig(interval=batch, count=2, opponents=0),
    )
    ppo = PPOConfig(minibatch_size=40)
    train(options(2, env=env, matches=matches, ppo=ppo, max_steps=2 * batch), tmp_path)
    assert checkpoint.load(tmp_path / "checkpoints" / "best.pt")["agent_steps"] == batch


def test_where_the_strikers_always_win_the_best_is_who_scores_sooner(tmp_path, monkeypatch):
    def sides(scored_after):
        won, lost = ((1, scored_after),) * 32, ((-1, 50),) * 32
        return {
            "Striker?team=0": Score(wins=32, decisions=32 * scored_after, played=won),
            "Goalie?team=1": Score(losses=32, decisions=32 * 50, played=lost),
        }

    scores = iter([sides(60), sides(40), sides(70)])
    monkeypatch.setattr(series, "play_matches", lambda *args: next(scores))
    batch = 2 * 3 * ROUNDS
    matches = MatchConfig(interval=batch, count=64, opponents=0)
    env, ppo = EnvConfig(name="StrikersVsGoalie", num_areas=2), PPOConfig(minibatch_size=40)
    train(options(2, env=env, matches=matches, ppo=ppo, max_steps=3 * batch), tmp_path)

    assert checkpoint.load(tmp_path / "checkpoints" / "best.pt")["agent_steps"] == 2 * batch
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["Striker?team=0/match_decisions_vs_random"]) for row in rows] == [60, 40, 70]


def test_matches_want_two_sides_and_say_so_before_the_first_step(tmp_path):
    with pytest.raises(ConfigError, match=r"matches.interval=100: .* two sides .* 3DBall has 3DBall\?team=0"):
        train(options(2, matches=MatchConfig(interval=100)), tmp_path)
    assert not (tmp_path / "checkpoints").exists()


def test_a_series_that_fails_costs_no_row_and_is_played_after_the_resume(tmp_path, monkeypatch):
    def failing(*args):
        raise EnvironmentFailure("the player of the matches crashed")

    monkeypatch.setattr(series, "play_matches", failing)
    with pytest.raises(EnvironmentFailure):
        train(soccer(5), tmp_path)
    monkeypatch.setattr(series, "play_matches", lambda *args: {"blue": Score(wins=1)})
    train(soccer(5), tmp_path, checkpoint.newest_good(tmp_path)[0])
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = [(row["iteration"], row["win_rate_vs_random"]) for row in csv.DictReader(file)]
    assert rows == [("1", ""), ("2", ""), ("3", "1.0"), ("4", ""), ("5", "1.0")]


def test_a_series_at_the_end_leaves_the_rhythm_of_a_longer_run_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(series, "play_matches", lambda *args: {"blue": Score(wins=1)})
    first = train(soccer(3), tmp_path / "a")
    assert first.last_checkpoint is not None
    train(soccer(5), tmp_path / "a", first.last_checkpoint)
    with open(tmp_path / "a" / "metrics.csv", newline="") as file:
        won = [row["win_rate_vs_random"] for row in csv.DictReader(file)]
    assert won == ["", "1.0", "1.0", "1.0", "1.0"]


def test_a_training_says_what_the_environment_needs_and_the_trainer_lacks(tmp_path, capfd):
    note = "this needs curiosity"
    train(options(1, env=EnvConfig(num_areas=AREAS, note=note)), tmp_path)
    assert f"note: {note}" in capfd.readouterr().out


def test_the_folder_is_named_when_the_run_begins(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["env=Basic", "env.num_areas=2", "collect.rounds=4", "ppo.minibatch_size=4", "export_onnx=false"]
    lines = [*small, "max_steps=8", "log.loggers=[]"]
    assert train_main([*lines, "env.params.nothing=1"]) == 2
    captured = capsys.readouterr()
    assert "has no parameter 'nothing'" in captured.err and captured.out == ""
    assert train_main([*lines, "hydra.run.dir=mine"]) == 0
    assert capsys.readouterr().out.startswith("run folder: mine\n")
    assert train_main(["resume=mine", "max_steps=16", "behaviors.Nobody.ppo.lr=1"]) == 2
    assert capsys.readouterr().out == ""
    assert train_main(["resume=mine", "max_steps=16"]) == 0
    assert capsys.readouterr().out.startswith("resuming from mine")
