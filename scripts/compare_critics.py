#!/usr/bin/env python3
"""Train CooperativePushBlock with each kind of critic, and draw their returns in one picture.

MAPPO's central critic, independent learners' local one (IPPO), MA-POCA's and attention; all else is the
preset of the scene, whose schedules are kept: a run here is the beginning of the preset's. Runs lie in
OUT/CRITIC-SEED and are resumed after any interruption; what was trained is appended to
docs/benchmarks/critics.csv and is not run again. Table and picture stand on the scene's page.

    python scripts/compare_critics.py [--critics central local] [--seeds 0 1 2] [--steps 4000000]
    python scripts/compare_critics.py --draw                  # only the table and the picture

The picture needs matplotlib.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections import defaultdict
from pathlib import Path

from learn_scene import append, read_rows, thin
from score_page import BENCHMARKS, ROOT, Point, draw_seeds, put_between
from score_table import train

from mappo_unity.config.compose import compose_config
from mappo_unity.runs.metrics_csv import read_metrics

SCENE = "CooperativePushBlock"
CRITICS = {
    "central": ("central (MAPPO)", "tab:blue"),
    "local": ("local (IPPO)", "tab:orange"),
    "poca": ("MA-POCA", "tab:green"),
    "attention": ("attention", "tab:red"),
}
CURVES = BENCHMARKS / "critics.csv"
PAGE, PICTURE = ROOT / f"docs/scenes/{SCENE}.md", BENCHMARKS / "critics.png"
BEGIN, END = "<!-- critics -->\n", "<!-- end of critics -->\n"
POINTS = 60  # of a curve

Curves = dict[str, dict[str, list[Point]]]
"""Curves by critic and seed."""


def main() -> None:
    """Train what is missing, then write the table and the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--critics", nargs="+", default=list(CRITICS), choices=list(CRITICS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=4_000_000, help="agent decisions of a run")
    parser.add_argument("--minutes", type=float, default=240.0, help="of collecting and learning, for a run")
    parser.add_argument("--out", type=Path, default=Path("outputs/critics"))
    parser.add_argument("--draw", action="store_true", help="run nothing")
    arguments = parser.parse_args()

    for seed in [] if arguments.draw else arguments.seeds:
        for critic in arguments.critics:
            learn(arguments, critic, seed)

    write_page()


def learn(arguments: argparse.Namespace, critic: str, seed: int) -> None:
    """Train one critic from one seed, unless that has been done, and append its curve."""
    if any((row["critic"], row["seed"]) == (critic, str(seed)) for row in read_rows(CURVES)):
        return
    folder, load = arguments.out / f"{critic}-{seed}", os.getloadavg()[0]
    train(SCENE, seed, folder, arguments.minutes, options(critic, arguments.steps))

    rows = [row for row in read_metrics(folder / "metrics.csv") if row["episodes"] >= 100]
    for row in thin(rows, POINTS):
        point = {
            "date": time.strftime("%Y-%m-%d"),
            "critic": critic,
            "seed": seed,
            "decisions": int(row["agent_steps"]),
            "minutes": f"{row['wall_s'] / 60:.2f}",
            "value": f"{row['group_return_mean']:.4g}",
            "load": f"{load:.1f}-{os.getloadavg()[0]:.1f}",
        }
        append(CURVES, point)
    print(critic, seed, rows[-1]["group_return_mean"], flush=True)


def options(critic: str, steps: int) -> list[str]:
    """Return the options of a run that is the beginning of the preset's: its entropy falls as there."""
    preset = compose_config([f"env={SCENE}"]).config
    fallen = steps / preset.max_steps
    start, end = preset.ppo.entropy_coef, preset.ppo.entropy_coef_final
    entropy = f"ppo.entropy_coef_final={start + fallen * (end - start):.6g}"
    return [f"model.critic={critic}", f"max_steps={steps}", entropy, "update_threads=1"]


def read_curves() -> Curves:
    """Return what has been trained."""
    curves: Curves = {critic: defaultdict(list) for critic in CRITICS}
    for row in read_rows(CURVES):
        point = float(row["decisions"]), float(row["minutes"]), float(row["value"])
        curves[row["critic"]][row["seed"]].append(point)
    return {critic: own for critic, own in curves.items() if own}


def write_page() -> None:
    """Put the table onto the scene's page, and draw the picture where matplotlib is there."""
    curves = read_curves()
    names = "critic", "seeds", "decisions", "group return at the end", "minutes of a million"
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for critic, own in curves.items():
        ends = [points[-1] for _, points in sorted(own.items())]
        values = f"**{statistics.mean(value for *_, value in ends):.2f}** ("
        values += ", ".join(f"{value:.2f}" for *_, value in ends) + ")"
        decisions = ", ".join(f"{steps / 1e6:.1f} M" for steps in sorted({steps for steps, *_ in ends}))
        pace = statistics.mean(1e6 * minutes / steps for steps, minutes, _ in ends)
        cells = CRITICS[critic][0], ", ".join(sorted(own)), decisions, values, f"{pace:.1f}"
        lines.append(f"| {' | '.join(cells)} |")

    PAGE.write_text(put_between(PAGE.read_text(), (BEGIN, END), lines))
    print("\n".join(lines))
    draw(curves)


def draw(curves: Curves) -> None:
    """Draw the group returns against decisions and against minutes, a colour for each critic."""
    try:
        import matplotlib
    except ImportError:
        print("the picture needs matplotlib: pip install matplotlib, then --draw")
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
    for axis, place, label in ((axes[0], 0, "million decisions"), (axes[1], 1, "minutes")):
        scale = 1e6 if place == 0 else 1.0
        for critic, own in curves.items():
            name, color = CRITICS[critic]
            seeds = [[(point[place] / scale, point[2]) for point in points] for points in own.values()]
            draw_seeds(axis, seeds, color, name)
        axis.set(xlabel=label)
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="group return, last 100 episodes", title=SCENE)
    axes[1].legend(fontsize="small")
    figure.savefig(PICTURE, dpi=80)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
