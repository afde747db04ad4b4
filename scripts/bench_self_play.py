#!/usr/bin/env python3
"""Measure what a pool of past opponents costs: decisions/s learnt, against both sides playing newest weights.

Two runs of a two-sided scene's preset take turns in one process, iteration by iteration, one with
`self_play` (a snapshot after each iteration, ten in the pool, three met at a time), one without, so that the
ratio holds on a machine that is shared. Only the decisions of those who learn count.

    python scripts/bench_self_play.py [SoccerTwos StrikersVsGoalie] [--repeats 9] [OPTION=VALUE ...]
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import Config
from mappo_unity.training.collection.fleet import Batches
from mappo_unity.training.run_state import RunState
from mappo_unity.training.setup import set_up

POOL = 10


def main() -> None:
    """Measure each scene and print a line for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="scenes, and options of both runs")
    parser.add_argument("--repeats", type=positive, default=9)
    arguments = parser.parse_intermixed_args()

    options = [word for word in arguments.words if "=" in word]
    scenes = [word for word in arguments.words if "=" not in word] or ["SoccerTwos", "StrikersVsGoalie"]
    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores, one torch thread")
    for scene in scenes:
        measure(scene, options, arguments.repeats)


def measure(scene: str, options: list[str], repeats: int) -> None:
    """Compare both runs of a scene."""
    lines = [f"env={scene}", "update_threads=1", "matches.interval=null", *options]
    plain = compose_config([*lines, "self_play.save_steps=null"]).config
    pooled = compose_config([*lines, "self_play.save_steps=1", f"self_play.window={POOL}"]).config

    with ExitStack() as stack:
        runs = [stack.enter_context(running(cfg)) for cfg in (plain, pooled)]
        for _ in range(POOL):
            iterate(*runs[1])
        iterate(*runs[0])

        rates = [(iterate(*runs[0]), iterate(*runs[1])) for _ in range(repeats)]

    ratios = [with_pool / without for without, with_pool in rates]
    without, with_pool = (statistics.median(column) for column in zip(*rates))
    print(
        f"{scene}: {without:,.0f} decisions/s newest against newest, {with_pool:,.0f} with a pool of {POOL}; "
        f"ratio {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
    )


@contextmanager
def running(cfg: Config) -> Iterator[tuple[RunState, Batches]]:
    """Open a run without logs or checkpoints."""
    with tempfile.TemporaryDirectory() as out, set_up(cfg, Path(out)) as setup:
        state = RunState(cfg, Path(out), setup)
        with setup.collecting() as batches:
            state.begin()
            yield state, batches


def iterate(state: RunState, batches: Batches) -> float:
    """Collect and learn once; return decisions learnt a second."""
    began, before = time.perf_counter(), state.agent_steps
    batch = next(batches)
    state.setup.learn(batch, progress=0.0)
    state.count(batch, collect_s=1.0, update_s=1.0)
    state.advance_self_play(batch, batches)
    return (state.agent_steps - before) / (time.perf_counter() - began)


if __name__ == "__main__":
    run_script(main)
