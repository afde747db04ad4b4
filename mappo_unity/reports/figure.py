"""Curves as a picture, PNG or SVG, by matplotlib (extra [plot])."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

from mappo_unity.config.extras import install_command
from mappo_unity.config.schema import XAxis
from mappo_unity.errors import ConfigError
from mappo_unity.reports.curves import check_metric, mean_curve, metric_names
from mappo_unity.reports.groups import Group
from mappo_unity.reports.reading import Run

FORMATS = (".png", ".svg")
_AXES = {XAxis.decisions: "agent decisions", XAxis.time: "seconds of collecting and learning"}


def check_out(path: Path) -> None:
    """Raise ConfigError where a picture cannot be written: its format, its folder, or no matplotlib."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"out={path} must end in {' or '.join(FORMATS)}, which says what is written")
    check_place(path)
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError(f"mappo-plot needs matplotlib, which is not installed: {install_command('plot')}")


def check_place(path: Path) -> None:
    """Raise ConfigError where a file cannot stand: its folder is not there, or it is a folder itself."""
    if path.is_dir():
        raise ConfigError(f"out={path} is a folder: name a file in it")
    if not path.parent.is_dir():
        raise ConfigError(f"out={path} cannot be written: there is no folder {path.parent}")


def split_metrics(text: str, runs: Sequence[Run]) -> list[str]:
    """Return the metrics that an option names, with commas between; raise ConfigError for unknown ones."""
    # a behavior's name may have a comma in it
    names = [text] if text in metric_names(runs) else [name.strip() for name in text.split(",")]
    for name in names:
        check_metric(name, runs)
    return list(dict.fromkeys(names))


def draw_curves(groups: Sequence[Group], metrics: Sequence[str], axis: XAxis, path: Path) -> None:
    """Draw each metric over the axis, a line a group with its spread, one metric below the other.

    Raises:
        ConfigError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    # a figure of its own, without pyplot: no window, no backend to be chosen
    figure = Figure(figsize=(8, 1 + 3.5 * len(metrics)), layout="constrained")
    panels = figure.subplots(len(metrics), 1, sharex=True, squeeze=False)[:, 0]

    for panel, metric in zip(panels, metrics):
        for number, group in enumerate(groups):
            curve = mean_curve(group.runs, metric, axis)
            label = f"{group.label} ({len(group.runs)} runs)" if len(group.runs) > 1 else group.label
            colour = f"C{number % 10}"
            # names of behaviors may hold $, which matplotlib takes for formulas
            marker = "." if len(curve.x) == 1 else ""
            line = {"color": colour, "marker": marker, "linewidth": 1.5}
            panel.plot(curve.x, curve.mean, label=label.replace("$", r"\$"), **line)
            low, high = curve.mean - curve.spread, curve.mean + curve.spread
            panel.fill_between(curve.x, low, high, color=colour, alpha=0.2, linewidth=0)
        panel.set_ylabel(metric.replace("$", r"\$"))
        panel.grid(alpha=0.3)

    panels[-1].set_xlabel(_AXES[axis])
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper left", fontsize="small")
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise ConfigError(f"out={path} cannot be written ({error.strerror or error})") from error
