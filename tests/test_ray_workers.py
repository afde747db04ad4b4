"""Workers as actors of Ray: the same batches as elsewhere; lost and replaced; a cluster without room."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from test_workers import (
    LOCAL,
    SOCCER,
    assert_same_batch,
    options,
    replaced_hanging,
    wait_for,
)

from mappo_unity.cli import train_main
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.training import setup as training_setup
from mappo_unity.training.collection.fleet import weights_of
from mappo_unity.training.collection.several_workers import LocalWorkers
from mappo_unity.training.setup import TrainingSetup, set_up

RAY = "collect.engine=ray"

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Ray runs elsewhere")


def test_without_the_package_the_extra_is_named(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_setup, "is_installed", lambda module: module != "ray")
    run = tmp_path / "run"
    assert train_main(["env=3DBall", "collect.workers=2", RAY, f"hydra.run.dir={run}"]) == 2
    said = capsys.readouterr().err
    assert "collect.engine=ray needs the package ray, which is not installed: " in said
    assert " ray\n" in said or "[ray]" in said
    assert said.count("\n") == 1 and not run.exists()


def test_overlap_goes_with_ray() -> None:
    assert options("collect.workers=2", RAY, "collect.overlap=true").collect.overlap


# --- one fleet for what follows, in a cluster of its own with room for two workers


@pytest.fixture(scope="module")
def actors(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TrainingSetup]:
    ray = pytest.importorskip("ray")
    before = signal.getsignal(signal.SIGTERM)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RAY_ADDRESS", raising=False)
        with set_up(options(*SOCCER, RAY), tmp_path_factory.mktemp("run")) as setup:
            assert signal.getsignal(signal.SIGTERM) == before  # Ray's own would end the run at once
            setup.fleet.start(setup.policy, keeps_ends=False)
            yield setup
    assert not ray.is_initialized()


def fleet_of(setup: TrainingSetup) -> Any:
    return setup.fleet


def test_actors_give_what_workers_in_this_process_give(actors: TrainingSetup, tmp_path: Path) -> None:
    fleet = fleet_of(actors)
    local = LocalWorkers(options(*SOCCER, LOCAL), tmp_path)
    assert local.env == fleet.env
    local.start(actors.policy, keeps_ends=False)
    for _ in range(3):
        weights = weights_of(actors.policy)
        batches = []
        for each in (fleet, local):
            each.request(weights, want_state=True)
            batches.append(each.receive())
        assert_same_batch(*batches)
        with torch.no_grad():
            next(actors.policy.parameters()).add_(0.1)
    local.close()


def test_workers_are_not_left_behind_by_other_work(actors: TrainingSetup) -> None:
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    fleet_of(actors).request(weights_of(actors.policy), want_state=True)
    fleet_of(actors).receive()
    pids = [process.pid for process in fleet_of(actors).processes]
    assert [os.getpriority(os.PRIO_PROCESS, pid) for pid in pids] == [mine] * 2


def test_weights_are_put_into_the_store_once_an_iteration(
    actors: TrainingSetup, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray

    put = []
    original = ray.put
    monkeypatch.setattr(ray, "put", lambda value: put.append(value) or original(value))
    fleet_of(actors).request(weights_of(actors.policy), want_state=True)
    fleet_of(actors).receive()
    assert len(put) == 1


def test_a_cluster_without_room_ends_in_a_message(actors: TrainingSetup, tmp_path: Path) -> None:
    from mappo_unity.training.collection.on_ray.handle import ActorHandle

    third = ActorHandle(options(*SOCCER, RAY, "collect.timeout_s=0.5"), 2, tmp_path)
    with pytest.raises(ConfigError) as error:
        third.receive()
    third.end()
    assert str(error.value) == (
        "collect.engine=ray: no place for worker 2 within collect.timeout_s=0.5 s: a worker takes 1 CPU, and "
        "the Ray cluster has 2 on 1 machine(s), 0 of them free; lower collect.workers, or add machines"
    )


@pytest.mark.slow
def test_two_actors_that_are_killed_are_replaced(actors: TrainingSetup) -> None:
    fleet = fleet_of(actors)
    killed = [process.pid for process in fleet.processes]
    for pid in killed:
        os.kill(pid, signal.SIGKILL)
    fleet.request(weights_of(actors.policy), want_state=True)
    batch = fleet.receive()

    assert not {process.pid for process in fleet.processes} & {*killed}
    assert batch.restarts == 2 and batch.dropped_episodes == 8
    assert bool(batch.void["SoccerTwos"].all())
    assert batch.count_decisions("SoccerTwos") == 12 * 8

    fleet.request(weights_of(actors.policy), want_state=True)
    batch = fleet.receive()
    assert batch.restarts == 2 and not batch.void


@pytest.mark.slow
def test_an_actor_that_hangs_is_replaced(actors: TrainingSetup) -> None:
    hung = replaced_hanging(actors)
    wait_for(lambda: not Path(f"/proc/{hung}").exists())


def test_too_many_losses_end_the_run(actors: TrainingSetup, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = fleet_of(actors)
    monkeypatch.setattr(fleet._cfg.env, "max_restarts", 0)
    monkeypatch.setattr(fleet, "_restarts", [0, 0])
    os.kill(fleet.processes[0].pid, signal.SIGKILL)
    fleet.request(weights_of(actors.policy), want_state=True)
    with pytest.raises(EnvironmentFailure) as error:
        fleet.receive()
    assert str(error.value) == (
        "worker 0 failed: the actor is dead because its worker process has died. It was replaced 0 times, "
        "and env.max_restarts=0 allows no more"
    )
