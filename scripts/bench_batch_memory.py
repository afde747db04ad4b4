#!/usr/bin/env python3
"""Measure what a batch takes in memory, and what collecting and learning it takes at most.

Each scene's preset runs in a process of its own: two iterations, of which the second holds what the first
left pending. Peaks are resident sets, less what was resident before the first round: of collecting the first
batch, and of all. The checkpoint is what a training run writes.

    python scripts/bench_batch_memory.py [GridFoodCollector SoccerTwos]
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
from pathlib import Path

import torch
from run_script import run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.training.memory import show_size
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import set_up

ITERATIONS = 2


def main() -> None:
    """Measure each scene's preset and print a line for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["GridFoodCollector", "SoccerTwos"])

    scenes = parser.parse_args().scenes
    for scene in scenes:
        compose_config([f"env={scene}"])  # says what is wrong with a name

    for scene in scenes:
        # spawned: what another process has held counts in a forked one's peak
        process = multiprocessing.get_context("spawn").Process(target=measure, args=(scene,))
        process.start()
        process.join()


def measure(scene: str) -> None:
    """Print what one scene's preset takes."""
    cfg = compose_config([f"env={scene}", "log.loggers=[]"]).config
    with tempfile.TemporaryDirectory() as out, set_up(cfg, Path(out)) as setup, setup.collecting() as batches:
        state, before, collected = RunState(cfg, Path(out), setup), peak(), 0
        for _ in range(ITERATIONS):
            batch = next(batches)
            size = batch.rounds.bytes() + sum(part.bytes() for part in batch.following.values())
            collected = collected or peak()
            setup.learn(batch, 0.0)
            state.count(batch, collect_s=1.0, update_s=1.0)
            del batch

        file = Path(out) / "checkpoint.pt"
        torch.save(state.state_dict(), file)
        parts = {
            "batch": size,
            "peak collecting": collected - before,
            "peak learning": peak() - before,
            "checkpoint": file.stat().st_size,
        }
        print(
            f"{scene}: {', '.join(f'{what} {show_size(part)}' for what, part in parts.items())}", flush=True
        )


def peak() -> int:
    """Return the largest resident set of this process so far, in bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


if __name__ == "__main__":
    run_script(main)
