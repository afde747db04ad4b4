"""Runs with workers in Ray from end to end: clusters of their own and of others, errors, kills, resuming."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_workers import LOCAL, SMALL, check_resume, children, options, wait_for
from test_workers import SOCCER as TWO_AREAS

from mappo_unity.cli import train_main
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.training import setup as training_setup
from mappo_unity.training.collection.batches import Batch

RAY = "collect.engine=ray"
WITHOUT_END = "max_steps=100000000"
SOCCER = [*TWO_AREAS, "matches.interval=null", "self_play.save_steps=null"]

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let runs start their own cluster, unless a test says otherwise."""
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    yield
    ray.shutdown()


@pytest.mark.parametrize("overlap", ["true", "false"])
def test_a_resumed_run_with_ray_is_the_whole_one(tmp_path: Path, overlap: str) -> None:
    check_resume(tmp_path, "env=DungeonEscape", "env.num_areas=2", RAY, f"collect.overlap={overlap}")


def test_what_an_environment_raises_keeps_its_text_and_exit_code(tmp_path: Path, capsys: Any) -> None:
    cases = [
        (3, ["env.factory=failing_env:make", "+env.params.at=12"]),
        (2, ["env.factory=failing_env:make", "+env.params.at=12", "+env.params.how=sends_nan"]),
        (2, ["env.factory=test_workers:has_no_licence"]),
    ]
    said = []
    for engine in (RAY, LOCAL):
        for code, case in cases:
            lines = ["env=custom", "env.name=Mine", *case, "collect.rounds=8", *SMALL, "collect.workers=2"]
            run = tmp_path / str(len(said))
            assert train_main([*lines, engine, WITHOUT_END, f"hydra.run.dir={run}"]) == code
            said.append(capsys.readouterr().err)
    assert said[:3] == said[3:]


def test_an_address_where_no_cluster_answers_is_refused(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for address, text in (
        ("127.0.0.1:1", "RAY_ADDRESS=127.0.0.1:1: no Ray cluster answers there ("),
        ("ray://127.0.0.1:10001", "RAY_ADDRESS=ray://127.0.0.1:10001 is a Ray client's address"),
    ):
        monkeypatch.setenv("RAY_ADDRESS", address)
        assert train_main(["env=3DBall", "collect.workers=2", RAY, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
        said = capsys.readouterr().err
        assert text in said and "Traceback" not in said


class Unreadable:
    """Cannot be unpickled."""

    def __reduce__(self) -> Any:
        return int, ("no number",)


def test_an_actor_that_cannot_be_created_says_why(tmp_path: Path) -> None:
    import ray

    from mappo_unity.training.collection.on_ray.handle import ActorHandle
    from mappo_unity.training.collection.worker_handle import WorkerLost

    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    number: Any = Unreadable()
    with pytest.raises(WorkerLost) as loss:
        ActorHandle(options(*SOCCER), number, tmp_path).receive()
    assert str(loss.value).startswith("its actor cannot be created: ")
    assert "ValueError: invalid literal for int() with base 10: 'no number'" in str(loss.value)


def start(folder: Path, *lines: str) -> subprocess.Popen[bytes]:
    """Start a run of SoccerTwos in a process of its own."""
    code = "import sys; from mappo_unity.cli import train_main; sys.exit(train_main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *SOCCER, RAY, *lines]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL)


def test_a_driver_that_is_killed_leaves_no_process(tmp_path: Path) -> None:
    driver = start(tmp_path, "collect.overlap=true", WITHOUT_END, f"hydra.run.dir={tmp_path / 'run'}")
    started: list[int] = []
    try:
        wait_for(lambda: (tmp_path / "run" / "checkpoints").is_dir())
        started = descendants(driver.pid)
        assert len(started) >= 4  # two workers, and what a cluster consists of
    finally:
        driver.kill()
        driver.wait()
    wait_for(lambda: not any(is_alive(pid) for pid in started))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_run_with_a_checkpoint(tmp_path: Path, number: int) -> None:
    driver = start(tmp_path, WITHOUT_END, f"hydra.run.dir={tmp_path / 'run'}")
    wait_for(lambda: (tmp_path / "run" / "checkpoints").is_dir())
    started = descendants(driver.pid)
    driver.send_signal(number)
    assert driver.wait(300) == 128 + number
    wait_for(lambda: not any(is_alive(pid) for pid in started))


def descendants(pid: int) -> list[int]:
    """Return the processes below one (Linux)."""
    found = []
    for child in children(pid):
        found += [child, *descendants(child)]
    return found


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


# --- a cluster of two raylets, with room for one worker each


@pytest.fixture
def two_machines(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        monkeypatch.setenv("RAY_ADDRESS", cluster.address)
        yield cluster
    finally:
        import ray

        ray.shutdown()
        cluster.shutdown()


def test_two_machines_and_a_kill_of_both_workers(
    two_machines: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ray
    from ray._private.state import actors

    nodes, fleets = [], []
    opened = training_setup.make_fleet

    def watched(*arguments: Any) -> Any:
        fleets.append(opened(*arguments))
        nodes.extend(actor["Address"]["NodeID"] for actor in actors().values() if actor["State"] == "ALIVE")
        receive = fleets[-1].receive

        def kill_and_receive() -> Batch:
            if len(nodes) == 2:  # in the first iteration
                nodes.append("killed")
                for process in fleets[-1].processes:
                    os.kill(process.pid, signal.SIGKILL)
            batch: Batch = receive()
            return batch

        fleets[-1].receive = kill_and_receive
        return fleets[-1]

    monkeypatch.setattr(training_setup, "make_fleet", watched)
    assert train_main([*SOCCER, RAY, "max_steps=192", f"hydra.run.dir={tmp_path}"]) == 0
    assert len({*nodes[:2]}) == 2 and nodes[2] == "killed"
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [(row["agent_steps"], row["restarts"]) for row in rows] == [(96, 2), (192, 2)]
    assert not ray.is_initialized()
    assert len(two_machines.list_all_nodes()) == 2  # the cluster stays


def test_a_driver_on_two_machines_that_is_killed_is_resumed(two_machines: Any, tmp_path: Path) -> None:
    import ray

    run = tmp_path / "run"
    driver = start(tmp_path, WITHOUT_END, f"hydra.run.dir={run}")
    try:
        wait_for(lambda: len(list(run.glob("checkpoints/step_*.pt"))) > 1)
    finally:
        driver.kill()
        driver.wait()

    # its workers go with it, so there is room for those of the resumed run
    before = max(int(path.stem.rpartition("_")[2]) for path in run.glob("checkpoints/step_*.pt"))
    assert train_main([f"resume={run}", f"max_steps={before + 960}"]) == 0
    assert int(read_metrics(run / "metrics.csv")[-1]["agent_steps"]) >= before + 960
    ray.init(two_machines.address)
    wait_for(lambda: ray.available_resources().get("CPU") == 2)
