"""Wrap the prose of Markdown files at 100 columns; tables, code blocks and headings stay as they are.

python scripts/wrap_docs.py             # every *.md of the checkout
python scripts/wrap_docs.py README.md   # these files
"""

from __future__ import annotations

import argparse
import re
import textwrap
from pathlib import Path

from run_script import run_script

WIDTH = 100
ROOT = Path(__file__).resolve().parents[1]
ITEM = re.compile(r"( *)([*+-]|\d+\.) +")


def wrap(text: str, width: int = WIDTH) -> str:
    """Return a Markdown text with its paragraphs and list items wrapped."""
    out: list[str] = []
    paragraph: list[str] = []
    fenced = in_list = False

    def flush() -> None:
        if not paragraph:
            return

        line = paragraph[0]
        item = ITEM.match(line)
        first = item.group(0) if item else " " * (len(line) - len(line.lstrip(" ")))
        rest = line[len(first) :]
        words = " ".join([rest, *paragraph[1:]])
        later = " " * len(first)
        out.extend(_break(words, width, first, later))
        paragraph.clear()

    for line in text.splitlines():
        stripped = line.strip()
        if stripped.startswith("```"):
            flush()
            fenced = not fenced
            out.append(line)
        elif fenced or not stripped:
            flush()
            out.append(line.rstrip())
        elif not paragraph and not in_list and line.startswith("    "):
            out.append(line.rstrip())  # an indented code block
        elif stripped[0] in "#|>" or stripped.startswith(("<!--", "![", "---")):
            flush()
            out.append(line.rstrip())
            in_list = False
        elif ITEM.match(line):
            flush()
            in_list = True
            paragraph.append(line)
        else:
            in_list = in_list and (bool(paragraph) or line.startswith("  "))
            paragraph.append(stripped if paragraph else line.rstrip())

    flush()
    return "\n".join(out) + "\n"


def _break(words: str, width: int, first: str, later: str) -> list[str]:
    """Break between words, but not inside `code`, nor so that a line would begin with a list mark."""
    code = re.sub(r"`[^`]+`", lambda found: found.group(0).replace(" ", "\0"), words)
    code = re.sub(r" (?=(?:[*+-]|\d+\.|#+|\|) )", "\0", code)
    lines = textwrap.wrap(
        code,
        width,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]


def main() -> None:
    """Wrap the files that are named, or all of the checkout; print those that changed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE")
    paths = parser.parse_args().files
    for path in paths:
        if not path.is_file():
            parser.error(f"{path} does not exist, or is not a file")

    paths = paths or [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "mappo_unity").rglob("*.md"),
    ]
    for path in paths:
        before = path.read_text(encoding="utf-8")
        after = wrap(before)
        if after != before:
            path.write_text(after, encoding="utf-8")
            print(path)


if __name__ == "__main__":
    run_script(main)
