"""The documents: every page is linked, every link and path leads somewhere, prose has one width."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "mappo_unity").rglob("*.md")])
WIDTH = 100
OWN = ("NAME", "SIGNAL", "raising_env", "wider_env", "my_", "run_policy")  # files of the reader's own

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))


def without_code(text: str) -> str:
    """Leave out code blocks, fenced or indented, and code in a line."""
    lines, fenced, last = [], False, ""
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced and not (line.startswith("    ") and (not last.strip() or last == "code")):
            lines.append(line)
            last = line
            continue
        else:
            last = "code"
        lines.append("")
    return re.sub(r"`[^`\n]*`", "", "\n".join(lines))


def all_links_of(page: Path) -> list[str]:
    """Return the page's links to the repository, its own headings among them."""
    found = re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text(encoding="utf-8")))
    return [link for link in found if "://" not in link and not link.startswith("mailto:")]


def links_of(page: Path) -> list[str]:
    """Return the page's links to other files, without their anchors."""
    return [link.split("#")[0] for link in all_links_of(page) if not link.startswith("#")]


def anchors_of(text: str) -> set[str]:
    """Return the anchors that a page's headings have both in the repository and on the site.

    GitHub makes a hyphen of each space, Python-Markdown one of a row of hyphens and spaces, so that
    the anchors of a heading like "Left- and right-handed" differ and none leads there from both.
    """
    anchors = set()
    fenced = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    for heading in re.findall(r"^#+ (.+)$", fenced, flags=re.MULTILINE):
        words = re.sub(r"[^\w\s-]", "", re.sub(r"\]\([^)]*\)", "", heading)).strip().lower()
        repository, site = words.replace(" ", "-"), re.sub(r"[-\s]+", "-", words)
        if repository == site:
            anchors.add(site)
    return anchors


def overlong(text: str) -> list[str]:
    """Return the lines of prose that are too long; tables, code, images and single long words may be."""
    found, fenced, last = [], False, ""
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        code = fenced or (line.startswith("    ") and last in ("", "code"))
        last = "code" if code else line.strip()
        breakable = " " in re.sub(r"`[^`]*`", "", line.strip()[:WIDTH])
        if len(line) > WIDTH and not code and not last.startswith(("|", "![")) and breakable:
            found.append(line)
    return found


def test_every_page_is_linked_from_the_index() -> None:
    linked = {(DOCS / link).resolve() for link in links_of(DOCS / "README.md")}
    missing = {page for page in DOCS.rglob("*.md") if page.resolve() not in linked} - {DOCS / "README.md"}
    assert not missing, f"not linked from docs/README.md: {sorted(map(str, missing))}"
    assert DOCS / "README.md" in {(ROOT / link).resolve() for link in links_of(ROOT / "README.md")}


@every_page
def test_relative_links_lead_somewhere(page: Path) -> None:
    assert [link for link in links_of(page) if not (page.parent / link).exists()] == []


@every_page
def test_anchors_lead_to_headings(page: Path) -> None:
    dead = []
    for link in all_links_of(page):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if anchor and target.suffix == ".md" and anchor not in anchors_of(target.read_text(encoding="utf-8")):
            dead.append(link)
    assert dead == []


@every_page
def test_prose_has_one_width(page: Path) -> None:
    long = overlong(page.read_text(encoding="utf-8"))
    assert not long, f"over {WIDTH} columns; python scripts/wrap_docs.py wraps them: {long}"


@every_page
def test_named_files_and_modules_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    tops = "mappo_unity|scripts|tests|examples|conf|docs"
    paths = re.findall(rf"(?<![\w./-])((?:{tops})/[\w./*-]*[\w*])", text)
    gone = [path for path in paths if not list(ROOT.glob(path)) and not any(own in path for own in OWN)]
    names = {path.name for top in (*tops.split("|"), ".ci") for path in (ROOT / top).rglob("*.py")}
    files = re.findall(r"(?<![\w./])(\w+\.py)\b", text)
    gone += [name for name in files if name not in names and not any(own in name for own in OWN)]
    modules = re.findall(r"python -m (mappo_unity[\w.]*)", text)
    gone += [name for name in modules if importlib.util.find_spec(name) is None]
    assert gone == []


def test_the_checks_find_what_they_look_for() -> None:
    long = "word " * 30
    assert overlong(f"{long}\n") and overlong(f"* {long}\n  {long}\n")
    assert not overlong(f"a\n\n    {long}\n\n| {long} |\n```\n{long}\n```\n{'x' * 200}\n")
    headings = "# A `b.c` [d](e)\n```\n# code\n```\n## Left- and right\n## By-law"
    assert anchors_of(headings) == {"a-bc-d", "by-law"}
    assert without_code("a\n\n    [x](y)\n\n`[x](y)` [p](q)").endswith(" [p](q)")
