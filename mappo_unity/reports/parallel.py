"""Runs of a sweep as parallel coordinates: an axis for each option in which they differ, the last the return.

SVG, written as text. A line a run; the higher its return, the stronger its colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from mappo_unity.reports.groups import run_names, set_apart
from mappo_unity.reports.reading import Run
from mappo_unity.reports.sections import figure, last

_MOST = 8  # axes of options
_LETTERS, _LINE = 18, 14  # of a text; pixels from one line of text to the next
_HEIGHT, _TOP, _BOTTOM, _SIDE = 280, 34, 20, 60  # pixels
_WIDTH, _GAPS = 620, (130, 220)  # pixels that the axes share; the least and the most between two


def parallel_coordinates(runs: Sequence[Run]) -> str:
    """Return the drawing, or an empty text where the runs differ in nothing that was given."""
    keys, values = set_apart(runs)
    returns = [last(run, "return_mean") for run in runs]
    if not keys or not any(map(math.isfinite, returns)):
        return ""

    axes = [_Axis(key, [one[key] for one in values]) for key in keys[:_MOST]]
    axes.append(_Axis("return_mean", ["nan" if math.isnan(value) else repr(value) for value in returns]))
    gap = min(max(_WIDTH // (len(axes) - 1), _GAPS[0]), _GAPS[1])
    width = 2 * _SIDE + gap * (len(axes) - 1)
    places = [_SIDE + gap * number for number in range(len(axes))]

    # the best on top of the others
    order = sorted(range(len(runs)), key=lambda number: (math.isfinite(returns[number]), returns[number]))
    names = run_names(runs)
    lines = [_line(axes, places, number, names[number], axes[-1].share(number)) for number in order]
    body = "".join([*lines, *(axis.drawing(x, axis is axes[0]) for axis, x in zip(axes, places))])
    view = f"viewBox='0 0 {width} {_HEIGHT}' width='{width}' height='{_HEIGHT}'"
    return f"<div class='wide'><svg class='parallel' {view} role='img'>{body}</svg></div>"


class _Axis:
    """Where the values of an option lie: numbers in proportion, by their logarithm if they span decades.

    Anything else: the texts at equal distances.
    """

    def __init__(self, name: str, texts: Sequence[str]) -> None:
        self.name = name
        self._texts = texts
        numbers = [_number(text) for text in texts]
        if all(number is not None and not math.isinf(number) for number in numbers):
            values = np.array(numbers, float)
            there = values[np.isfinite(values)]
            if len(there) and there.min() > 0 and there.max() / there.min() >= 10:
                values = np.log10(values)
        else:
            choices = list(dict.fromkeys(texts))
            values = np.array([choices.index(text) for text in texts], float)

        self._values = values
        low, high = np.nanmin(values), np.nanmax(values)
        self._low, self._span = low, (high - low) or 1.0
        self._is_single = high == low

    def share(self, number: int) -> float:
        """Return how high a run's value lies, 0 to 1; NaN without one."""
        if not math.isfinite(self._values[number]):
            return math.nan
        return 0.5 if self._is_single else float((self._values[number] - self._low) / self._span)

    def place(self, number: int) -> float:
        """Return where a run's value lies, in pixels from the top."""
        return round(_HEIGHT - _BOTTOM - self.share(number) * (_HEIGHT - _TOP - _BOTTOM), 1)

    def drawing(self, x: float, is_first: bool) -> str:
        """Return the axis with its name and the values beside it that do not cover one another."""
        parts = [f"<line class='axis' x1='{x}' x2='{x}' y1='{_TOP}' y2='{_HEIGHT - _BOTTOM}'/>"]
        parts.append(
            f"<text class='head' x='{x}' y='16' text-anchor='middle'>{escape(_short(self.name))}</text>"
        )
        # outside of the lines, where there is an outside
        side = f"x='{x - 5}' text-anchor='end'" if is_first else f"x='{x + 5}'"
        letters = _SIDE // 7 if is_first else _LETTERS
        for number in self._apart():
            value = _number(self._texts[number])
            text = self._texts[number] if value is None else figure(value)
            y = self.place(number) + 4
            parts.append(f"<text class='value' {side} y='{y:g}'>{escape(_short(text, letters))}</text>")
        return "".join(parts)

    def _apart(self) -> list[int]:
        """Return runs whose values have room for a line of text each, the ends of the axis first."""
        numbers = [number for number in range(len(self._texts)) if math.isfinite(self._values[number])]
        apart: list[int] = []
        for number in sorted(numbers, key=lambda number: -abs(self.share(number) - 0.5)):
            if all(abs(self.place(number) - self.place(other)) >= _LINE for other in apart):
                apart.append(number)
        return apart


def _line(axes: Sequence[_Axis], places: Sequence[int], number: int, name: str, share: float) -> str:
    if math.isnan(share):  # a run without a return
        axes, share = axes[:-1], 0.0
    points = " ".join(f"{x},{axis.place(number)}" for axis, x in zip(axes, places))
    about = ", ".join(f"{axis.name}={axis._texts[number]}" for axis in axes)
    return (
        f"<polyline class='run' points='{points}' stroke-opacity='{0.2 + 0.8 * share:.2f}'>"
        f"<title>{escape(f'{name}: {about}')}</title></polyline>"
    )


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _short(text: str, letters: int = _LETTERS) -> str:
    return text if len(text) <= letters else "…" + text[1 - letters :]
