#!/usr/bin/env python3
"""Measure what a GPU is worth: seconds of collecting and of learning on the CPU and on the GPU.

Each case is a line of options. It trains for some iterations on every device in turn, in this process; the
medians of what `metrics.csv` says of each iteration are printed, the first ones left out. Environments step
on the CPU whatever the device, so `collect` holds the copies to the GPU and back.

    python scripts/bench_device.py [--devices "device=cpu update_threads=1" device=cuda] [CASE ...]
"""

from __future__ import annotations

import argparse
import io
import os
import shlex
import statistics
import tempfile
from pathlib import Path

import torch
from bench_scaling import ENDLESS, WARM_UP
from rich.console import Console
from run_script import positive, run_script

from mappo_unity.config.compose import compose_config
from mappo_unity.runs.metrics_csv import read_metrics
from mappo_unity.training.outcome import INTERRUPTED
from mappo_unity.training.run_state import RunState
from mappo_unity.training.trainer import train

CASES = (
    "env=3DBall",
    "env=SoccerTwos",
    "env=Hallway model.memory=lstm",
    "env=CooperativePushBlock",
    "env=GridFoodCollector",
    "env=3DBall model.hidden=[1024,1024]",
    "env=SoccerTwos model.hidden=[1024,1024]",
    "env=GridFoodCollector model.image_encoder=resnet",
)
QUIET = ("log.loggers=[csv]", "log.progress=false", "export_onnx=false", "self_play.save_steps=null")


def main() -> None:
    """Measure each case on each device and print a line for both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "cases", nargs="*", default=CASES, metavar="CASE", help="options of a run, as one text"
    )
    parser.add_argument("--devices", nargs="+", default=["device=cpu update_threads=1", "device=cuda"])
    parser.add_argument("--iterations", type=positive, default=5, help="those that are counted")
    arguments = parser.parse_args()

    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    print(f"load average {os.getloadavg()[0]:.2f}, {os.cpu_count()} cores, {gpu}, torch {torch.__version__}")
    for case in arguments.cases:
        print(f"\n{case}\n{'':32}{'collect':>10}{'learn':>10}{'decisions/s':>14}{'learns':>9}")
        first = None
        for device in arguments.devices:
            options = [*shlex.split(case), *shlex.split(device)]
            collect_s, update_s, rate = measure(options, arguments.iterations)
            first = first or update_s
            faster = f"{first / update_s:8.2f}x"
            print(f"{device:32}{collect_s:8.2f} s{update_s:8.2f} s{rate:14,.0f}{faster}", flush=True)


def measure(options: list[str], iterations: int) -> tuple[float, float, float]:
    """Return seconds of collecting and of learning an iteration, and decisions a second of both."""

    def stop(state: RunState) -> str | None:
        return INTERRUPTED if state.iteration == WARM_UP + iterations else None

    with tempfile.TemporaryDirectory() as folder:
        cfg = compose_config([*options, *QUIET, *ENDLESS]).config
        outcome = train(cfg, Path(folder), None, stop, Console(file=io.StringIO()))
        if outcome.signal is not None:
            raise SystemExit(128 + outcome.signal)  # somebody ends the measurement, not this run alone
        rows = read_metrics(Path(folder) / "metrics.csv")[WARM_UP:]
    names = ("collect_s", "update_s", "steps_per_s")
    collect_s, update_s, rate = (statistics.median(row[name] for row in rows) for name in names)
    return collect_s, update_s, rate


if __name__ == "__main__":
    run_script(main)
