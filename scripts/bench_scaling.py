#!/usr/bin/env python3
"""Measure training with workers: decisions a second for 0, 1 and 2 of them, with overlap and without,
and with two learners. A machine of many cores has use for more: `--workers 1 2 4 8 --learners 2 4`.

Every variant trains the scene's preset for some iterations; they take turns, so that the ratios hold on a
machine that is shared. What is timed is the whole loop: collecting, learning, metrics, the state that a
checkpoint would hold; not the start, nor the first iterations.

    python scripts/bench_scaling.py [--repeats 5] [--iterations 6] [--engine ray] [3DBall SoccerTwos]
"""

from __future__ import annotations

import argparse
import io
import os
import statistics
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.errors import ConfigError
from mappo_unity.training.outcome import INTERRUPTED
from mappo_unity.training.run_state import RunState
from mappo_unity.training.trainer import train

WARM_UP = 2  # iterations that are not timed
QUIET = ["log.loggers=[]", "log.progress=false", "export_onnx=false"]
QUIET += ["self_play.save_steps=null"]  # a pool costs by its own: scripts/bench_self_play.py
ENDLESS = ["max_steps=1000000000", "checkpoint_interval=1000000000", "matches.interval=null"]


def main() -> None:
    """Measure each scene's preset and print a table for it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["3DBall", "SoccerTwos"])
    parser.add_argument("--repeats", type=positive, default=5)
    parser.add_argument("--iterations", type=positive, default=6, help="timed ones of each repeat")
    parser.add_argument("--workers", type=positive, nargs="+", default=[1, 2])
    parser.add_argument("--learners", type=positive, nargs="+", default=[2])
    parser.add_argument("--engine", choices=["processes", "ray"], default="processes", help="of workers")
    parser.add_argument("--option", action="append", default=[], help="a further option of every run")
    arguments = parser.parse_args()

    variants = variants_of(arguments.workers, arguments.learners)
    for scene in arguments.scenes:  # below, options that do not go together are left out
        compose_config([f"env={scene}", *arguments.option])

    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores")
    for scene in arguments.scenes:
        rates: dict[str, list[float]] = {name: [] for name in variants}
        for _ in range(arguments.repeats):
            for name, lines in variants.items():
                options = [f"env={scene}", *QUIET, *ENDLESS, *arguments.option, *lines]
                has_workers = any(line.startswith("collect.workers") for line in lines)
                options += [f"collect.engine={arguments.engine}"] if has_workers else []
                with suppress(ConfigError):  # intrinsic rewards want one learner, for example
                    rates[name].append(measure(options, arguments.iterations))
        print_table(scene, rates)
    print(f"load average {os.getloadavg()[0]:.2f}")


def variants_of(workers: list[int], learners: list[int]) -> dict[str, list[str]]:
    """Return the options of each variant by its name, the plain run first."""
    in_turns, overlap = "collect.overlap=false", "collect.overlap=true"  # whatever a preset has
    variants = {"0": ["collect.workers=0", in_turns]}
    variants |= {f"{count}": [f"collect.workers={count}", in_turns] for count in workers}
    variants |= {f"{count}, overlap": [f"collect.workers={count}", overlap] for count in workers}
    for learning in learners:
        side_by_side = [f"learners={learning}", "update_threads=1", in_turns]
        variants[f"0, {learning} learners"] = ["collect.workers=0", *side_by_side]
        variants[f"{learning}, {learning} learners"] = [f"collect.workers={learning}", *side_by_side]
    return variants


def measure(options: list[str], iterations: int) -> float:
    """Return agent decisions a second of training with these options."""
    marks: list[tuple[float, int]] = []

    def note(state: RunState) -> str | None:
        marks.append((time.perf_counter(), state.agent_steps))
        return INTERRUPTED if len(marks) == WARM_UP + iterations else None

    with tempfile.TemporaryDirectory() as folder:
        train(compose_config(options).config, Path(folder), None, note, Console(file=io.StringIO()))
    (begin, before), (end, after) = marks[WARM_UP - 1], marks[-1]
    return (after - before) / (end - begin)


def print_table(scene: str, rates: dict[str, list[float]]) -> None:
    """Print medians, and ratios to the first variant of the same repeat."""
    print(f"\n{scene}\n{'workers':14} {'decisions/s':>12}  ratio to 0 workers (least to most)")
    first = next(iter(rates.values()))
    for name, values in rates.items():
        if not values:
            print(f"{name:14}      refused")
            continue
        ratios = [value / base for value, base in zip(values, first)]
        print(
            f"{name:14} {statistics.median(values):12,.0f}  {statistics.median(ratios):.2f} "
            f"({min(ratios):.2f} to {max(ratios):.2f})"
        )


if __name__ == "__main__":
    run_script(main)
