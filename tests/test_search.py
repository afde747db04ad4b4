"""mappo-search: spaces, trials that are asked, reported and told, folders that go on, processes that die."""

from __future__ import annotations

import csv
import math
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from mappo_unity.cli import search_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import SearchConfig, SearchObjective
from mappo_unity.errors import ConfigError
from mappo_unity.training.search import checks
from mappo_unity.training.search.checks import SearchPlan, check_search
from mappo_unity.training.search.messages import GO, MARKS, PRUNE, STOP, Run, Task, TrialResult
from mappo_unity.training.search.space import Choices, Range, read_space, spaces, to_line
from mappo_unity.training.search.table import best_command, rows_of, write_csv

SPACE = "ppo.lr: {low: 1e-4, high: 1e-2, log: true}\nppo.epochs: {low: 1, high: 8}\n"


@pytest.fixture(autouse=True)
def _place(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("space.yaml").write_text(SPACE)


@pytest.fixture
def optuna() -> Any:
    """Return Optuna; skip where it is missing or too old."""
    return pytest.importorskip("optuna", minversion="4.0")


@pytest.fixture
def any_optuna(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let checks find Optuna, so that what comes behind it can be tested without."""
    monkeypatch.setattr(checks.importlib.metadata, "version", lambda name: "4.0.0")


def make_plan(*lines: str, **options: Any) -> SearchPlan:
    return check_search(SearchConfig(**{"search": "space.yaml", "out": "s"} | options), list(lines), None)


# spaces


def test_each_kind_of_entry_is_read() -> None:
    Path("mine.yaml").write_text(
        SPACE
        + "ppo.gae_lambda: {low: 0.9, high: 1}\n"
        + "model.hidden: [[64, 64], [128]]\n"
        + "model.activation: [tanh, relu]\n"
        + "ppo.target_kl: [null, 0.02]\n"
        + "model.layer_norm: [true, false]\n"
        + "env.params.mass: {low: 1, high: 4}\n"
    )
    assert read_space("mine.yaml") == {
        "ppo.lr": Range(1e-4, 1e-2, log=True, whole=False),
        "ppo.epochs": Range(1, 8, log=False, whole=True),
        "ppo.gae_lambda": Range(0.9, 1.0, log=False, whole=False),
        "model.hidden": Choices(("[64,64]", "[128]")),
        "model.activation": Choices(("tanh", "relu")),
        "ppo.target_kl": Choices(("null", "0.02")),
        "model.layer_norm": Choices(("true", "false")),
        "env.params.mass": Range(1, 4, log=False, whole=True),
    }


@pytest.mark.parametrize("name", spaces())
def test_shipped_spaces_fit_the_presets(name: str, any_optuna: None) -> None:
    plan = make_plan("env=3DBall", search=name)
    assert plan.space and plan.max_steps == 400_000


def test_the_space_of_a_preset_holds_it_so_that_a_search_begins_there(any_optuna: None) -> None:
    assert make_plan("env=3DBall", search="3DBall").preset is not None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ppo.lr: {low: 1e-2, high: 1e-4}", ["ppo.lr", "low must be less than high"]),
        ("ppo.lr: {low: 1e-4, high: 1e-4}", ["low must be less than high"]),
        ("ppo.entropy_coef: {low: 0, high: 1, log: true}", ["ppo.entropy_coef", "low must be > 0"]),
        ("ppo.lr: {low: 1e-4, high: 1e-2, log: 10}", ["log must be true or false"]),
        ("ppo.lr: {low: 1e-4, high: .inf}", ["inf is not a finite number"]),
        ("ppo.lr: {low: 1e-4, hi: 1e-2}", ["hi is unknown", "{low: 1, high: 2, log: false}"]),
        ("ppo.lr: {low: 1e-4}", ["low and high must be given"]),
        ("ppo.epochs: {low: 1, high: 2.5}", ["ppo.epochs=2.5 does not fit", "a whole number"]),
        ("ppo.lrr: {low: 1, high: 2}", ["ppo.lrr is not an option", "did you mean ppo.lr"]),
        ("ppo: {lr: [1, 2]}", ["ppo is a section"]),
        ("ppo: {lr: 1e-3}", ["ppo is a section", "name its options"]),
        ("model.hidden: {low: 1, high: 2}", ["model.hidden is no number", "list of choices"]),
        ("model.activation: [tanh, tann]", ["model.activation=tann does not fit"]),
        ("ppo.epochs: [3]", ["leaves nothing to choose"]),
        ("ppo.epochs: []", ["leaves nothing to choose"]),
        ("ppo.epochs: [3, 3]", ["names a value twice"]),
        ("ppo.epochs: 3", ["neither a range", "belongs on the command line"]),
        ("seed: [1, 2]", ["seed cannot be searched", "seeds=N"]),
        ("max_steps: [1, 2]", ["max_steps cannot be searched"]),
        ("recipe: [none, mlagents]", ["recipe chooses presets"]),
        ("", ["holds no options to search"]),
        ("ppo.lr: {low: 1", ["cannot be read"]),
    ],
)
def test_a_wrong_space_is_told(text: str, words: list[str]) -> None:
    Path("wrong.yaml").write_text(text + "\n")
    with pytest.raises(ConfigError) as caught:
        read_space("wrong.yaml")
    for word in ["wrong.yaml", *words]:
        assert word in str(caught.value)


def test_values_become_lines_that_mappo_train_reads() -> None:
    lines = [to_line("ppo.lr", 1.5e-05), to_line("ppo.epochs", 4), to_line("model.hidden", "[64,32]")]
    config = compose_config(lines).config
    assert (config.ppo.lr, config.ppo.epochs, config.model.hidden) == (1.5e-05, 4, [64, 32])


# the command line


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], ["search is not given"]),
        (["search=pppo"], ["search=pppo does not exist", "did you mean ppo", "3DBall, ppo"]),
        (["search=none.yaml"], ["there is no such file"]),
        (["search=space.yaml", "ppo.lr=1e-3"], ["ppo.lr is searched", "given on the command line"]),
        (["search=space.yaml", "trials=0"], ["trials=0 is out of range"]),
        (["search=space.yaml", "workers=0"], ["workers=0 is out of range"]),
        (["search=space.yaml", "seeds=0"], ["seeds=0 is out of range"]),
        (["search=space.yaml", "trials=2", "trials=3"], ["trials is given twice"]),
        (["search=space.yaml", "trails=3"], ["trails is an option neither", "did you mean trials"]),
        (["search=space.yaml", "objective=time"], ["objective=time needs", "goal=95"]),
        (["search=space.yaml", "objective=best"], ["objective=best does not fit", "decisions"]),
        (["search=space.yaml", "goal=9", "objective=final_return"], ["goal=9 goes with objective=decisions"]),
        (["search=space.yaml", "goal=9", "stop_at_return=8"], ["goal=9 sets stop_at_return"]),
        (["search=space.yaml", "goal=.inf"], ["goal"]),
        (["search=space.yaml", "resume=x"], ["resume does not go with a search", "out=FOLDER"]),
        (["search=space.yaml", "output_dir=x"], ["output_dir does not go with a search"]),
        (["search=space.yaml", "hydra/launcher=joblib"], ["hydra/launcher does not go with a search"]),
        (["search=space.yaml", "seed=1,2"], ["several values for seed"]),
        (["search=space.yaml", "-m"], ["-m is not an option"]),
        (["search=space.yaml", "env=Nope"], ["env=Nope does not exist"]),
        (["search=space.yaml", "out=space.yaml"], ["out=space.yaml is a file"]),
        (["search=space.yaml", "out=space.yaml/x"], ["out=space.yaml/x cannot be made (Not a directory"]),
        (["search=space.yaml", "out=."], ["out=. is not empty and holds no search", "give a new folder"]),
    ],
)
def test_a_search_that_cannot_be_is_told(
    lines: list[str], words: list[str], any_optuna: None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert search_main(lines) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and [path.name for path in Path().iterdir()] == ["space.yaml"]
    for word in words:
        assert word in captured.err


def test_a_damaged_record_of_a_search_is_told(any_optuna: None) -> None:
    Path("space.yaml").write_text("ppo.gamma: {low: 0.9, high: 0.99}\n")
    Path("folder").mkdir()
    Path("folder/search.json").write_text("[]")
    with pytest.raises(ConfigError, match="search.json is no record of a search any more: give a new folder"):
        make_plan(out="folder")


def test_a_line_that_was_cut_off_ends_no_search(optuna: Any) -> None:
    from mappo_unity.training.search.study import JOURNAL, SearchStudy

    plan = make_plan(trials=4)
    plan.folder.mkdir()
    study = SearchStudy(plan)
    study.suggest(study.ask())
    journal = plan.folder / JOURNAL
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code": 4, "work')

    again = SearchStudy(plan)
    assert len(again.trials) == 1 and journal.read_bytes().startswith(whole)
    again.ask()
    assert len(SearchStudy(plan).trials) == 2


def test_values_at_the_ends_of_the_space_are_tried_first(any_optuna: None) -> None:
    Path("space.yaml").write_text("ppo.gamma: {low: 0.9, high: 1.5}\n")
    with pytest.raises(ConfigError, match=r"ppo.gamma=1.5 is out of range.*in the trial ppo.gamma=1.5"):
        make_plan()


@pytest.mark.parametrize("version", ["", "2.10.1"])
def test_an_old_optuna_is_refused(
    version: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def installed(name: str) -> str:
        if not version:
            raise checks.importlib.metadata.PackageNotFoundError(name)
        return version

    monkeypatch.setattr(checks.importlib.metadata, "version", installed)
    assert search_main(["search=space.yaml"]) == 2
    error = capsys.readouterr().err
    assert "needs the package optuna, 4 or newer" in error and version in error and "search" in error


def test_help_names_the_spaces(capsys: pytest.CaptureFixture[str]) -> None:
    assert search_main(["--help"]) == 0
    assert "search=3DBall|ppo" in capsys.readouterr().out


# the study


def test_the_first_trial_is_the_preset_and_the_later_ones_lie_in_the_space(optuna: Any) -> None:
    from mappo_unity.training.search.study import SearchStudy

    plan = make_plan("env=3DBall", trials=12)
    plan.folder.mkdir()
    study = SearchStudy(plan)
    assert study.suggest(study.ask()) == ["ppo.lr=0.003", "ppo.epochs=3"]  # conf/env/3DBall.yaml
    for _ in range(11):
        config = compose_config(study.suggest(study.ask())).config
        assert 1e-4 <= config.ppo.lr <= 1e-2 and 1 <= config.ppo.epochs <= 8


def test_a_preset_outside_of_the_space_is_no_trial(any_optuna: None) -> None:
    assert make_plan("env=3DBall").preset == {"ppo.lr": 3e-3, "ppo.epochs": 3}
    Path("space.yaml").write_text("ppo.epochs: {low: 5, high: 8}\n")
    assert make_plan("env=3DBall").preset is None


def result_of(lines: list[str], plan: SearchPlan) -> TrialResult:
    """Return a made-up result: the return falls with the distance of ppo.lr from 1e-3, in decades."""
    rate = float(dict(line.split("=") for line in lines)["ppo.lr"])
    distance = abs(math.log10(rate / 1e-3))
    is_return = plan.objective is SearchObjective.final_return
    return TrialResult("complete", [-distance if is_return else 1000 * distance], -distance, 100, 1.0)


@pytest.mark.parametrize("goal", [None, 95.0])
def test_trials_come_near_the_best(goal: float | None, optuna: Any) -> None:
    from mappo_unity.training.search.study import SearchStudy

    plan = make_plan("env=3DBall", trials=40, goal=goal)
    plan.folder.mkdir()
    study = SearchStudy(plan)
    for _ in range(40):
        trial = study.ask()
        study.tell(trial, result_of(study.suggest(trial), plan))

    rows = rows_of(study.trials, plan)
    rates = [float(row.lines[0].partition("=")[2]) for row in rows]
    assert abs(math.log10(rates[0] / 1e-3)) < 0.1  # the preset's 3e-3 is 0.48 away
    assert [abs(math.log10(rate / 1e-3)) for rate in rates] == sorted(
        abs(math.log10(rate / 1e-3)) for rate in rates
    )


@pytest.mark.parametrize("goal", [None, 95.0])
def test_a_trial_below_the_median_ends_early(goal: float | None, optuna: Any) -> None:
    from mappo_unity.training.search.study import SearchStudy

    plan = make_plan(goal=goal)
    plan.folder.mkdir()
    study = SearchStudy(plan)
    for number in range(4):
        trial = study.ask()
        assert not study.report(trial, [(mark, 10.0 + number) for mark in range(1, MARKS + 1)])
        study.tell(trial, TrialResult("complete", [10.0], 10.0))

    poor, good = study.ask(), study.ask()
    assert not study.report(poor, [(1, 5.0)])  # too early to say
    assert study.report(poor, [(1, 5.0), (11, 5.0)]) and not study.report(good, [(11, 50.0)])
    assert not study.report(poor, [])
    study.suggest(poor)
    study.tell(poor, TrialResult("pruned", [], 5.0, 50, 2.0))
    row = rows_of(study.trials, plan)[4]
    assert (row.number, row.status, row.value, row.return_mean) == (4, "pruned", None, 5.0)


# processes, with threads in their places


class FakeProcess:
    """A thread that answers as a worker does; to be killed is to close its pipe."""

    exitcode = -9

    def __init__(self, answer: Callable[[Task, Connection], TrialResult | None]) -> None:
        self.pipe, theirs = Pipe()
        self._thread = threading.Thread(target=self._work, args=(answer, theirs), daemon=True)
        self._thread.start()

    def _work(self, answer: Callable[[Task, Connection], TrialResult | None], pipe: Connection) -> None:
        with pipe:
            while (task := pipe.recv()) is not None:
                result = answer(task, pipe)
                if result is None:
                    return
                pipe.send(result)

    def join(self, timeout: float | None = None) -> None:
        self._thread.join(timeout)

    def kill(self) -> None:
        assert not self._thread.is_alive(), "it was still at work"


def search(plan: SearchPlan, monkeypatch: pytest.MonkeyPatch, answer: Any) -> Any:
    from mappo_unity.training.search import driver

    def start(*_: Any) -> Any:
        process = FakeProcess(answer)
        return process, process.pipe

    monkeypatch.setattr(driver, "start_child", start)
    return driver.run_search(plan, lambda number, rows: None)


def good(task: Task, pipe: Connection) -> TrialResult:
    return TrialResult("complete", [float(task.number)] * len(task.runs), float(task.number), 100, 1.0)


def test_a_search_goes_on_to_the_wanted_number(optuna: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    tasks: list[Task] = []

    def answer(task: Task, pipe: Connection) -> TrialResult:
        tasks.append(task)
        return good(task, pipe)

    plan = make_plan("seed=5", trials=3, workers=2, seeds=2)
    result = search(plan, monkeypatch, answer)
    assert result.exit_code == 0 and [row.number for row in result.rows] == [2, 1, 0]
    first = next(task for task in tasks if task.number == 0)
    assert [run.folder for run in first.runs] == [Path("s/000-5"), Path("s/000-6")]
    assert [run.lines[-1] for run in first.runs] == ["seed=5", "seed=6"]

    assert len(search(plan, monkeypatch, answer).rows) == len(tasks) == 3  # nothing is left
    more = make_plan("seed=5", trials=5, workers=2, seeds=2)
    assert len(search(more, monkeypatch, answer).rows) == len(tasks) == 5
    with pytest.raises(ConfigError, match=r"another search: seeds 2 there, 1 here"):
        make_plan("seed=5")


def test_a_trial_whose_process_died_is_run_again(optuna: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    died: list[list[Run]] = []

    def answer(task: Task, pipe: Connection) -> TrialResult | None:
        if task.number == 1 and not died:
            died.append(task.runs)
            return None
        assert task.number != 1 or task.runs == died[0]  # the same options in the same folder
        return good(task, pipe)

    result = search(make_plan(trials=3, workers=1), monkeypatch, answer)
    assert [(row.number, row.status) for row in result.rows] == [
        (2, "complete"),
        (1, "complete"),
        (0, "complete"),
    ]
    assert len(died) == 1


def test_a_trial_that_always_dies_has_failed(optuna: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    result = search(make_plan(trials=2, workers=1), monkeypatch, lambda task, pipe: None)
    assert [row.status for row in result.rows] == ["failed", "failed"] and result.exit_code == 1
    assert result.rows[0].error == "its process died (exit code -9), 3 times"


def test_a_signal_ends_the_search_and_it_goes_on(optuna: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []

    def answer(task: Task, pipe: Connection) -> TrialResult:
        if task.number == 1 and not heard:
            signal.raise_signal(signal.SIGINT)
            answers = iter(lambda: (pipe.send([]), pipe.recv())[1], GO)
            heard.append(next(answers, GO))
            while heard[-1] == GO:  # the handler runs in the main thread, a moment later
                pipe.send([])
                heard[-1] = pipe.recv()
            return TrialResult("stopped")
        return good(task, pipe)

    plan = make_plan(trials=3, workers=1)
    stopped = search(plan, monkeypatch, answer)
    assert stopped.exit_code == 130 and heard == [STOP]
    assert [(row.number, row.status) for row in stopped.rows] == [(0, "complete"), (1, "unfinished")]

    resumed = search(plan, monkeypatch, answer)
    assert resumed.exit_code == 0
    assert [(row.number, row.status) for row in resumed.rows] == [(n, "complete") for n in (2, 1, 0)]


def test_a_failed_trial_ends_no_search(optuna: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(task: Task, pipe: Connection) -> TrialResult:
        return TrialResult("failed", error="memory ran out") if task.number == 0 else good(task, pipe)

    result = search(make_plan(trials=2, workers=1), monkeypatch, answer)
    assert [(row.number, row.status) for row in result.rows] == [(1, "complete"), (0, "failed")]
    with Path("s/trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["trial"], row["status"], row["value"]) for row in rows] == [
        ("1", "complete", "1.0"),
        ("0", "failed", ""),
    ]
    assert rows[1]["error"] == "memory ran out" and 1 <= int(rows[0]["ppo.epochs"]) <= 8


def test_the_best_trial_is_a_command_line(any_optuna: None) -> None:
    from mappo_unity.training.search.table import Row

    plan = make_plan("env=3DBall", "env.params.note='a b'", goal=95.0)
    row = Row(7, ("ppo.lr=0.002", "model.hidden=[64,64]"), "complete", 9.0, 99.0, 100, 1.0, None)
    command = best_command([row], plan)
    assert command is not None
    words = ["env=3DBall", "env.params.note='a b'", "ppo.lr=0.002", "model.hidden=[64,64]"]
    assert shlex.split(command) == ["mappo-train", *words]
    assert best_command([replace(row, status="pruned")], plan) is None
    plan.folder.mkdir()
    assert write_csv([row], plan).read_text().splitlines()[1].startswith("7,0.002,,complete,9.0,99.0,100,1.0")


# real runs


def real_task(*lines: str, seeds: int = 1, objective: SearchObjective = SearchObjective.final_return) -> Task:
    fixed = ["env=Basic", "max_steps=800", "collect.batch_size=200", "export_onnx=false", *lines]
    runs = [Run(Path(f"000-{seed}"), [*fixed, f"seed={seed}"]) for seed in range(seeds)]
    return Task(0, runs, objective)


def test_a_trial_is_the_mean_of_ordinary_runs() -> None:
    from mappo_unity.training.search.worker import run_trial

    reports: list[list[tuple[int, float]]] = []

    def report(marks: list[tuple[int, float]]) -> str:
        reports.append(marks)
        return GO

    task = real_task(seeds=2)
    result = run_trial(task, report)
    assert result.status == "complete" and len(result.values) == 2
    last = []
    for run in task.runs:
        with (run.folder / "metrics.csv").open(newline="") as file:
            last.append(float(list(csv.DictReader(file))[-1]["return_mean"]))
    assert result.values == pytest.approx(last) and result.value == pytest.approx(sum(last) / 2)
    # the first run alone is compared with others
    marks = [mark for passed in reports for mark, _ in passed]
    assert marks == list(range(1, MARKS + 1)) and reports[-1] == []

    again = run_trial(task, report)  # both runs are complete: nothing is trained again
    assert (again.values, again.agent_steps) == (result.values, result.agent_steps)


def test_a_pruned_run_ends_and_a_missed_goal_counts_twice() -> None:
    from mappo_unity.training.search.worker import run_trial

    pruned = run_trial(real_task(), lambda marks: PRUNE)
    assert (pruned.status, pruned.values) == ("pruned", []) and pruned.agent_steps < 800

    task = real_task("stop_at_return=1000", objective=SearchObjective.decisions)
    missed = run_trial(task, lambda marks: GO)  # goes on from the checkpoint of the run that was pruned
    assert missed.status == "complete" and missed.values == [2 * missed.agent_steps]


def test_a_run_that_cannot_be_trained_is_a_failed_trial() -> None:
    from mappo_unity.training.search.worker import run_trial

    result = run_trial(real_task("env=custom", "env.factory=no_module:f"), lambda marks: GO)
    assert result.status == "failed" and "no_module" in (result.error or "")
    assert "no_module" in Path("000-0/error.txt").read_text()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_killed_search_leaves_nothing_and_goes_on(optuna: Any, tmp_path: Path) -> None:
    code = "import sys; from mappo_unity.cli import search_main; sys.exit(search_main())"
    lines = ["search=space.yaml", "env=Basic", "max_steps=4000", "trials=2", "workers=2", "out=s"]
    command = [sys.executable, "-c", code, *lines]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, start_new_session=True)
    deadline = time.monotonic() + 120
    while len(list(tmp_path.rglob("metrics.csv"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(list(tmp_path.rglob("metrics.csv"))) == 2, "two trials did not begin within two minutes"
    process.kill()
    process.wait()

    with pytest.raises(ProcessLookupError):  # its workers are of its session, and end when their pipe does
        for _ in range(200):
            os.killpg(process.pid, 0)
            time.sleep(0.1)
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" complete ") >= 2 and "best: mappo-train env=Basic" in done.stdout
