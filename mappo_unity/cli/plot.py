"""mappo-plot: curves of runs as a picture."""

from __future__ import annotations

import sys
from pathlib import Path

from mappo_unity.config.schema import PlotConfig


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import plot_help

    return plot_help(PlotConfig)


def run(lines: list[str]) -> int:
    """Draw the curves; print what they are of; return the exit code."""
    from mappo_unity.config.compose import compose_plain
    from mappo_unity.config.plain_options import take_words
    from mappo_unity.reports.figure import check_out, draw_curves, split_metrics
    from mappo_unity.reports.groups import group_runs
    from mappo_unity.reports.reading import read_runs

    options = compose_plain(take_words(lines, PlotConfig, "runs"), PlotConfig)
    out = Path(options.out)
    check_out(out)

    runs, notes = read_runs(options.runs)
    metrics = split_metrics(options.metric, runs)
    groups = group_runs(runs)
    draw_curves(groups, metrics, options.x, out)

    for note in notes:
        print(f"mappo-plot: {note}", file=sys.stderr)
    print(f"{out}: {', '.join(metrics)} over {options.x.name}")
    for group in groups:
        print(f"  {group.label}: {len(group.runs)} run{'s' if len(group.runs) > 1 else ''}")
    return 0
