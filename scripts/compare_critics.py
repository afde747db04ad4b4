#!/usr/bin/env python3
"""Train the scenes of cooperation with each kind of critic, and draw their returns in one picture a scene.

MAPPO's central critic, independent learners' local one (IPPO), MA-POCA's and attention; all else is the
preset of the scene. With fewer --steps than the preset's its entropy bonus, learning rate and discount move
as in its beginning. The table has what the final checkpoints earn in the scene as it is (of a preset with
lessons: in the last one, wherever a seed has come to), the picture the way there. Runs lie in
OUT/SCENE-CRITIC-SEED and are resumed after any interruption; what was trained and played is appended to
docs/benchmarks/critics.csv and critics_played.csv and is not run again. Table and picture (which needs
matplotlib) stand on the scene's page.

    python scripts/compare_critics.py DungeonEscape [--critics central local] [--seeds 0 1 2] [--steps N]
    python scripts/compare_critics.py --draw                  # only the tables and the pictures
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from itertools import product
from pathlib import Path
from typing import NamedTuple

from decisions_to import last_lessons, settled, with_value
from learn_scene import append, mappo_eval, read_rows, thin
from run_script import positive, run_script
from score_measures import measures_of
from score_page import BENCHMARKS, ROOT, put_between
from score_table import last_lesson, train

from mappo_unity.config.compose import compose_config
from mappo_unity.config.schema import PPOConfig, Schedule
from mappo_unity.learning.advantage import part_over
from mappo_unity.runs.checkpoint_file import checkpoints_in, step_of
from mappo_unity.runs.metrics_csv import read_metrics

SCENES = {"CooperativePushBlock": 2_500_000, "DungeonEscape": 2_000_000}
"""Agent decisions of a run."""
CRITICS = {
    "central": ("central (MAPPO)", "tab:blue"),
    "local": ("local (IPPO)", "tab:orange"),
    "poca": ("MA-POCA", "tab:green"),
    "attention": ("attention", "tab:red"),
}
CURVES = BENCHMARKS / "critics.csv"
PLAYED = BENCHMARKS / "critics_played.csv"
PAGES = ROOT / "docs/scenes"
BEGIN, END = "<!-- critics -->\n", "<!-- end of critics -->\n"
POINTS = 60  # of a curve
NOT_THERE = "-"  # in place of a return: of runs that have not been played


class Point(NamedTuple):
    """A point of a curve."""

    decisions: float
    minutes: float
    value: float
    """Group return of the last 100 episodes, in the lesson of then."""
    lesson: int
    """From 1 on."""
    lessons: int
    """How many there are; 1: the scene is learnt as it is."""


Curves = dict[str, dict[str, list[Point]]]
"""Curves by critic and seed."""
Earned = dict[tuple[str, str, str], float]
"""Group returns in the scene as it is, by scene, critic and seed."""


def main() -> None:
    """Train what is missing, then write the table and the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=list(SCENES), metavar="SCENE", help=", ".join(SCENES))
    parser.add_argument("--critics", nargs="+", default=list(CRITICS), choices=list(CRITICS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=positive, help="agent decisions of a run, instead of the scene's")
    parser.add_argument("--minutes", type=float, default=240.0, help="of collecting and learning, for a run")
    parser.add_argument("--out", type=Path, default=Path("outputs/critics"))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    arguments = parser.parse_args()

    for scene in arguments.scenes:
        if scene not in SCENES:
            parser.error(f"{scene}: critics are compared in {', '.join(SCENES)}")
    for scene, seed, critic in product(arguments.scenes, arguments.seeds, arguments.critics):
        if not arguments.draw:
            learn(arguments, scene, critic, seed)
            play(arguments, scene, critic, seed)

    played = read_played()
    for scene, curves in read_curves().items():
        write_page(scene, curves, played)
        draw(scene, curves)


def learn(arguments: argparse.Namespace, scene: str, critic: str, seed: int) -> None:
    """Train one critic from one seed, unless that has been done, and append its curve."""
    key = scene, critic, str(seed)
    if any(key_of(row) == key for row in read_rows(CURVES)):
        return
    folder, load = arguments.out / "-".join(key), os.getloadavg()[0]
    steps = arguments.steps or SCENES[scene]
    train(scene, seed, folder, arguments.minutes, options(scene, critic, steps))

    # Of a run that was resumed for more steps only the beginning counts.
    metrics, last = read_metrics(folder / "metrics.csv"), last_lessons(folder)
    end = next((place for place, row in enumerate(metrics) if row["agent_steps"] >= steps), len(metrics))
    shown = with_value(settled(metrics[: end + 1], last), "group_return_mean")
    points = [
        {
            "date": time.strftime("%Y-%m-%d"),
            "scene": scene,
            "critic": critic,
            "seed": seed,
            "decisions": int(row["agent_steps"]),
            "minutes": f"{row['wall_s'] / 60:.2f}",
            "value": f"{row['group_return_mean']:.4g}",
            "lesson": 1 + sum(int(row[name]) for name in last),
            "lessons": 1 + sum(last.values()),
            "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
        }
        for row in thin(shown, POINTS)
    ]
    append(CURVES, *points)
    if points:
        print(" ".join(f"{name}={value}" for name, value in points[-1].items()), flush=True)
    else:
        print(f"{folder}: no curve, since it ended before its first 100 episodes had", flush=True)


def play(arguments: argparse.Namespace, scene: str, critic: str, seed: int) -> None:
    """Play what a run ended with in the scene as it is, unless that has been done, and append the figure."""
    key = scene, critic, str(seed)
    if key in read_played():
        return
    folder, load = arguments.out / "-".join(key), os.getloadavg()[0]
    checkpoints = checkpoints_in(folder)
    if not checkpoints:
        print(f"{folder}: no checkpoint to play; its curve stands in {CURVES.name}, it was trained elsewhere")
        return

    # Of a run that was resumed for more steps the beginning counts.
    steps = arguments.steps or SCENES[scene]
    end = next((path for path in checkpoints if step_of(path) >= steps), checkpoints[-1])
    measure = measures_of(scene)[0]
    said = mappo_eval(f"run={end}", f"episodes={measure.episodes}", *last_lesson(folder))
    value, stderr = measure.figure(said)
    row = {
        "date": time.strftime("%Y-%m-%d"),
        "scene": scene,
        "critic": critic,
        "seed": seed,
        "decisions": step_of(end),
        "value": f"{value:.4g}",
        "stderr": f"{stderr:.2g}",
        "episodes": measure.episodes,
        "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
    }
    append(PLAYED, row)
    print(" ".join(f"{name}={value}" for name, value in row.items()), flush=True)


def key_of(row: dict[str, str]) -> tuple[str, str, str]:
    """Return of which run a row of a CSV is."""
    return row["scene"], row["critic"], row["seed"]


def options(scene: str, critic: str, steps: int) -> list[str]:
    """Return the options of a run that is the beginning of the preset's: what falls there falls as there."""
    preset = compose_config([f"env={scene}"]).config
    ppo, fallen = preset.ppo, steps / preset.max_steps
    lr = ppo.lr + fallen * (ppo.lr_final - ppo.lr)
    entropy = ppo.entropy_coef + fallen * (ppo.entropy_coef_final - ppo.entropy_coef)
    finals = [f"ppo.lr_final={lr:.6g}", f"ppo.entropy_coef_final={entropy:.6g}"]
    discount = discount_options(ppo, fallen)
    return [f"model.critic={critic}", f"max_steps={steps}", *finals, *discount, "update_threads=1"]


def discount_options(ppo: PPOConfig, share: float) -> list[str]:
    """Return the options that move the discount over the beginning of a run, this share of it, as there."""
    if ppo.gamma_schedule is Schedule.constant or share == 1:
        return []
    begins, until = ppo.gamma_from / share, ppo.gamma_until / share
    if begins >= 1:
        return ["ppo.gamma_schedule=constant"]
    lines = [f"ppo.gamma_from={begins:.6g}", f"ppo.gamma_until={min(1.0, until):.6g}"]
    if until > 1:  # it ends on the way
        final = ppo.gamma + part_over(1.0, begins, until) * (ppo.gamma_final - ppo.gamma)
        lines.append(f"ppo.gamma_final={final:.6g}")
    return lines


def read_curves() -> dict[str, Curves]:
    """Return what has been trained, by scene."""
    scenes: dict[str, Curves] = {}
    for row in sorted(read_rows(CURVES), key=lambda row: list(CRITICS).index(row["critic"])):
        reached = float(row["decisions"]), float(row["minutes"]), float(row["value"])
        point = Point(*reached, int(row["lesson"]), int(row["lessons"]))
        curves = scenes.setdefault(row["scene"], {})
        curves.setdefault(row["critic"], {}).setdefault(row["seed"], []).append(point)
    return scenes


def read_played() -> Earned:
    """Return what the final checkpoints earn in the scenes as they are."""
    return {key_of(row): float(row["value"]) for row in read_rows(PLAYED)}


def write_page(scene: str, curves: Curves, played: Earned) -> None:
    """Put the table onto the scene's page."""
    names = ["critic", "seeds", "decisions", "group return", "minutes of a million"]
    if lessons_of(curves) > 1:
        names.insert(4, "lesson at the end")
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]

    for critic, own in curves.items():
        ends = [points[-1] for _, points in sorted(own.items())]
        earned = [played.get((scene, critic, seed), math.nan) for seed in sorted(own)]
        missing = any(map(math.isnan, earned))
        mean = NOT_THERE if missing else f"**{statistics.mean(earned):.2f}**"
        each = ", ".join(NOT_THERE if math.isnan(value) else f"{value:.2f}" for value in earned)
        decisions = ", ".join(f"{steps / 1e6:.1f} M" for steps in sorted({end.decisions for end in ends}))
        pace = statistics.mean(1e6 * end.minutes / end.decisions for end in ends)
        cells = [CRITICS[critic][0], ", ".join(sorted(own)), decisions, f"{mean} ({each})", f"{pace:.1f}"]
        if lessons_of(curves) > 1:
            cells.insert(4, f"{', '.join(str(end.lesson) for end in ends)} of {lessons_of(curves)}")
        lines.append(f"| {' | '.join(cells)} |")

    page = PAGES / f"{scene}.md"
    page.write_text(put_between(page.read_text(), (BEGIN, END), lines))
    print("\n".join(lines))


def lessons_of(curves: Curves) -> int:
    """Return how many lessons the preset has."""
    return max(points[-1].lessons for own in curves.values() for points in own.values())


def draw(scene: str, curves: Curves) -> None:
    """Draw the group returns against decisions and against minutes, a colour for each critic.

    Below them stand the lessons, where there are any; what was earned in earlier ones is pale.
    """
    try:
        import matplotlib
    except ImportError:
        print("the picture needs matplotlib: pip install matplotlib, then --draw")
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    heights = [3, 1] if lessons_of(curves) > 1 else [3]
    figure, axes = pyplot.subplots(
        len(heights),
        2,
        sharex="col",
        sharey="row",
        squeeze=False,
        height_ratios=heights,
        figsize=(10, 1 + 1.1 * sum(heights)),
        layout="constrained",
    )

    for column, place, scale in ((axes[:, 0], 0, 1e6), (axes[:, 1], 1, 1.0)):
        for number, (critic, own) in enumerate(curves.items()):
            name, color = CRITICS[critic]
            column[0].plot([], [], color=color, label=name)
            for points in own.values():
                at, values = [point[place] / scale for point in points], [point.value for point in points]
                final = [point.value if point.lesson == point.lessons else math.nan for point in points]
                column[0].plot(at, values, color=color, linewidth=0.8, alpha=0.3)
                column[0].plot(at, final, color=color, linewidth=1.5)

                # Beside each other, where critics are in the same lesson.
                lessons = [point.lesson + 0.08 * number for point in points]
                for axis in column[1:]:
                    axis.step(at, lessons, color=color, where="post")
        for axis in column:
            axis.grid(alpha=0.3)

    axes[0, 0].set(ylabel="group return, last 100 episodes", title=scene)
    axes[-1, 0].set(xlabel="million decisions")
    axes[-1, 1].set(xlabel="minutes")
    for axis in axes[1:, 0]:
        axis.set(ylabel="lesson", yticks=range(1, lessons_of(curves) + 1))
    axes[0, 1].legend(fontsize="small")
    figure.savefig(BENCHMARKS / f"critics-{scene}.png", dpi=80)
    pyplot.close(figure)


if __name__ == "__main__":
    run_script(main)
