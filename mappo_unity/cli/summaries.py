"""Tables and summaries of runs, sweeps and evaluations for people, and their machine-readable twins.

Nothing is printed here: the commands print what these functions return.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from mappo_unity.config.overrides import shell_argument, shell_word
from mappo_unity.training.sweep import JobResult, SweepResult, job_options, varied_options

if TYPE_CHECKING:
    from mappo_unity.policies.league.standings import Standings
    from mappo_unity.policies.league.table import Result
    from mappo_unity.training.trainer import Outcome

RESULTS = "results.csv"
_LABELS = {
    "agent_steps": "agent steps of training",
    "interrupted": "ended by the time limit",
    "stderr": "standard error of the mean",
    "won_of_decided_low95": "won of decided, 95 % from",
    "won_of_decided_high95": "won of decided, 95 % to",
}
"""What the table calls figures whose names in the JSON line say too little."""
_SHARES = ("interrupted", "won_of_decided", "won_of_decided_low95", "won_of_decided_high95")
"""Figures that are shares from 0 to 1, and percentages in the table."""
_PIPE_WIDTH = 160  # columns of a table that nobody's terminal limits


def console() -> Console:
    """Return a console on standard output, wide where it is no terminal; what it prints has no markup."""
    # [a.demo] and :name: in a user's options are no tags and no pictures
    plain = Console(highlight=False, markup=False, emoji=False)
    if not plain.is_terminal:
        plain.width = _PIPE_WIDTH
    return plain


def run_summary(outcome: Outcome, folder: Path) -> list[str]:
    """Return the closing lines of a run: figures, where the best policy is, what to type next."""
    rate = outcome.agent_steps / outcome.wall_s if outcome.wall_s > 0 else math.nan
    best = outcome.best_checkpoint or outcome.last_checkpoint

    lines = [
        f"{outcome.status}: {outcome.agent_steps:,} agent steps in {outcome.wall_s:,.1f} s ({rate:,.0f}/s), "
        f"mean return {show_number(outcome.return_mean)}"
    ]

    if best is not None:
        lines.append(f"best checkpoint: {best}")

    return [
        *lines,
        *_rollback_lines(outcome.updates),
        f"evaluate:    mappo-eval {shell_argument('run', folder)}",
        f"resume:      mappo-train {shell_argument('resume', folder)}",
        f"curves:      tensorboard --logdir {shell_word(folder)}",
        f"report:      mappo-report {shell_word(folder)}",
    ]


def _rollback_lines(updates: dict[str, tuple[int, int]]) -> list[str]:
    """Say of which policies updates were rolled back, and what helps where it were many."""
    rolled_back = {name: counts for name, counts in updates.items() if counts[0]}
    if not rolled_back:
        return []

    counts = ", ".join(f"{rolled:,} of {total:,} of {name}" for name, (rolled, total) in rolled_back.items())
    lines = [f"updates rolled back (what was collected for them taught nothing): {counts}"]

    if any(10 * rolled > total for rolled, total in rolled_back.values()):
        lines.append(
            "what helps: a smaller ppo.lr, fewer ppo.epochs, ppo.target_kl=0.02 (it ends an update early), "
            "a larger collect.batch_size, other ppo.num_minibatches; behaviors.NAME.ppo... for one policy"
        )

    return lines


def sweep_table(result: SweepResult) -> Table:
    """Return the jobs of a sweep as a table, best first."""
    options = varied_options(result.jobs)
    table = Table(title="Jobs, best first")

    table.add_column("job", justify="right")
    for option in options:
        table.add_column(option)
    for name in ("return_mean", "agent_steps", "wall_s"):
        table.add_column(name, justify="right")
    table.add_column("status")
    table.add_column("error", overflow="fold")

    for job in result.jobs:
        values = [short_text(job_options(job).get(option, "")) for option in options]
        table.add_row(str(job.job), *values, *_figures(job), job.status, job.error or "")

    return table


def sweep_summary(result: SweepResult) -> list[str]:
    """Return the closing lines of a sweep: where it is, and what to type next where a job has trained."""
    lines = [f"sweep folder: {result.folder}"]
    if all(job.error for job in result.jobs):
        return lines

    folder = shell_word(result.folder)
    return [*lines, f"report:       mappo-report {folder}", f"picture:      mappo-plot {folder}"]


def write_csv(result: SweepResult) -> Path:
    """Write the jobs of a sweep, best first, to results.csv in its folder; return the path."""
    path = result.folder / RESULTS

    # the jobs may have set different options: a column for each, empty where a job did not
    options = list(dict.fromkeys(key for job in result.jobs for key in job_options(job)))
    figures = ["status", "return_mean", "agent_steps", "wall_s", "error"]

    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["job", *options, *figures], restval="")
        writer.writeheader()
        for job in result.jobs:
            writer.writerow(
                {"job": job.job, **job_options(job), **{name: getattr(job, name) for name in figures}}
            )

    return path


def eval_table(result: dict[str, Any]) -> Table:
    """Return the figures of an evaluation as a table; nested ones by their dotted names."""
    table = Table(title="Evaluation")
    table.add_column("figure")
    table.add_column("value", justify="right", overflow="fold")  # a path is there to be copied

    for name, value in _flat(result):
        above, dot, last = name.rpartition(".")
        # an option keeps the name by which it is set
        label = last if above == "env.params" else _LABELS.get(last, last.replace("_", " "))
        table.add_row(above + dot + label, _percent(value) if last in _SHARES else show_number(value))

    return table


def pair_line(pair: tuple[str, str], results: Sequence[Result], done: int, total: int) -> str:
    """Return what mappo-league says after each pair."""
    won, drawn, lost = (sum(getattr(row, name) for row in results) for name in ("won", "drawn", "lost"))
    return f"{done}/{total} pairs: {pair[0]} against {pair[1]}: {won} won, {drawn} drawn, {lost} lost"


def league_table(standings: Standings) -> Table:
    """Return a league's players as a table, best first."""
    table = Table(title="League")
    table.add_column("name", overflow="fold")
    for name in ("rating", "95 % from", "to", "won", "drawn", "lost"):
        table.add_column(name, justify="right")
    for row in standings.rows:
        points = (f"{value:.0f}" for value in (row.rating, row.low, row.high))
        table.add_row(row.name, *points, str(row.won), str(row.drawn), str(row.lost))
    return table


def play_line(result: dict[str, Any]) -> str:
    """Return what mappo-play says at its end."""
    line = f"{result['video']}: " if result["video"] else ""
    line += f"{result['seconds']:.1f} s of {result['scene']} played by {result['policy']}, "
    line += f"{result['frames']} frames"

    if result["episodes"]:
        line += f"; {result['episodes']} agent episodes ended, mean return {result['mean_return']:.4g}"
    for file in result["recorded"]:
        held = f"{file.decisions:,} decisions of {file.episodes:,} episodes"
        line += f"\n{file.path}: {held if file.decisions else 'not written, no decision was played out'}"

    return line


def json_line(result: dict[str, Any]) -> str:
    """Return the figures of an evaluation as one line of JSON; not-a-number becomes null."""
    return json.dumps(_finite(result), default=str, allow_nan=False)


def show_number(value: Any) -> str:
    """Return a figure for reading: four significant decimals, thousands apart, "-" for none."""
    if value is None or value != value:  # nothing, or not a number
        return "-"
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return str(value)

    return (
        f"{value:,}" if isinstance(value, int) else f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.1f}"
    )


def _percent(share: float) -> str:
    return "-" if share != share else f"{100 * share:.3g} %"


def short_text(text: str) -> str:
    """Return a number of many digits with four of them; other texts as they are."""
    try:
        return f"{float(text):.4g}" if len(text) > 8 else text
    except ValueError:
        return text


def _figures(job: JobResult) -> tuple[str, str, str]:
    return show_number(job.return_mean), show_number(job.agent_steps), f"{job.wall_s:,.1f}"


def _flat(result: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []

    for name, value in result.items():
        key = f"{prefix}{name}"
        rows += _flat(value, f"{key}.") if isinstance(value, dict) else [(key, value)]

    return rows


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _finite(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
