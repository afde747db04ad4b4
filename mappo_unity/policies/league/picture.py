"""A league as a picture: the ladder of ratings with their intervals, and the matrix of who beat whom.

SVG, written as text; the colours follow the reader's light or dark setting.
"""

from __future__ import annotations

from html import escape

from mappo_unity.policies.league.standings import Standings

_STYLE = """
.lg-text { font: 12px system-ui, sans-serif; fill: #1d2329; }
.lg-dim { font: 11px system-ui, sans-serif; fill: #5a646e; }
.lg-ground { fill: #ffffff; }
.lg-line { stroke: #d5dae0; stroke-width: 1; }
.lg-range { stroke: #2f6fb3; stroke-width: 3; stroke-linecap: round; stroke-opacity: 0.45; }
.lg-dot, .lg-won { fill: #2f6fb3; }
.lg-lost { fill: #c8691c; }
.lg-none { fill: #8a949e; fill-opacity: 0.12; }
@media (prefers-color-scheme: dark) {
  .lg-text { fill: #e6eaee; }
  .lg-dim { fill: #a3adb7; }
  .lg-ground { fill: #14181c; }
  .lg-line { stroke: #333b43; }
  .lg-range { stroke: #6aa9e9; }
  .lg-dot, .lg-won { fill: #6aa9e9; }
  .lg-lost { fill: #e79a58; }
}
"""
_NAMES, _ROW, _EDGE = 186, 26, 12  # pixels: the names' column, a row, the edge of the picture
_LETTERS = 20  # of a name; of a longer one the end is shown, where files of a run differ
_CELL = 34  # the least width of a cell of the matrix, pixels
_VALUES = 66  # pixels right of the ladder for the ratings as numbers


def picture(standings: Standings) -> str:
    """Return the ladder above the matrix as one SVG document."""
    top, upper = ladder(standings)
    bottom, lower = matrix(standings)
    body = f"{top}<g transform='translate(0 {upper})'>{bottom}</g>"
    return f"<?xml version='1.0' encoding='UTF-8'?>\n{svg(standings, body, upper + lower)}\n"


def svg(standings: Standings, body: str, height: int) -> str:
    """Return an SVG element around what was drawn."""
    width = _width(standings)
    size = f"width='{width}' height='{height}'"
    return (
        f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {width} {height}' {size} role='img'>"
        f"<style>{_STYLE}</style><rect class='lg-ground' {size}/>{body}</svg>"
    )


def ladder(standings: Standings) -> tuple[str, int]:
    """Return the drawing of the ratings, best first, and its height in pixels."""
    rows = standings.rows
    left, right = _NAMES, _width(standings) - _EDGE - _VALUES
    low, high = min(row.low for row in rows), max(row.high for row in rows)
    step = _step(high - low)
    first, last = int(low // step), int(-(-high // step))
    scale = (right - left) / max(1, (last - first) * step)

    def place(points: float) -> float:
        return round(left + (points - first * step) * scale, 1)

    height = _EDGE + len(rows) * _ROW + 24
    parts = []
    for tick in range(first, last + 1):
        x = place(tick * step)
        parts.append(f"<line class='lg-line' x1='{x}' x2='{x}' y1='{_EDGE}' y2='{height - 20}'/>")
        parts.append(_text(x, height - 6, tick * step, "lg-dim", "middle"))

    for number, row in enumerate(rows):
        y = _EDGE + number * _ROW + _ROW / 2
        about = f"{row.name}: {row.rating:.0f}, 95 % interval {row.low:.0f} to {row.high:.0f}"
        parts.append(f"<g><title>{escape(about)}</title>{_name(number, row.name, y)}")
        parts.append(
            f"<line class='lg-range' x1='{place(row.low)}' x2='{place(row.high)}' y1='{y}' y2='{y}'/>"
            f"<circle class='lg-dot' cx='{place(row.rating)}' cy='{y}' r='4.5'/>"
        )
        parts.append(_text(_width(standings) - _EDGE, y + 4, f"{row.rating:.0f}", "lg-text", "end") + "</g>")
    return "".join(parts), height


def matrix(standings: Standings) -> tuple[str, int]:
    """Return the drawing of the points of each against each, in per cent, and its height in pixels."""
    count = len(standings.rows)
    side = (_width(standings) - _NAMES - _EDGE) / count
    top = _EDGE + 20
    parts = [_text(_EDGE, top - 8, "% of the points against", "lg-dim")]
    parts += [
        _text(_NAMES + (column + 0.5) * side, top - 8, column + 1, "lg-dim", "middle")
        for column in range(count)
    ]

    for row, name in enumerate(standings.names):
        y = top + row * _ROW
        parts.append(_name(row, name, y + _ROW / 2))
        for column, other in enumerate(standings.names):
            parts.append(_cell(standings, row, column, other, _NAMES + column * side, y, side))
    return "".join(parts), top + count * _ROW + _EDGE


def _cell(standings: Standings, row: int, column: int, other: str, x: float, y: float, side: float) -> str:
    box = f"x='{x + 1:.1f}' y='{y + 1}' width='{side - 2:.1f}' height='{_ROW - 2}' rx='3'"
    if row == column:
        return f"<rect class='lg-none' {box}/>"

    share = standings.share(row, column)
    won, drawn, lost = standings.outcomes[row, column].tolist()
    about = escape(f"{standings.names[row]} against {other}: {won} won, {drawn} drawn, {lost} lost")
    # the further from even, the stronger the colour; weak enough that the number can be read on it
    colour, strength = ("lg-won" if share >= 0.5 else "lg-lost"), 0.06 + abs(share - 0.5)
    number = _text(x + side / 2, y + _ROW / 2 + 4, f"{100 * share:.0f}", "lg-text", "middle")
    return (
        f"<g><title>{about}</title><rect class='{colour}' fill-opacity='{strength:.2f}' {box}/>{number}</g>"
    )


def _name(number: int, name: str, y: float) -> str:
    short = name if len(name) <= _LETTERS else "…" + name[1 - _LETTERS :]
    return _text(_EDGE, y + 4, f"{number + 1}", "lg-dim") + _text(_EDGE + 20, y + 4, short, "lg-text")


def _text(x: float, y: float, text: object, kind: str, anchor: str = "start") -> str:
    return f"<text class='{kind}' x='{x:g}' y='{y:g}' text-anchor='{anchor}'>{escape(str(text))}</text>"


def _width(standings: Standings) -> int:
    return max(480, _NAMES + _CELL * len(standings.rows) + _EDGE)


def _step(span: float) -> int:
    """Return a round distance of ticks, in points, so that there are at most seven."""
    steps = (factor * 10**power for power in range(1, 7) for factor in (1, 2, 5))
    return next((step for step in steps if span <= 5 * step), 10**7)
