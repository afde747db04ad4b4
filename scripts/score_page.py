"""What scripts/score_table.py writes: docs/benchmarks/scores.md, a picture of each scene, README's table."""

from __future__ import annotations

import math
import statistics
import textwrap
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from learn_scene import read_rows
from score_measures import MEASURES, Measure

from mappo_unity.diagnosis.evidence import amount

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
BENCHMARKS = ROOT / "docs/benchmarks"
SCORES = BENCHMARKS / "scores.csv"
CURVES = BENCHMARKS / "score_curves.csv"
PAGE = BENCHMARKS / "scores.md"
PICTURES = BENCHMARKS / "scores"
FIXED = "random", "unity"
KEPT_ASIDE = "3"  # the seed that is not looked at while presets are chosen
BEGIN, END = "<!-- scores -->\n", "<!-- end of scores -->\n"  # around README's table

Point = tuple[float, float, float]
"""Decisions, minutes, value."""

HEAD = """\
# Scores

What `mappo-train env=NAME` reaches with nothing else said (options that were given stand in
[scores.csv](scores.csv)), beside Unity's own policy in the same scene. Trained and measured by
`scripts/score_table.py` on a share of two cores (WallJump, Pyramids and Walker, whose presets have
workers, on both); every value is of 400 episodes or matches (WallJump: 2,000; against the own
goalie: 800 matches; decisions to a goal: the half of them that are played as the strikers) with the
run's best checkpoint, sampled as it explores and, after the slash, without sampling. *Ours*: the
mean over seeds 0 to 2 and, in brackets, each of them. *Kept aside*: seed 3, which nobody looked at
while the presets were chosen. *Reached after*: decisions and minutes at which the curve of training
first stood at the target, for the seeds that did.

Written by the script: change nothing here by hand.
"""


def write_page() -> None:
    """Write the page, and the pictures where matplotlib is there."""
    rows = read_rows(SCORES)
    names = "scene", "measure", "target", "ours", "kept aside", "Unity's policy", "random", "reached after"
    lines = [HEAD, *table(names, table_row, rows)]

    missing = [measure.scene for measure in MEASURES if not of(measure, rows)]
    if missing:
        lines += ["", textwrap.fill(f"Not measured yet: {', '.join(dict.fromkeys(missing))}.", 100)]

    drawn = draw_curves()
    lines += [f"\n![Return of {scene} against decisions and minutes](scores/{scene}.png)" for scene in drawn]
    PAGE.write_text("\n".join(lines) + "\n")
    README.write_text(with_summary(README.read_text()))


def table(
    names: Sequence[str], row_of: Callable[[Measure, list[dict[str, str]]], str], rows: list[dict[str, str]]
) -> list[str]:
    """Return the lines of a table with a row for each measure that has been taken."""
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    return lines + [row_of(measure, own) for measure in MEASURES if (own := of(measure, rows))]


def of(measure: Measure, rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return the rows of a measure, without those that were tried in vain."""
    own = measure.scene, measure.name
    return [row for row in rows if (row["scene"], row["measure"]) == own and row["value"]]


def is_tuned_on(row: dict[str, str]) -> bool:
    """Return whether a row is of one of the seeds that were looked at while presets were chosen."""
    return row["policy"] not in {KEPT_ASIDE, *FIXED}


def target_of(measure: Measure) -> str:
    """Return the target as ``>= 0.93``."""
    return f"{'<=' if measure.is_lower_better else '>='} {measure.target:g}"


def table_row(measure: Measure, rows: list[dict[str, str]]) -> str:
    """Return a measure's row of the page's table, which compares policies."""
    seeds = sorted(filter(is_tuned_on, rows), key=lambda row: int(row["policy"]))
    columns = KEPT_ASIDE, "unity", "random"
    cells = [
        *(measure.scene, measure.name, target_of(measure)),
        both_ways(seeds),
        *(both_ways([row for row in rows if row["policy"] == player]) for player in columns),
        reached_after(measure),
    ]
    return f"| {' | '.join(cells)} |"


def both_ways(rows: list[dict[str, str]]) -> str:
    """Return the mean over policies and their values, sampled and without sampling."""
    texts = []
    for sampled in ("True", "False"):
        values = [float(row["value"]) for row in rows if row["sampled"] == sampled]
        if len(values) == 1:
            texts.append(amount(values[0]))
        elif values:
            texts.append(f"**{amount(statistics.mean(values))}** ({', '.join(map(amount, values))})")
    return " / ".join(texts) or "-"


def reached_after(measure: Measure) -> str:
    """Return the decisions and minutes after which each seed's curve stood at the target first."""
    return "; ".join(f"{point[0] / 1e6:.2f} M, {point[1]:.1f} min" for point in first_reached(measure)) or "-"


def first_reached(measure: Measure) -> list[Point]:
    """Return where the curve of each seed stood at the target first, of the seeds that did."""
    if measure.opponent in ("unity", "own"):  # no run plays these matches while it learns
        return []

    curves = curves_of(measure.scene, measure.column).values()
    reached = [[point for point in curve if measure.is_reached(point[2])] for curve in curves]
    return [points[0] for points in reached if points]


def with_summary(readme: str) -> str:
    """Return README with today's table: the mean over seeds beside random play and Unity's policy."""
    names = "scene", "measure", "random", "preset", "Unity's policy", "target", "target first reached after"
    lines = table(names, summary_row, read_rows(SCORES))
    return put_between(readme, (BEGIN, END), lines)


def put_between(text: str, marks: tuple[str, str], lines: Sequence[str]) -> str:
    """Return a page with these lines in place of those between the two marks."""
    begin, end = marks
    head, _, rest = text.partition(begin)
    return head + begin + "\n".join(lines) + "\n" + end + rest.partition(end)[2]


def summary_row(measure: Measure, rows: list[dict[str, str]]) -> str:
    """Return a measure's row of README's table."""
    sampled = [row for row in rows if row["sampled"] == "True"]
    seeds = [float(row["value"]) for row in sampled if is_tuned_on(row)]
    values = {row["policy"]: float(row["value"]) for row in sampled}
    ours = f"**{amount(statistics.mean(seeds))}**" if seeds else "-"
    ours += f" (of {len(seeds)})" if 0 < len(seeds) < 3 else ""
    random, unity = (amount(values[player]) if player in values else "-" for player in FIXED)

    # the seed in the middle, the later one of two; one that never came there is the last
    firsts = sorted(first_reached(measure), key=lambda point: point[1])
    when = "-"
    if firsts:
        decisions, minutes, _ = firsts[min(len(seeds) // 2, len(firsts) - 1)]
        when = f"{decisions / 1e6:.2f} M decisions, {minutes:.1f} min"
        when += "" if len(firsts) == len(seeds) else f" ({len(firsts)} of {len(seeds)} seeds)"

    scene = f"[{measure.scene}](docs/scenes/{measure.scene}.md)"
    return f"| {scene} | {measure.name} | {random} | {ours} | {unity} | {target_of(measure)} | {when} |"


def curves_of(scene: str, column: str) -> dict[str, list[Point]]:
    """Return the curves of a scene's seeds but the one kept aside."""
    curves: dict[str, list[Point]] = defaultdict(list)
    for row in read_rows(CURVES):
        if (row["scene"], row["column"]) == (scene, column) and row["seed"] != KEPT_ASIDE:
            point = float(row["decisions"]), float(row["minutes"]), float(row["value"])
            curves[row["seed"]].append(point)
    return {seed: curves[seed] for seed in sorted(curves, key=int)}


def draw_curves() -> list[str]:
    """Draw a picture for each scene that has curves; return those scenes, or none without matplotlib."""
    try:
        import matplotlib
    except ImportError:
        print("the pictures need matplotlib: pip install matplotlib, then --draw")
        return sorted(path.stem for path in PICTURES.glob("*.png"))
    matplotlib.use("Agg")

    PICTURES.mkdir(exist_ok=True)
    drawn = []
    for scene in dict.fromkeys(measure.scene for measure in MEASURES):
        # of several measures of one curve, the first is what it shows
        measures = list({m.column: m for m in reversed(MEASURES) if m.scene == scene}.values())[::-1]
        shown = [measure for measure in measures if curves_of(scene, measure.column)]
        if shown:
            draw_scene(scene, shown, PICTURES / f"{scene}.png")
            drawn.append(scene)
    return drawn


def draw_scene(scene: str, measures: list[Measure], path: Path) -> None:
    """Draw a row of two panels for each measure: against decisions, and against minutes."""
    from matplotlib import pyplot

    rows = read_rows(SCORES)
    figure, axes = pyplot.subplots(
        *(len(measures), 2), figsize=(8, 2.9 * len(measures)), layout="constrained", squeeze=False
    )
    for measure, (left, right) in zip(measures, axes):
        curves = curves_of(scene, measure.column)
        for axis, place, label in ((left, 0, "million decisions"), (right, 1, "minutes")):
            scale = 1e6 if place == 0 else 1.0
            draw_seeds(axis, [[(p[place] / scale, p[2]) for p in points] for points in curves.values()])
            draw_levels(axis, measure, of(measure, rows))
            axis.set(xlabel=label)
            axis.grid(alpha=0.3)
        left.set(ylabel=measure.column.replace("/", "\n").replace("_", " "), title=scene)
        right.legend(fontsize="small")
    figure.savefig(path, dpi=80)
    pyplot.close(figure)


def draw_seeds(
    axis: Any, curves: list[list[tuple[float, float]]], color: str = "tab:blue", name: str = ""
) -> None:
    """Draw every seed thin, and their mean with its spread where all of them have values."""
    import numpy as np

    label = f"{name}, " if name else ""
    for points in curves:
        axis.plot(*zip(*points), color=color, linewidth=0.8, alpha=0.6)
    if len(curves) < 2:
        axis.plot([], [], color=color, linewidth=0.8, label=f"{label}1 seed")
        return

    start, end = max(c[0][0] for c in curves), min(c[-1][0] for c in curves)
    at = np.linspace(start, end, 100)
    values = np.array([np.interp(at, *np.array(points).T) for points in curves])
    mean, spread = values.mean(0), values.std(0)
    axis.plot(at, mean, color=color, linewidth=2, label=f"{label}mean of {len(curves)} seeds")
    axis.fill_between(at, mean - spread, mean + spread, color=color, alpha=0.15, linewidth=0)


def draw_levels(axis: Any, measure: Measure, rows: list[dict[str, str]]) -> None:
    """Draw lines at the target, at Unity's policy and at random play."""
    axis.axhline(measure.target, color="tab:green", linestyle="--", linewidth=1, label="target")
    if measure.opponent is not None:
        return
    for player, color in (("unity", "tab:orange"), ("random", "gray")):
        values = [float(r["value"]) for r in rows if r["policy"] == player and r["sampled"] == "True"]
        if values and not math.isnan(values[0]):
            label = {"unity": "Unity's policy"}.get(player, player)
            axis.axhline(values[0], color=color, linestyle=":", linewidth=1.2, label=label)
