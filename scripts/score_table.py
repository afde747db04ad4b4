#!/usr/bin/env python3
"""Train presets over seeds, measure their best checkpoints, and write the table of scores.

A run lies in OUT/SCENE-SEED and is resumed after any interruption; one that has spent its minutes is ended
and measured as it stands. What was measured is appended to docs/benchmarks/scores.csv after every run, and
its curve to score_curves.csv, so that no hour of work is lost; what stands there is not run again. Unity's
own policies (ONNX files named after their behaviors, in one folder) and random play are measured once.

    python scripts/score_table.py Hallway Basic [--seeds 0 1 2] [--minutes 120] [--unity FOLDER] [OPTION ...]
    python scripts/score_table.py --draw                      # only scores.md and the pictures

OPTIONs of mappo-train are noted with the run. The pictures need matplotlib.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

from decisions_to import read_last_lesson, with_value
from learn_scene import HERE, append, mappo_eval, read_rows, thin
from run_script import check_names, run_script
from score_measures import MEASURES, Measure, measures_of
from score_page import CURVES, SCORES, write_page

from mappo_unity.config.compose import load_config
from mappo_unity.config.parameters.values import curricula, values_at
from mappo_unity.runs.metrics_csv import read_metrics

POINTS = 60  # of a curve
EVALUATION_S = 900  # a policy that stands still in a scene without a time limit would play for ever


def main() -> None:
    """Measure what is missing, then write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", metavar="SCENE|OPTION")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--minutes", type=float, default=120.0, help="of collecting and learning, for a run")
    parser.add_argument("--episodes", type=int, help="of each evaluation, instead of score_measures'")
    parser.add_argument("--out", type=Path, default=Path("outputs/scores"))
    parser.add_argument("--unity", type=Path, help="folder of Unity's own policies, BEHAVIOR.onnx")
    parser.add_argument("--draw", action="store_true", help="run nothing")
    arguments = parser.parse_intermixed_args()

    known = {measure.scene for measure in MEASURES}
    options = [word for word in arguments.words if "=" in word]
    scenes = [word for word in arguments.words if "=" not in word]
    check_names(scenes, sorted(known), "scene")

    if not arguments.draw:
        for scene in scenes or sorted(known):
            measure_fixed(arguments, scene)
            for seed in arguments.seeds:
                measure_seed(arguments, scene, seed, options)

    write_page()


def measure_fixed(arguments: argparse.Namespace, scene: str) -> None:
    """Measure random play and Unity's policy in a scene, unless that has been done."""
    players = {"random": "random"}
    if arguments.unity is not None and has_policies(arguments.unity, scene):
        players["unity"] = str(arguments.unity.resolve())

    for player, run in players.items():
        if not is_measured(scene, player):
            score(arguments, scene, player, [f"run={run}", f"env={scene}"], {})


def has_policies(folder: Path, scene: str) -> bool:
    """Return whether a folder has a file for every behavior of a scene."""
    from mappo_unity.keys import policy_name
    from mappo_unity.scenes.registry import make_scene

    env = make_scene(scene, num_areas=1)
    try:
        env.reset()
        return all((folder / f"{policy_name(name)}.onnx").is_file() for name in env.behavior_specs)
    finally:
        env.close()


def measure_seed(arguments: argparse.Namespace, scene: str, seed: int, options: list[str]) -> None:
    """Train a seed to its end or through its minutes, and measure it, unless that has been done."""
    if is_measured(scene, str(seed)):
        return

    folder = arguments.out / f"{scene}-{seed}"
    load = os.getloadavg()[0]
    train(scene, seed, folder, arguments.minutes, options)

    metrics = read_metrics(folder / "metrics.csv")
    facts = {
        "decisions": metrics[-1]["agent_steps"],
        "minutes": f"{metrics[-1]['wall_s'] / 60:.1f}",
        "options": " ".join(options),
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    shown = read_last_lesson(folder)
    for measure in {measure.column: measure for measure in measures_of(scene)}.values():
        append_curve(measure, seed, shown)
    score(arguments, scene, str(seed), [f"run={folder}", *last_lesson(folder)], facts)


def last_lesson(folder: Path) -> list[str]:
    """Return the options that play a run's last lessons, where they are numbers, wherever it has come to."""
    parameters = load_config(folder / "config.yaml").env.parameters
    values = values_at(parameters, {}, missing=-1)
    last = {name: values[name] for name in curricula(parameters)}
    return [f"env.params.{name}={value:g}" for name, value in last.items() if isinstance(value, float)]


def train(scene: str, seed: int, folder: Path, minutes: float, options: list[str]) -> None:
    """Train until the run ends or has spent its minutes; a run that stands is resumed."""
    spent_s = 0.0
    lines = [f"env={scene}", f"seed={seed}", f"hydra.run.dir={folder}", *options]
    if (folder / "checkpoints").is_dir():
        lines = [f"resume={folder}"]
        spent_s = read_metrics(folder / "metrics.csv")[-1]["wall_s"]
    left_s = minutes * 60 - spent_s
    if left_s <= 0:
        return

    process = subprocess.Popen([HERE / "mappo-train", *lines])
    try:
        code = process.wait(left_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)  # which saves
        process.wait()
        return
    except BaseException:
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise
    if code not in (0, 4):  # 4: ended, but most updates were rolled back
        raise SystemExit(f"mappo-train {' '.join(lines)}: exit code {code}")


def score(
    arguments: argparse.Namespace, scene: str, player: str, policy: list[str], facts: dict[str, Any]
) -> None:
    """Evaluate a policy sampled and without sampling; append a row for each measure."""
    for deterministic in (False, True):
        said: dict[str | None, dict[str, Any] | None] = {}
        for measure in measures_of(scene):
            if measure.opponent not in said:
                said[measure.opponent] = evaluate(arguments, measure, player, policy, deterministic)
            figures = said[measure.opponent]
            if figures is None:
                continue

            value, stderr = measure.figure(figures)
            row = {
                "date": time.strftime("%Y-%m-%d"),
                "scene": scene,
                "measure": measure.name,
                "policy": player,
                "sampled": not deterministic,
                "value": f"{value:.4g}",
                "stderr": f"{stderr:.2g}",
                "episodes": arguments.episodes or measure.episodes,
                **{name: facts.get(name, "") for name in ("decisions", "minutes", "options", "load")},
            }
            append(SCORES, row)
            print(row, flush=True)


def evaluate(
    arguments: argparse.Namespace, measure: Measure, player: str, policy: list[str], deterministic: bool
) -> dict[str, Any] | None:
    """Return what mappo-eval says of a policy; None where it cannot be measured."""
    if player == "unity" and measure.opponent == "unity":
        return None
    if player == "random" and (deterministic or measure.opponent in ("unity", "own")):
        return None

    episodes = arguments.episodes or measure.episodes
    lines = [*policy, f"episodes={episodes}", f"deterministic={str(deterministic).lower()}"]
    if measure.opponent == "unity":
        if arguments.unity is None:
            print(f"{measure.scene}, {player}: not against Unity's policy, for want of --unity", flush=True)
            return None
        lines.append(f"opponent={arguments.unity.resolve()}")
    elif measure.opponent == "own":
        lines.append(policy[0].replace("run=", "opponent=", 1))
    elif measure.opponent is not None:
        lines.append(f"opponent={measure.opponent}")

    try:
        return mappo_eval(*lines, timeout_s=EVALUATION_S)
    except subprocess.TimeoutExpired:
        print(f"{measure.scene}, {player}: no {episodes} episodes in {EVALUATION_S} s", flush=True)
    except subprocess.CalledProcessError:
        # what a file lacks (some of Unity's cannot be played without sampling) is one blank, not a run's end
        print(f"{measure.scene}, {player}: not measured with deterministic={deterministic}", flush=True)
    return None


def is_measured(scene: str, player: str) -> bool:
    """Return whether every measure of a scene stands in the table for a policy."""
    return any(row["scene"] == scene and row["policy"] == player for row in read_rows(SCORES))


def append_curve(measure: Measure, seed: int, metrics: list[dict[str, int | float]]) -> None:
    """Append a run's curve, thinned out, in decisions and minutes, from its first values on.

    Of a run with a curriculum it is what it does in its last lesson.
    """
    for row in thin(with_value(metrics, measure.column), POINTS):
        point = {
            "scene": measure.scene,
            "column": measure.column,
            "seed": seed,
            "decisions": row["agent_steps"],
            "minutes": f"{row['wall_s'] / 60:.2f}",
            "value": f"{row[measure.column]:.4g}",
        }
        append(CURVES, point)


if __name__ == "__main__":
    run_script(main)
