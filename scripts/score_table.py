#!/usr/bin/env python3
"""Train presets over seeds, measure their best checkpoints, and write the table of scores.

A run lies in OUT/SCENE-SEED and is resumed after any interruption; one that has spent its minutes is ended
and measured as it stands. What was measured is appended to docs/benchmarks/scores.csv after every run, and
its curve to score_curves.csv, so that no hour of work is lost; what stands there is not run again. Unity's
own policies (ONNX files named after their behaviors, in one folder) and random play are measured once.

    python scripts/score_table.py Hallway Basic [--seeds 0 1 2] [--minutes 120] [--unity FOLDER] [OPTION ...]
    python scripts/score_table.py --draw                      # only scores.md and the pictures

OPTIONs of mappo-train are noted with the run, which is resumed with the same ones only. The pictures need
matplotlib.
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
from learn_scene import HERE, append, begin_or_resume, mappo_eval, read_rows, thin
from run_script import check_names, positive, run_script
from score_measures import MEASURES, Measure, measures_of
from score_page import CURVES, FIXED, SCORES, write_page

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
    parser.add_argument("--episodes", type=positive, help="of each evaluation, instead of score_measures'")
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
    folder = arguments.out / f"{scene}-{seed}"
    is_there = any((row["scene"], row["policy"]) == (scene, str(seed)) for row in read_rows(SCORES))
    # what an interruption left out is measured on, but nothing is trained again for it
    if is_there and not (missing(arguments, scene, str(seed)) and (folder / "checkpoints").is_dir()):
        return

    begin_or_resume(scene, seed, folder, options)  # what the rows note is what it was trained with
    load = os.getloadavg()[0]
    if not is_there:
        train(scene, seed, folder, arguments.minutes, options)

    metrics = read_metrics(folder / "metrics.csv")
    facts = {
        "decisions": metrics[-1]["agent_steps"],
        "minutes": f"{metrics[-1]['wall_s'] / 60:.1f}",
        "options": " ".join(options),
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    shown = read_last_lesson(folder)
    # of several measures of one curve, the first is what it shows
    for measure in {measure.column: measure for measure in reversed(measures_of(scene))}.values():
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
    lines = begin_or_resume(scene, seed, folder, options)
    if (folder / "checkpoints").is_dir():
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
    """Evaluate a policy sampled and without sampling; append a row for each measure that has none."""
    said: dict[tuple[str | None, bool], dict[str, Any] | None] = {}
    for measure, deterministic in missing(arguments, scene, player):
        asked = measure.opponent, deterministic
        if asked not in said:
            said[asked] = evaluate(arguments, measure, policy, deterministic)
        figures = said[asked]
        value = stderr = ""  # it was tried in vain, and is not again
        if figures is not None:
            number, error = measure.figure(figures)
            value, stderr = f"{number:.4g}", f"{error:.2g}"
        row = {
            "date": time.strftime("%Y-%m-%d"),
            "scene": scene,
            "measure": measure.name,
            "policy": player,
            "sampled": not deterministic,
            "value": value,
            "stderr": stderr,
            "episodes": arguments.episodes or measure.episodes,
            **{name: facts.get(name, "") for name in ("decisions", "minutes", "options", "load")},
        }
        append(SCORES, row)
        print(row, flush=True)


def missing(arguments: argparse.Namespace, scene: str, player: str) -> list[tuple[Measure, bool]]:
    """Return the measures of a policy without a row in the table, each with whether it is not sampled."""
    rows = [row for row in read_rows(SCORES) if (row["scene"], row["policy"]) == (scene, player)]
    standing = {(row["measure"], row["sampled"]) for row in rows}
    return [
        (measure, deterministic)
        for deterministic in (False, True)
        for measure in measures_of(scene)
        if is_taken(arguments, measure, player, deterministic)
        and (measure.name, str(not deterministic)) not in standing
    ]


def is_taken(arguments: argparse.Namespace, measure: Measure, player: str, deterministic: bool) -> bool:
    """Return whether a measure is taken of a policy: Unity's does not play itself, chance has one way to."""
    if measure.opponent == "unity":
        return player not in FIXED and arguments.unity is not None
    return player != "random" or not (deterministic or measure.opponent == "own")


def evaluate(
    arguments: argparse.Namespace, measure: Measure, policy: list[str], deterministic: bool
) -> dict[str, Any] | None:
    """Return what mappo-eval says of a policy; None where it cannot be measured."""
    episodes = arguments.episodes or measure.episodes
    lines = [*policy, f"episodes={episodes}", f"deterministic={str(deterministic).lower()}"]
    if measure.opponent == "unity":
        lines.append(f"opponent={arguments.unity.resolve()}")
    elif measure.opponent == "own":
        lines.append(policy[0].replace("run=", "opponent=", 1))
    elif measure.opponent is not None:
        lines.append(f"opponent={measure.opponent}")

    try:
        return mappo_eval(*lines, timeout_s=EVALUATION_S)
    except subprocess.TimeoutExpired:
        print(f"{measure.scene}, {policy[0]}: no {episodes} episodes in {EVALUATION_S} s", flush=True)
    except subprocess.CalledProcessError:
        # what a file lacks (some of Unity's cannot be played without sampling) is one blank, not a run's end
        print(f"{measure.scene}, {policy[0]}: not measured with {' '.join(lines[1:])}", flush=True)
    return None


def append_curve(measure: Measure, seed: int, metrics: list[dict[str, int | float]]) -> None:
    """Append a run's curve, thinned out, in decisions and minutes, from its first values on; once.

    Of a run with a curriculum it is what it does in its last lesson.
    """
    curve = measure.scene, measure.column, str(seed)
    if any((row["scene"], row["column"], row["seed"]) == curve for row in read_rows(CURVES)):
        return

    points = with_value(metrics, measure.column)
    rows = [
        {
            "scene": measure.scene,
            "column": measure.column,
            "seed": seed,
            "decisions": row["agent_steps"],
            "minutes": f"{row['wall_s'] / 60:.2f}",
            "value": f"{row[measure.column]:.4g}",
        }
        for row in thin(points, POINTS, lambda point: measure.is_reached(point[measure.column]))
    ]
    append(CURVES, *rows)


if __name__ == "__main__":
    run_script(main)
