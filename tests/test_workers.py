"""Workers: their batches joined, in this process and in others; replaced, resumed, refused."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from fakes import Record, ScriptedEnv
from tensordict import TensorDictBase

from mappo_unity import keys
from mappo_unity.cli import train_main
from mappo_unity.config.compose import check_effect, compose_config
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.runs import checkpoint
from mappo_unity.scenes.contract.rules import EnvironmentDataError
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.fleet import weights_of
from mappo_unity.training.collection.processes import RemoteWorkers
from mappo_unity.training.collection.several_workers import LocalWorkers
from mappo_unity.training.collection.shared_memory import WorkerProcesses
from mappo_unity.training.collection.worker import Worker
from mappo_unity.training.collection.worker_process import report
from mappo_unity.training.setup import TrainingSetup, set_up

SMALL = [
    *("ppo.minibatch_size=64", "ppo.epochs=1", "model.hidden=[8]", "log.loggers=[]", "log.progress=false"),
    *("export_onnx=false", "checkpoint_interval=1", "seed=5"),
]
ROUND = "ppo.obs_norm_update=round"
SOCCER = ["env=SoccerTwos", "env.num_areas=2", "collect.rounds=12", "collect.workers=2", ROUND, *SMALL]
LOCAL = "collect.engine=local"


def options(*lines: str) -> Config:
    return compose_config(list(lines)).config


def assert_same(found: Any, wanted: Any) -> None:
    """Compare nested dicts, lists and tensors, to the bit."""
    if isinstance(wanted, (dict, TensorDictBase)):
        assert set(found.keys()) == set(wanted.keys())
        for key in wanted.keys():
            assert_same(found[key], wanted[key])
    elif isinstance(wanted, (list, tuple)):
        assert len(found) == len(wanted)
        for one, other in zip(found, wanted):
            assert_same(one, other)
    elif isinstance(wanted, torch.Tensor):
        assert found.dtype == wanted.dtype and torch.equal(found, wanted)
    else:
        assert repr(found) == repr(wanted)  # nan, too


def assert_same_batch(found: Batch, wanted: Batch) -> None:
    assert found.rounds.batch_size == wanted.rounds.batch_size
    assert found.rounds.get("SoccerTwos").batch_size == wanted.rounds.get("SoccerTwos").batch_size
    assert_same(found.rounds, wanted.rounds)
    assert_same(found.following, wanted.following)
    assert found.episodes == wanted.episodes


# --- one fleet of processes for what follows


@pytest.fixture(scope="module")
def processes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TrainingSetup]:
    with set_up(options(*SOCCER), tmp_path_factory.mktemp("run")) as setup:
        setup.fleet.start(setup.policy, keeps_ends=False)
        yield setup


def fleet_of(setup: TrainingSetup) -> WorkerProcesses:
    assert isinstance(setup.fleet, WorkerProcesses)
    return setup.fleet


def test_processes_give_what_workers_in_this_process_give(processes: TrainingSetup, tmp_path: Path) -> None:
    fleet = fleet_of(processes)
    local = LocalWorkers(options(*SOCCER, LOCAL), tmp_path)
    assert local.env == fleet.env and local.env.teams("SoccerTwos") == 2
    before = torch.get_rng_state()
    local.start(processes.policy, keeps_ends=False)

    kept = None
    for _ in range(3):
        weights = weights_of(processes.policy)
        batches = []
        for each in (fleet, local):
            each.request(weights, want_state=True)
            batches.append(each.receive())
        assert_same_batch(*batches)
        if kept is not None:  # the other set of memory: the last batch is still whole
            assert_same(kept[0], kept[1])
        kept = batches[1].rounds.clone(), batches[0].rounds
        with torch.no_grad():
            next(processes.policy.parameters()).add_(0.1)

    assert torch.equal(before, torch.get_rng_state())  # local workers draw from their own generators
    assert_same(
        fleet.state_dict()["workers"][1]["rng"]["torch"], local.state_dict()["workers"][1]["rng"]["torch"]
    )
    local.close()


def test_what_is_on_its_way_when_a_checkpoint_is_written_is_collected_again(
    processes: TrainingSetup, tmp_path: Path
) -> None:
    fleet = fleet_of(processes)
    fleet.request(weights_of(processes.policy), want_state=True)
    fleet.receive()
    fleet.request(weights_of(processes.policy), want_state=True)
    checkpoint.save(tmp_path / "state.pt", fleet.state_dict())

    # what is learnt meanwhile does not change it
    with torch.no_grad():
        next(processes.policy.parameters()).add_(0.1)
    cfg = options(*SOCCER, LOCAL)
    cfg.collect.overlap = True
    resumed = LocalWorkers(cfg, tmp_path)
    resumed.load_state_dict(checkpoint.load(tmp_path / "state.pt"))
    resumed.start(processes.policy, keeps_ends=False)
    resumed.request(weights_of(processes.policy), want_state=True)
    assert_same_batch(resumed.receive(), fleet.receive())
    resumed.close()


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced(processes: TrainingSetup) -> None:
    fleet = fleet_of(processes)
    killed, other = fleet.processes[1].pid, fleet.processes[0].pid
    os.kill(killed, signal.SIGKILL)
    fleet.request(weights_of(processes.policy), want_state=True)
    batch = fleet.receive()

    assert fleet.processes[1].pid != killed and fleet.processes[0].pid == other
    assert batch.restarts == 1 and batch.dropped_episodes == 4 and batch.dropped_steps == 0
    void = batch.void["SoccerTwos"]
    assert void.shape == (2, 2, 2, 1) and bool(void[:, 1].all()) and not bool(void[:, 0].any())
    assert batch.count_decisions("SoccerTwos") == 12 * 8

    fleet.request(weights_of(processes.policy), want_state=True)
    batch = fleet.receive()
    assert batch.restarts == 1 and not batch.void and not batch.dropped_episodes


@pytest.mark.slow
def test_a_worker_that_hangs_is_replaced(processes: TrainingSetup) -> None:
    hung = replaced_hanging(processes)
    with pytest.raises(ProcessLookupError):
        os.kill(hung, 0)


def replaced_hanging(setup: TrainingSetup) -> int:
    """Let a worker hang until another stands in its place, and return its process's id."""
    fleet = setup.fleet
    assert isinstance(fleet, RemoteWorkers)
    hangs = fleet.processes[1]
    pid = hangs.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    hangs.timeout_s = 0.2
    fleet.request(weights_of(setup.policy), want_state=True)
    batch = fleet.receive()
    assert fleet.processes[1] is not hangs and batch.dropped_episodes == 4
    assert batch.count_decisions("SoccerTwos") == 12 * 8
    return pid


def test_too_many_losses_end_the_run(processes: TrainingSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = fleet_of(processes)
    monkeypatch.setattr(fleet._cfg.env, "max_restarts", 0)
    os.kill(fleet.processes[0].pid, signal.SIGKILL)
    fleet.request(weights_of(processes.policy), want_state=True)
    with pytest.raises(EnvironmentFailure) as error:
        fleet.receive()
    assert str(error.value) == (
        "worker 0 failed: its process ended with signal 9. It was replaced 0 times, and env.max_restarts=0 "
        "allows no more"
    )


# --- joining


def uneven_agents(seed: int) -> Any:
    """Return a BaseEnv of three agents; one is asked in every round, the others at a pace of the seed's."""
    every = 2 + seed % 3
    script = []
    for step in range(300):
        rows = [Record(0, obs=step, reward=1.0)]
        if step % every == 0:
            rows += [Record(agent, obs=step + agent, reward=float(agent)) for agent in (1, 2)]
        if step % 7 == 6:
            rows.insert(0, Record(0, obs=-step, ends="interrupted"))
        script.append(rows)
    return ScriptedEnv(script)


def test_workers_that_need_different_rounds_are_learnt_from_as_they_would_be_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = ["env=custom", "env.name=Fake", "env.factory=test_workers:uneven_agents", *SMALL]
    lines += ["collect.batch_size=120", "collect.workers=2", LOCAL, "ppo.normalize_values=none"]
    lines += ["model.normalize_obs=false", "ppo.normalize_advantages=false"]
    with set_up(options(*lines), tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        alone = [set_up_alone(setup, worker) for worker in range(2)]

        own: list[Any] = []
        collect = Worker.collect
        monkeypatch.setattr(Worker, "collect", lambda *call: own.append(collect(*call)) or own[-1])
        for _ in range(3):
            own.clear()
            batch = next(batches)
            lengths = {message.batch.rounds.shape[0] for message in own}
            assert len(lengths) == 2 and batch.rounds.shape[0] == max(lengths)
            assert batch.count_decisions("Fake") == sum(m.batch.count_decisions("Fake") for m in own)

            joined = learnt(learner, batch)
            apart = [learnt(single, message.batch) for single, message in zip(alone, own)]
            assert len(apart[0]) > 40 and joined == sorted(apart[0] + apart[1])


def set_up_alone(setup: TrainingSetup, worker: int) -> Any:
    """Return a learner with the networks of a fleet's, for one worker's batches."""
    from mappo_unity.training.learners import make_learners

    fleet: Any = setup.fleet
    (alone,) = make_learners(setup.cfg, fleet.parts[worker], 60, lambda note: None).values()
    (learner,) = setup.learners.values()
    alone.load_state_dict(learner.state_dict())
    return alone


def learnt(learner: Any, batch: Batch) -> list[tuple[float, ...]]:
    """Return observation, action, advantage and target of what an update would learn from, sorted."""
    buffer, _ = learner.prepare(*batch.of("Fake"))
    rows = buffer[:]
    mask = rows.get("actor_learns", None)
    names = (keys.OBS, keys.ACTION, keys.ADVANTAGE, keys.VALUE_TARGET)
    table = torch.cat([rows.get(name).reshape(-1, 1) for name in names], -1)
    if mask is not None:
        table = table[mask.flatten()]
    return sorted(tuple(round(value, 4) for value in row) for row in table.tolist())


def test_statistics_that_move_with_each_round_have_seen_all_workers_when_a_batch_ends(tmp_path: Path) -> None:
    lines = ["env=3DBall", "env.num_areas=4", "collect.rounds=16", "collect.workers=2", LOCAL, ROUND, *SMALL]
    with set_up(options(*lines), tmp_path) as setup, setup.collecting() as batches:
        (learner,) = setup.learners.values()
        norm = learner.actor.moving_norms[0]
        seen = []
        for _ in range(3):
            rounds = next(batches).rounds.get("3DBall")
            seen.append(rounds.get(keys.OBS).flatten(0, -2).double())
            rows = torch.cat(seen)
            assert int(norm.count) == len(rows)
            torch.testing.assert_close(norm.mean.double(), rows.mean(0), atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(norm.var.double(), rows.var(0, unbiased=False), atol=1e-5, rtol=1e-4)

        # a worker has begun with what all had seen before, and moved by its own rounds
        fleet: Any = setup.fleet
        (own,) = fleet._workers[1]._policy.actors.values()
        half = seen[2].view(16, 2, -1, seen[2].shape[-1])[:, 1].flatten(0, 1)
        rows = torch.cat([*seen[:2], half])
        assert int(own.moving_norms[0].count) == len(rows)
        torch.testing.assert_close(own.moving_norms[0].mean.double(), rows.mean(0), atol=1e-5, rtol=1e-5)


def test_workers_learn_that_statistics_move_once_the_critic_is_warm(tmp_path: Path) -> None:
    lines = ["env=3DBall", "env.num_areas=4", "collect.rounds=16", "collect.workers=2", LOCAL, ROUND, *SMALL]
    lines.append("ppo.critic_warmup_steps=65")  # two batches of 64 decisions
    with set_up(options(*lines), tmp_path) as setup, setup.collecting() as batches:
        fleet: Any = setup.fleet
        moving = []
        for _ in range(4):
            batch = next(batches)
            (own,) = fleet._workers[1]._policy.actors.values()
            moving.append(len(own.moving_norms))
            setup.learn(batch, 0.0)
    assert moving == [0, 0, 1, 1]


# --- training and resuming


@pytest.mark.parametrize(
    "lines", [[], ["ppo.epochs=3", "ppo.recompute_advantages=true", "ppo.shuffle_members=true"]]
)
def test_a_resumed_run_with_workers_is_the_whole_one(tmp_path: Path, lines: list[str]) -> None:
    check_resume(tmp_path, "env=DungeonEscape", "env.num_areas=2", "model.memory=gru", ROUND, LOCAL, *lines)


@pytest.mark.slow
@pytest.mark.parametrize("lines", [["collect.overlap=true", ROUND], ["collect.overlap=false"]])
def test_a_resumed_run_with_processes_is_the_whole_one(tmp_path: Path, lines: list[str]) -> None:
    check_resume(tmp_path, "env=DungeonEscape", "env.num_areas=2", *lines)


def check_resume(folder: Path, *lines: str) -> None:
    """Compare four iterations with two, and two more after a resume."""
    lines = (*SMALL, "collect.workers=2", "collect.rounds=16", "keep_checkpoints=9", *lines)
    whole, parts = folder / "whole", folder / "parts"
    assert train_main([*lines, "max_steps=400", f"hydra.run.dir={whole}"]) == 0
    states = sorted((whole / "checkpoints").glob("step_*.pt"))
    assert len(states) >= 4
    assert train_main([*lines, "max_steps=400", f"hydra.run.dir={parts}"]) == 0
    for late in sorted((parts / "checkpoints").glob("step_*.pt"))[2:]:
        late.unlink()
    (parts / "checkpoints" / "best.pt").unlink()
    assert train_main([f"resume={parts}"]) == 0

    one, other = (checkpoint.load(f / "checkpoints" / states[-1].name) for f in (whole, parts))
    for state in (one, other):
        del state["wall_s"]
    assert_same(other, one)


def test_the_number_of_workers_cannot_change_with_resume(tmp_path: Path, capsys: Any) -> None:
    lines = ["env=3DBall", "env.num_areas=2", "collect.rounds=16", *SMALL, f"hydra.run.dir={tmp_path}"]
    assert train_main([*lines, "max_steps=32"]) == 0
    assert train_main([f"resume={tmp_path}", "max_steps=64", "collect.workers=2", LOCAL]) == 2
    assert "collect.workers=0, which cannot change with resume; here it is 2" in capsys.readouterr().err


def has_no_licence(seed: int) -> Any:
    raise ValueError("no licence")


@pytest.mark.parametrize(
    "engine",
    [LOCAL, pytest.param("collect.engine=processes", marks=pytest.mark.slow)],
)
def test_what_an_environment_raises_keeps_its_text_and_exit_code(
    tmp_path: Path, capsys: Any, engine: str
) -> None:
    cases = [
        (3, ["env.factory=failing_env:make", "+env.params.at=12"]),  # it failed while it ran
        (2, ["env.factory=failing_env:make", "+env.params.at=12", "+env.params.how=sends_nan"]),
        (2, ["env.factory=test_workers:has_no_licence"]),
    ]
    said = []
    for workers in ([], ["collect.workers=2", engine]):
        for code, case in cases:
            lines = ["env=custom", "env.name=Mine", *case, "collect.rounds=8", *SMALL, *workers]
            lines += ["max_steps=100000", f"hydra.run.dir={tmp_path / str(len(said))}"]
            assert train_main(lines) == code
            said.append(capsys.readouterr().err)
    assert "the game broke" in said[0] and "no licence" in said[2] and said[:3] == said[3:]


def test_errors_keep_their_type_on_their_way_to_the_driver() -> None:
    import pickle

    error = EnvironmentDataError("nobody plays")
    error.details = ("line 3",)
    told = pickle.loads(pickle.dumps(report(error))).error
    assert type(told) is EnvironmentDataError and str(told) == "nobody plays" and told.details == ("line 3",)
    assert (
        report(AssertionError("ours")).error is None
        and "AssertionError: ours" in report(AssertionError("ours")).text
    )


@pytest.mark.slow
def test_a_driver_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    lines = [*SOCCER, "collect.overlap=true", "max_steps=100000000", f"hydra.run.dir={tmp_path / 'run'}"]
    # no `if __name__ == "__main__"`: workers do not import the script
    code = f"from mappo_unity.cli import train_main\ntrain_main({lines!r})\n"
    script = tmp_path / "script.py"
    script.write_text(code)
    driver = subprocess.Popen([sys.executable, str(script)], cwd=tmp_path, stdout=subprocess.DEVNULL)
    try:
        wait_for(lambda: (tmp_path / "run" / "checkpoints").is_dir())
        workers = children(driver.pid)
        assert len(workers) >= 2
    finally:
        driver.kill()
        driver.wait()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))


def children(pid: int) -> list[int]:
    """Return the processes that a process has started (Linux)."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def wait_for(condition: Any, within_s: float = 300.0) -> None:
    until = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until, "it took too long"
        time.sleep(0.05)


# --- options


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        (["env.num_areas=9", "collect.workers=2"], "env.num_areas=9 cannot be shared by collect.workers=2"),
        (["env.num_areas=3", "collect.workers=4"], "it must be a multiple of 4, such as 4"),
        (["env.num_areas=null", "collect.workers=2"], "give env.num_areas, a multiple of 2"),
        (["collect.workers=-1"], "collect.workers=-1"),
        (["collect.workers=2", "collect.timeout_s=0"], "collect.timeout_s=0"),
        (["collect.overlap=true"], "needs collect.workers=1 or more with collect.engine=processes"),
        (["collect.workers=2", LOCAL, "collect.overlap=true"], "needs collect.workers=1 or more"),
        (["collect.workers=2", "env.backend=editor"], "there is one Editor"),
        (
            ["env=WallJump", "parameters=WallJump_curriculum", "collect.workers=2", "collect.overlap=true"],
            "has lessons, which do not go with collect.overlap=true",
        ),
        (
            ["env.backend=player", "env.file_name=x", "env.num_players=3", "collect.workers=2"],
            "env.num_players=3 cannot be shared by collect.workers=2: it must be a multiple of 2, such",
        ),
    ],
)
def test_what_workers_cannot_do_is_refused(lines: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        options(*lines)
    assert text in str(error.value)


@pytest.mark.parametrize(
    ("lines", "workers"),
    [
        (["parameters=WallJump_curriculum"], 0),
        (["env.params.big_wall_height={lessons: [{value: 4}]}"], 0),
        (["parameters=WallJump_curriculum", "collect.workers=2"], 2),
        (["collect.workers=0"], 0),
        ([LOCAL], 1),
        (["bc.only=true", "bc.demos=[x.demo]"], 0),
        (["self_play.save_steps=1000", "self_play.team_change=5000"], 0),
    ],
)
def test_a_presets_overlap_gives_way(lines: list[str], workers: int) -> None:
    collect = options("env=WallJump", *lines).collect
    assert (collect.workers, collect.overlap) == (workers, False)
    with pytest.raises(ConfigError, match="overlap=true|bc.only=true"):
        options("env=WallJump", *lines, "collect.overlap=true")


@pytest.mark.parametrize(
    ("lines", "workers"),
    [
        ([], 2),
        (["env.num_areas=6"], 2),
        (["env.num_areas=1"], 1),
        (["env.num_areas=null"], 0),
        (["env.backend=player", "env.file_name=x"], 1),
        (["env.backend=player", "env.file_name=x", "env.num_players=4"], 2),
        (["env.backend=editor"], 1),
        (["env.backend=custom", "env.factory=a:b"], 2),
    ],
)
def test_a_preset_has_as_many_workers_as_can_share(lines: list[str], workers: int) -> None:
    collect = options("env=Pyramids", *lines).collect
    assert (collect.workers, collect.overlap) == (workers, workers > 0)


def test_a_team_change_without_a_pool_goes_with_overlap() -> None:
    recipe = ["env=SoccerTwos", "recipe=mlagents", "self_play.save_steps=null"]
    cfg = options(*recipe, "collect.workers=2", "collect.overlap=true")
    assert cfg.self_play.team_change is not None and not cfg.self_play.is_on and cfg.collect.overlap


def test_options_of_processes_have_an_effect_where_there_are_some() -> None:
    for lines in (["collect.timeout_s=9"], ["collect.engine=processes"], ["env.max_restarts=3"]):
        key = lines[0].partition("=")[0]
        with pytest.raises(ConfigError, match=f"{key}=.* has no effect"):
            check_effect(lines, [options(*lines)])
        check_effect([*lines, "collect.workers=2"], [options(*lines, "collect.workers=2")])


def test_lessons_reach_workers(tmp_path: Path) -> None:
    lines = ["env=WallJump", "env.num_areas=4", "collect.rounds=8", *SMALL, "collect.workers=2", LOCAL]
    completion = "{measure: progress, threshold: 0.1, behavior: SmallWallJump, min_lesson_length: 1"
    completion += ", require_reset: true}"
    first = f"{{name: a, value: 1.0, completion: {completion}}}"
    lines += [f"env.params.small_wall_height={{lessons: [{first}, {{name: b, value: 2.0}}]}}"]
    assert train_main([*lines, "max_steps=400", f"hydra.run.dir={tmp_path}"]) == 0
    with (tmp_path / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["lesson/small_wall_height"] for row in rows][-1] == "1.0"
    newest = sorted((tmp_path / "checkpoints").glob("step_*.pt"))[-1]
    for worker in checkpoint.load(newest)["workers"]:
        assert "2.0" in str(worker["env"]["scene"]["parameters"])
