"""Golden runs: short training runs whose metrics a refactoring must not change.

`run` trains one of `RUNS` for three iterations and returns its metrics without times; ``resume`` is one of
them cut after two iterations and resumed. `scripts/write_golden.py` writes them to ``tests/golden/``.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.metadata
import json
import platform
from pathlib import Path

import numpy as np
import torch

GOLDEN = Path(__file__).parent / "golden"
TIMES = ("wall_s", "steps_per_s", "collect_s", "update_s")

_SMALL = ["collect.rounds=48", "ppo.minibatch_size=64", "log.loggers=[]", "log.progress=false", "seed=7"]
_COMMON = [*_SMALL, "export_onnx=false", "num_threads=1", "update_threads=1", "checkpoint_interval=1"]
_IN_TURNS = ["collect.workers=0", "collect.overlap=false", "ppo.objective=clip"]  # in one process
RUNS = {
    "3DBall": ["env=3DBall", "env.num_areas=6"],
    "SoccerTwos": ["env=SoccerTwos", "env.num_areas=2", "matches.interval=400", "matches.count=2"],
    "DungeonEscape": ["env=DungeonEscape", "env.num_areas=2"],
    "WallJump": ["env=WallJump", "env.num_areas=4", *_IN_TURNS],
    "GridFoodCollector": ["env=GridFoodCollector", "env.num_areas=1"],
}
"""Options of each run, besides `_COMMON`; its length is given by `STEPS`."""
STEPS = {"3DBall": 864, "SoccerTwos": 1152, "DungeonEscape": 570, "WallJump": 570, "GridFoodCollector": 720}
"""Agent decisions with which the third iteration ends (or that the third one passes)."""
RESUMED = "DungeonEscape"


def run(name: str, folder: Path) -> list[dict[str, str]]:
    """Train a golden run (or ``resume``) in a folder; return its rows of metrics, by column."""
    from mappo_unity.cli import train_main

    resumed = name == "resume"
    name = RESUMED if resumed else name
    lines = [*RUNS[name], *_COMMON, f"hydra.run.dir={folder}"]
    if resumed:
        # the schedules look at max_steps: the first part has that of the whole run, and loses its end
        assert train_main([*lines, f"max_steps={STEPS[name]}"]) == 0
        newest = sorted((folder / "checkpoints").glob("step_*.pt"))[-1]
        newest.unlink()
        assert train_main([f"resume={folder}"]) == 0
    else:
        assert train_main([*lines, f"max_steps={STEPS[name]}"]) == 0
    return rows_of(folder)


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return a run's rows of metrics without times, with the sum of the policies' weights in the last one."""
    with (folder / "metrics.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]
    newest = sorted((folder / "checkpoints").glob("step_*.pt"))[-1]
    learners = torch.load(newest, weights_only=True)["learners"]
    for name, learner in learners.items():
        weights = [
            value.double().abs().sum() for value in learner["actor"].values() if value.is_floating_point()
        ]
        rows[-1][f"weights/{name}"] = repr(float(sum(weights)))
    return rows


def machine() -> dict[str, str]:
    """Return what decides on the last bits of floating-point numbers."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    cpu = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = hashlib.sha256(cpu.get("flags", "").encode()).hexdigest()[:12]  # generations share a name
    return {
        "processor": cpu.get("model name", platform.processor()),
        "flags": flags,
        "system": platform.system(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "mujoco": importlib.metadata.version("mujoco"),
    }


def write(name: str, folder: Path) -> Path:
    """Run a golden run and write what it says to its file; return the file."""
    GOLDEN.mkdir(exist_ok=True)
    path = GOLDEN / f"{name}.json"
    content = {"machine": machine(), "rows": run(name, folder)}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def read(name: str) -> tuple[dict[str, str], list[dict[str, str]]]:
    """Return the machine that wrote a golden run, and its rows."""
    content = json.loads((GOLDEN / f"{name}.json").read_text(encoding="utf-8"))
    return content["machine"], content["rows"]
