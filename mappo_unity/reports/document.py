"""Pages of HTML that load nothing from elsewhere, fit a phone, and are light or dark as the system is."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from html import escape

_STYLE = """
:root { color-scheme: light dark; --ground: #ffffff; --text: #1d2329; --dim: #5a646e; --line: #d5dae0;
  --accent: #2f6fb3; }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14181c; --text: #e6eaee; --dim: #a3adb7; --line: #333b43; --accent: #6aa9e9; }
}
body { margin: 0 auto; max-width: 46rem; padding: 1rem; background: var(--ground); color: var(--text);
  font: 16px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; overflow-wrap: anywhere; } h2 { font-size: 1.15rem; margin-top: 2rem; }
p { color: var(--dim); }
svg { width: 100%; min-width: 26rem; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.3rem 0.5rem; text-align: right; border-bottom: 1px solid var(--line); }
td.number { white-space: nowrap; }
th.name, td.name { text-align: left; overflow-wrap: anywhere; min-width: 7rem; }
"""


def document(title: str, parts: Iterable[str], style: str = "", script: str = "", live: bool = False) -> str:
    """Return a page around its parts.

    Args:
        title: of the page, as plain text.
        parts: what stands in the body, as HTML.
        style, script: CSS and JavaScript of the page's own, at the end of the common style and of the body.
        live: whether the script may ask the server that the page came from.
    """
    # The browser refuses whatever is not named here: nothing but this very script runs, nothing is loaded.
    rules = [
        "default-src 'none'",
        "style-src 'unsafe-inline'",  # what a style could load is refused all the same
        *([f"script-src '{_digest(script)}'"] if script else []),
        *(["connect-src 'self'"] if live else []),
        "img-src data:",
        "media-src data:",
        "base-uri 'none'",
        "form-action 'none'",
    ]
    head = [
        "<!DOCTYPE html>",
        f"<html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<meta http-equiv='Content-Security-Policy' content=\"{'; '.join(rules)}\">",
        *(["<link rel='icon' href='data:,'>"] if live else []),  # browsers ask servers for one
        f"<style>{_STYLE}{style}</style></head><body>",
    ]
    end = [f"<script>{script}</script>"] if script else []
    return "\n".join([*head, *parts, *end, "</body></html>\n"])


def table(heads: Sequence[str], rows: Iterable[Sequence[object]], texts: int) -> str:
    """Return a table whose first columns, `texts` of them, are texts."""
    kinds = ["class='name'" if index < texts else "class='number'" for index in range(len(heads))]
    lines = ["<div class='wide'><table><thead><tr>"]
    lines += [f"<th {kind}>{escape(head)}</th>" for kind, head in zip(kinds, heads)]
    lines.append("</tr></thead><tbody>")
    for row in rows:
        cells = "".join(f"<td {kind}>{escape(str(cell))}</td>" for kind, cell in zip(kinds, row))
        lines.append(f"<tr>{cells}</tr>")
    return "".join([*lines, "</tbody></table></div>"])


def _digest(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
