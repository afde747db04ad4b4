"""The site of docs/ and the image: what can be checked without mkdocs and without Docker."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

from mappo_unity.config.option_table import option_table
from mappo_unity.config.schema import Config

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import site_hooks  # noqa: E402

PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def leaves(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    return [leaf for item in nav for value in item.values() for leaf in leaves(value)]


def test_every_page_is_in_the_navigation() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    found = leaves(site_hooks.navigation(index))

    assert pages - {"README.md"} <= set(found)
    assert {"index.md", "options.md", "commands.md"} <= set(found)
    assert len(found) == len(set(found))


def test_headings_and_long_bullets_are_sections() -> None:
    links = ", ".join(f"[S{number}](s/{number}.md)" for number in range(4))
    nav = site_hooks.navigation(
        f"# All\n\n**Use**\n\n* [A\n  b](a.md): x.\n* {links}.\n\n**Change**\n\n* [C](../C.md).\n"
    )

    assert nav[0] == {"Home": "index.md"}
    assert nav[1]["Use"][0] == {"A b": "a.md"}
    assert nav[1]["Use"][1] == {"S0": [{f"S{number}": f"s/{number}.md"} for number in range(4)]}
    assert nav[3] == {"Change": [{"C": "project/C.md"}]}


@pytest.mark.parametrize(
    ("source", "link", "expected"),
    [
        ("docs/demonstrations.md", "../examples/custom_env.py", "project/examples/custom_env.py.md"),
        ("docs/scenes/README.md", "../export.md", "../export.md"),
        ("docs/export.md", "../README.md", "index.md"),
        ("docs/concepts.md", "../mappo_unity/config/schema/", "options.md"),
        ("README.md", "docs/export.md", "export.md"),
        ("CONTRIBUTING.md", "docs/export.md", "../export.md"),
        ("docs/export.md", "no-such-file.md", "no-such-file.md"),
        ("docs/export.md", "https://example.org/a", "https://example.org/a"),
    ],
)
def test_links_lead_to_the_place_on_the_site(source: str, link: str, expected: str) -> None:
    assert (
        site_hooks.rewrite_links(f"[a]({link}#b) and [c]({link})", source)
        == f"[a]({expected}#b) and [c]({expected})"
    )


def test_the_page_of_options_has_each_with_its_default() -> None:
    page = site_hooks.options_page()
    options = [key for key, option in option_table(Config).items() if not option.is_section]

    assert sorted(re.findall(r"^### `(.+)`$", page, re.MULTILINE)) == sorted(options)
    assert "### `seed`\n\n`int`, default `0`<br>\nSeed of the environment" in page
    assert site_hooks.escaped("a*b <env> `x*<y>`") == r"a\*b &lt;env&gt; `x*<y>`"


def test_the_page_of_commands_has_every_one() -> None:
    page = site_hooks.commands_page()
    commands = re.findall(r"^(mappo-\w+) =", PROJECT, re.MULTILINE)

    assert re.findall(r"^## (.+)$", page, re.MULTILINE) == commands
    assert "mappo-train resume=RUN" in page and "--mlagents-port" in page
    assert "  ppo.lr: float" not in page


def test_the_image_installs_what_the_project_asks_for() -> None:
    (torch,) = re.findall(r'^    "(torch[<>=][^"]*)"', PROJECT, re.MULTILINE)
    assert f'pip install --no-cache-dir "{torch}"' in DOCKERFILE

    (extras,) = re.findall(r"^ARG EXTRAS=(\S+)$", DOCKERFILE, re.MULTILINE)
    for extra in extras.split(","):
        assert re.search(rf"^{extra} = \[", PROJECT, re.MULTILINE)

    # pip builds the project from what is copied, all of which must be there and not be ignored
    copied = re.findall(r"^COPY (.+) \S+$", DOCKERFILE, re.MULTILINE)
    names = [name for line in copied for name in line.split()]
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    assert {"pyproject.toml", "README.md", "LICENSE", "mappo_unity", "conf"} <= set(names)
    assert all((ROOT / name).exists() and f"!{name}" in ignored for name in names)


def test_the_page_on_installing_has_every_extra_and_no_other() -> None:
    section = PROJECT.split("[project.optional-dependencies]\n")[1].split("\n\n[")[0]
    extras = re.findall(r"^(\w+) = ", section, re.M)

    table = (ROOT / "docs" / "install.md").read_text(encoding="utf-8").split("## Extras")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", table, re.M))
    assert len(extras) > 10 and sorted(rows) == sorted(extras)
