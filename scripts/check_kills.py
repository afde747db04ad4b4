#!/usr/bin/env python3
"""Train with workers, kill random ones at random moments, and look whether the run is the worse for it.

The preset is trained to its end with two workers. As soon as a worker plays, one is chosen and killed after a
random pause, again and again. Afterwards every worker that was killed must have been counted, the decisions
must add up, no process may be left, and the best policy is evaluated.

    python scripts/check_kills.py [--scene 3DBall] [--kills 20] [--goal 95] [--engine ray] [OPTION ...]
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import tempfile
import threading
from pathlib import Path

from learn_scene import mappo_eval
from run_script import run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.runs.folder import write_record
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.training.collection.processes import RemoteWorkers
from mappo_unity.training.run_state import RunState
from mappo_unity.training.trainer import train

WORKERS = 2
PAUSE_S = 6.0  # the longest between a replacement's start and the next kill


def main() -> None:
    """Train, kill, count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scene", default="3DBall")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--goal", type=float, default=95.0, help="mean return that the best policy must earn")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--engine", choices=["processes", "ray"], default="processes", help="of workers")
    parser.add_argument("options", nargs="*", help="further options of mappo-train")
    arguments = parser.parse_intermixed_args()

    lines = [f"env={arguments.scene}", f"seed={arguments.seed}", f"collect.workers={WORKERS}"]
    lines += [f"collect.engine={arguments.engine}"]
    lines += [f"env.max_restarts={arguments.kills}", "export_onnx=false", *arguments.options]
    killer = Killer(arguments.kills, arguments.seed)
    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores", flush=True)

    with tempfile.TemporaryDirectory() as folder:
        cfg = compose_config(lines).config
        write_record(Path(folder), cfg, lines)  # which mappo-eval reads
        outcome = train(cfg, Path(folder), after_iteration=killer.watch)
        killer.end()
        last = read_metrics(Path(folder) / "metrics.csv")[-1]
        said = mappo_eval(f"run={folder}", "deterministic=true")

    counted = int(last["restarts"])
    left = [pid for pid in killer.seen if is_alive(pid)]
    print(
        f"{len(killer.killed)} workers killed, {counted} replaced, {len(left)} processes left of "
        f"{len(killer.seen)}; {outcome.status} after {outcome.agent_steps:,} decisions and "
        f"{outcome.wall_s:.0f} s; mean return {said['mean_return']:.1f} (goal {arguments.goal:g})"
    )
    is_right = len(killer.killed) == arguments.kills == counted and not left
    raise SystemExit(0 if is_right and said["mean_return"] >= arguments.goal else 1)


class Killer:
    """Kill workers of the training that runs in this process.

    Attributes: `killed`, the processes that were; `seen`, all workers that there ever were.
    """

    def __init__(self, kills: int, seed: int) -> None:
        self.killed: list[int] = []
        self.seen: set[int] = set()
        self._kills, self._random = kills, random.Random(seed)
        self._fleet: RemoteWorkers | None = None
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._kill, daemon=True)

    def watch(self, state: RunState) -> str | None:
        """Begin after the first iteration; see `AfterIteration`."""
        if self._fleet is None:
            assert isinstance(state.setup.fleet, RemoteWorkers)
            self._fleet = state.setup.fleet
            self._thread.start()
        self.seen.update(process.pid for process in self._fleet.processes if process.pid is not None)
        return None

    def end(self) -> None:
        """Kill no more."""
        self._is_over.set()
        self._thread.join()

    def _kill(self) -> None:
        assert self._fleet is not None
        while len(self.killed) < self._kills and not self._is_over.wait(self._random.uniform(0, PAUSE_S)):
            processes = self._fleet.processes
            if not processes:
                return
            pid = self._random.choice(processes).pid
            if pid is None:  # not started yet
                continue
            self.seen.add(pid)
            if pid not in self.killed and is_alive(pid):  # else its replacement is on its way
                os.kill(pid, signal.SIGKILL)
                self.killed.append(pid)


def is_alive(pid: int) -> bool:
    """Return whether a process runs; one that ended and was not waited for does not."""
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


if __name__ == "__main__":
    run_script(main)
