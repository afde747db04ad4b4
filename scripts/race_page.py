"""The page and the picture of scripts/race_peer.py: what three trainers reached in the same minutes."""

from __future__ import annotations

import math
from typing import NamedTuple

from learn_scene import read_rows
from recorded_player import ROOT
from score_page import put_between

RACE = ROOT / "docs/benchmarks/race.csv"
MATCHES = ROOT / "docs/benchmarks/race_matches.csv"
PAGE = ROOT / "docs/benchmarks/race.md"
PEER, PLAYER, EMBEDDED = "mlagents-learn", "preset through the player", "preset embedded"
NAMES = (PEER, PLAYER, EMBEDDED)
COLORS = {PEER: "tab:orange", PLAYER: "tab:cyan", EMBEDDED: "tab:blue"}
TARGETS = {
    "3DBall": 95.0,
    "Basic": 0.9,
    "DungeonEscape": 0.5,
    "Hallway": 0.7,
    "PushBlock": 4.5,
    "Pyramids": 1.75,
    "WallJump": 0.8,
}
"""Returns that show a scene learnt."""
WINDOW = 100  # episodes of a mean

Row = dict[str, str]


def write_page() -> None:
    """Write the table, and the picture if matplotlib is there."""
    runs: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in read_rows(RACE):
        runs.setdefault((row["scene"], row["seed"]), {}).setdefault(row["who"], []).append(row)

    lines = [
        f"| scene | seed | minutes | {' | '.join(NAMES)} | seconds to the target | times as fast | load |",
        "|---" * 9 + "|",
        *(race_row(scene, seed, by_who) for (scene, seed), by_who in sorted(runs.items())),
        *matches_table(),
    ]
    PAGE.write_text(put_between(PAGE.read_text(), ("<!-- table -->\n", "<!-- end -->\n"), lines))
    print("\n".join(lines))
    draw(runs)


def race_row(scene: str, seed: str, by_who: dict[str, list[Row]]) -> str:
    """Return a line of the table: where the three stood after the same minutes, and when at the target."""
    limit_s = min(float(own[0]["limit"]) for own in by_who.values())
    cells = [standing(by_who.get(who, []), limit_s) for who in NAMES]

    times, ratios = "-", "-"
    if scene in TARGETS:
        at = {who: time_to(by_who.get(who, []), TARGETS[scene]) for who in NAMES}
        times = f"{TARGETS[scene]:g}: {', '.join(map(time_text, at.values()))}"
        ratios = ", ".join(ratio_text(at[PEER], at[who]) for who in (PLAYER, EMBEDDED))

    loads = " ".join(dict.fromkeys(own[0]["load"] for own in by_who.values()))
    return f"| {scene} | {seed} | {limit_s / 60:g} | {' | '.join(cells)} | {times} | {ratios} | {loads} |"


def standing(rows: list[Row], at_s: float) -> str:
    """Return the mean return of the newest episodes at a time, "-" where there is none."""
    values = [row["return"] for row in rows if float(row["second"]) <= at_s]
    return f"{float(values[-1]):.3g}" if values else "-"


class Time(NamedTuple):
    """How long one needed to a target, or was given for it."""

    seconds: float
    """nan: nobody tried, or all decisions of the configuration were made without getting there."""
    reached: bool


def time_to(rows: list[Row], target: float) -> Time:
    """Return when a curve first stood at a target, or how long it did not."""
    for row in rows:
        if float(row["return"]) >= target:
            return Time(float(row["second"]), True)

    cut_off = bool(rows) and float(rows[0]["seconds"]) >= float(rows[0]["limit"])
    return Time(float(rows[0]["limit"]) if cut_off else math.nan, False)


def time_text(time: Time) -> str:
    """Write seconds to a target; "> 840": not within 840 s, "-": not at all."""
    if math.isnan(time.seconds):
        return "-"
    return f"{time.seconds:.0f}" if time.reached else f"> {time.seconds:.0f}"


def ratio_text(theirs: Time, ours: Time) -> str:
    """Write mlagents-learn's time to the target by ours, or what that is more than; "-": ours is missing."""
    if not ours.reached or math.isnan(theirs.seconds):
        return "-"
    ratio = f"{theirs.seconds / ours.seconds:.1f}"
    return ratio if theirs.reached else f"> {ratio}"


def matches_table() -> list[str]:
    """Return the lines of a table: who won what share of the decided matches."""
    cells: dict[tuple[str, str, str, str], dict[str, str]] = {}
    for row in read_rows(MATCHES):
        key = row["scene"], row["seed"], row["minutes"], row["against"]
        share = f"{100 * float(row['won']):.1f} % ({100 * float(row['stderr']):.1f})"
        cells.setdefault(key, {})[row["who"]] = f"{share}, {int(row['decisions']) / 1e6:.2f} M"
    if not cells:
        return []
    lines = ["", f"| matches | seed | minutes | against | {' | '.join(NAMES)} |", "|---" * 7 + "|"]
    for key, by_who in cells.items():
        lines.append(f"| {' | '.join(key)} | {' | '.join(by_who.get(who, '-') for who in NAMES)} |")
    return lines


def draw(runs: dict[tuple[str, str], dict[str, list[Row]]]) -> None:
    """Draw a panel for each scene: return against minutes."""
    try:
        import matplotlib
    except ImportError:
        return
    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = sorted({scene for scene, _ in runs})
    if not scenes:
        return

    columns = min(2, len(scenes))
    rows = -(-len(scenes) // columns)
    size = 5 * columns, 3.2 * rows
    figure, axes = pyplot.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)

    for axis, scene in zip(axes.flat, scenes):
        for (name, _), by_who in runs.items():
            for who, points in by_who.items() if name == scene else ():
                minutes = [float(point["second"]) / 60 for point in points]
                returns = [float(point["return"]) for point in points]
                axis.plot(minutes, returns, color=COLORS[who], label=who)

        # a name once, however many seeds
        handles = {label: handle for handle, label in zip(*axis.get_legend_handles_labels())}
        axis.set(title=scene, xlabel="minutes", ylabel="return, last 100 episodes")
        axis.grid(alpha=0.3)
        axis.legend(handles.values(), handles.keys(), fontsize=8)

    for axis in axes.flat[len(scenes) :]:
        axis.remove()
    figure.savefig(RACE.with_suffix(".png"), dpi=80)
