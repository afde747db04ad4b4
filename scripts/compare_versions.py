#!/usr/bin/env python3
"""Train presets with this checkout and with another one, in turns, and compare what they learn in what time.

Both train for the same number of agent decisions from the same seeds. What counts is the ONNX file that a run
ends with, which this checkout's mappo-eval plays for both: matches against random in games of two sides,
episodes elsewhere, actions sampled as the file does. Runs lie in OUT/SCENE-VERSION-SEED and are not run
again; each result is printed and appended to OUT/results.csv, and a table is printed at the end.

    git worktree add /tmp/before COMMIT
    python scripts/compare_versions.py /tmp/before [--scenes DungeonEscape] [--seeds 0 1 2] [--steps 1000000]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from learn_scene import append, mappo_eval, results
from run_script import positive, run_script

from mappo_unity.errors import ConfigError
from mappo_unity.runs.json_record import read_json
from mappo_unity.scenes.registry import make_scene

ROOT = Path(__file__).resolve().parents[1]
TRAIN = "import sys; from mappo_unity.cli import train_main; sys.exit(train_main())"
TWO_SIDED = "SoccerTwos", "StrikersVsGoalie"
DONE = "trained.json"  # what is to be noted of a training, in a folder that is not evaluated yet
QUIET = ["log.progress=false", "log.backends=[]", "matches.interval=null", "update_threads=1"]


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path, help="the other checkout")
    parser.add_argument("--scenes", nargs="+", default=["DungeonEscape", "StrikersVsGoalie", "SoccerTwos"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=positive, default=1_000_000, help="agent decisions of a run")
    parser.add_argument("--episodes", type=positive, default=400, help="episodes or matches of an evaluation")
    parser.add_argument("--out", type=Path, default=Path("outputs/versions"))
    arguments = parser.parse_args()
    if not (arguments.before / "mappo_unity").is_dir():
        parser.error(f"{arguments.before} must be a checkout: it has no mappo_unity/")

    for scene in arguments.scenes:
        check_score(scene)

    out = arguments.out.resolve()
    for scene in arguments.scenes:
        for seed in arguments.seeds:
            for version, checkout in (("before", arguments.before.resolve()), ("now", ROOT)):
                folder = out / f"{scene}-{version}-{seed}"
                if str(folder) not in [row["folder"] for row in results(out)]:
                    row = run(scene, seed, arguments, checkout, folder)
                    append(out / "results.csv", {"version": version} | row)
                    print(version, row, flush=True)
    print(table(results(out)))


def run(scene: str, seed: int, arguments: argparse.Namespace, checkout: Path, folder: Path) -> dict[str, Any]:
    """Train once with a checkout, unless that has been done, and evaluate; return a row of results."""
    facts = read_json(folder / DONE)
    if facts.get("decisions") != arguments.steps:
        facts = train(scene, seed, arguments.steps, checkout, folder)
        (folder / DONE).write_text(json.dumps(facts))

    return {
        "scene": scene,
        "seed": seed,
        **{name: facts[name] for name in ("decisions", "seconds", "cpu_seconds")},
        **score(scene, arguments.episodes, folder),
        "load_before": facts["load_before"],
        "load_after": round(os.getloadavg()[0], 1),
        "date": time.strftime("%Y-%m-%d"),
        "folder": str(folder),
    }


def train(scene: str, seed: int, steps: int, checkout: Path, folder: Path) -> dict[str, Any]:
    """Train once with a checkout; return what is to be noted of it."""
    shutil.rmtree(folder, ignore_errors=True)  # of a run that was cut off
    folder.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"env={scene}", f"seed={seed}", f"max_steps={steps}", *QUIET]
    environment = os.environ | {"PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

    load, start, used = os.getloadavg()[0], time.monotonic(), os.times().children_user
    command = [sys.executable, "-c", TRAIN, *lines, f"hydra.run.dir={folder}"]
    with open(f"{folder}.log", "w") as log:  # beside the folder, which a run makes itself
        subprocess.run(command, cwd=checkout, env=environment, stdout=log, stderr=log, check=True)

    return {
        "decisions": steps,
        "seconds": round(time.monotonic() - start),
        "cpu_seconds": round(os.times().children_user - used),
        "load_before": round(load, 1),
    }


def check_score(scene: str) -> None:
    """Raise ConfigError where no one number says what a run of a scene earns."""
    env = make_scene(scene, num_areas=1)
    env.reset()
    names = sorted({name.split("?")[0] for name in env.behavior_specs})
    env.close()
    if len(names) > 1 and scene not in TWO_SIDED:
        raise ConfigError(f"{scene} has no score to compare: {' and '.join(names)} earn a return each")


def score(scene: str, episodes: int, folder: Path) -> dict[str, Any]:
    """Return what a run's last policy earns: its mean return, or its mean goal difference."""
    files = sorted((folder / "checkpoints").glob("final*.onnx"))
    if len(files) > 1:  # a file a behavior: mappo-eval wants them by name, in a folder
        (folder / "final").mkdir(exist_ok=True)
        for file in files:
            shutil.copy(file, folder / "final" / file.name.removeprefix("final_"))
    policy = folder / "final" if len(files) > 1 else files[0]

    opponent = ["opponent=random"] if scene in TWO_SIDED else []
    said = mappo_eval(f"run={policy}", f"env={scene}", f"episodes={episodes}", *opponent)
    if not opponent:
        return {"score": round(said["mean_return"], 3), "details": f"standard error {said['stderr']:.3f}"}
    sides = {
        name: {key: round(own[key], 3) for key in ("won_of_decided", "goal_difference", "mean_decisions")}
        for name, own in said["as"].items()
    }
    return {"score": round(said["goal_difference"], 3), "details": json.dumps(sides)}


def table(rows: list[dict[str, str]]) -> str:
    """Return a Markdown table: scores and seconds of both versions by scene and seed, and their means."""
    lines = ["| scene | decisions | seed | score: before | now | s of processor time: before | now |"]
    lines.append("|---" * 7 + "|")
    runs = {(row["scene"], row["seed"], row["version"]): row for row in rows}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        seeds = [seed for s, seed, version in runs if s == scene and version == "now"]
        pairs = [(runs[scene, seed, "before"], runs[scene, seed, "now"]) for seed in seeds]
        for seed, pair in zip(seeds, pairs):
            cells = [row[name] for name in ("score", "cpu_seconds") for row in pair]
            lines.append(f"| {scene} | {int(pair[0]['decisions']):,} | {seed} | {' | '.join(cells)} |")
        means = [
            f"{statistics.mean(float(pair[version][name]) for pair in pairs):.3g}"
            for name in ("score", "cpu_seconds")
            for version in (0, 1)
        ]
        lines.append(f"| {scene} | | mean | {' | '.join(means)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    run_script(main)
