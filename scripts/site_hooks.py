"""What mkdocs calls while it builds the site (`hooks` in mkdocs.yml): navigation, generated pages, links.

The documents are written to be read in the repository. Here they become a site: the navigation is
docs/README.md, the first page is README.md, options and commands are asked of the package, and a file
outside docs/ to which a page links becomes a page that shows it.
"""

from __future__ import annotations

import html
import importlib
import os
import posixpath
import re
from pathlib import Path
from typing import Any
from unittest import mock

ROOT = Path(__file__).resolve().parents[1]
INDEX = "docs/README.md"
SCHEMA = "mappo_unity/config/schema"
GENERATED = {"options.md": "Every option", "commands.md": "Every command"}
_LINK = re.compile(r"(?<=\]\()([^)\s#]+)(?=[)#])")
_BULLET_LINK = re.compile(r"\[([^\]]+)\]\(([^)\s]+)\)")
_MOST_LINKS = 3  # a bullet of docs/README.md with more of them is a section of its own


def on_config(config: Any) -> Any:
    """Take the navigation from docs/README.md."""
    config["nav"] = navigation((ROOT / INDEX).read_text(encoding="utf-8"))
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that do not stand in docs/, and leave out docs/README.md, which is the navigation."""
    from mkdocs.structure.files import File

    files.remove(files.get_file_from_path("README.md"))

    pages = {"options.md": options_page(), "commands.md": commands_page()}
    for path in sorted(linked_from_outside()):
        pages[site_path(path)] = outside_page(path)

    for uri, content in pages.items():
        files.append(File.generated(config, uri, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to where files of the repository are on the site."""
    uri = page.file.src_uri
    source = f"docs/{uri}" if page.file.generated_by is None else _outside_source(uri)
    return rewrite_links(markdown, source) if source else markdown


def navigation(index: str) -> list[dict[str, Any]]:
    """Return the navigation that the headings and bullets of docs/README.md make."""
    nav: list[dict[str, Any]] = [{"Home": "index.md"}]

    for block in re.split(r"^\*\*(?=[^*\n]+\*\*$)", index, flags=re.MULTILINE)[1:]:
        heading, _, rest = block.partition("**")
        items: list[dict[str, Any]] = []

        for bullet in re.split(r"^\* ", rest, flags=re.MULTILINE)[1:]:
            links = [
                {" ".join(title.split()): site_path(_normal(f"docs/{link}"))}
                for title, link in _BULLET_LINK.findall(bullet)
            ]
            links = [link for link in links if "index.md" not in link.values()]  # Home has it
            items += [{next(iter(links[0])): links}] if len(links) > _MOST_LINKS else links

        nav.append({heading: items})

    nav.insert(2, {"Look up": [{title: uri} for uri, title in GENERATED.items()]})
    return nav


def site_path(path: str) -> str:
    """Return where the site has a file of the repository: ``docs/export.md`` -> ``export.md``."""
    if path in ("README.md", INDEX):
        return "index.md"
    if path == SCHEMA:
        return "options.md"
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return f"project/{path}" if path.endswith(".md") else f"project/{path}.md"


def rewrite_links(markdown: str, source: str) -> str:
    """Rewrite the relative links of a file of the repository for its place on the site."""
    here, there = posixpath.dirname(source), posixpath.dirname(site_path(source))

    def place(match: re.Match[str]) -> str:
        target = _normal(posixpath.join(here, match[1]))
        if "://" in match[1] or not (ROOT / target).exists():
            return match[1]  # mkdocs tells what leads nowhere
        return posixpath.relpath(site_path(target), there or ".")

    return _LINK.sub(place, markdown)


def linked_from_outside() -> set[str]:
    """Return the files outside docs/ that become pages: README.md and whatever pages link to."""
    open_paths = ["README.md", *(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md"))]
    seen: set[str] = set()

    while open_paths:
        path = open_paths.pop()
        if path in seen:
            continue
        seen.add(path)

        if not path.endswith(".md"):
            continue
        text = (ROOT / path).read_text(encoding="utf-8")
        targets = [_normal(posixpath.join(posixpath.dirname(path), link)) for link in _LINK.findall(text)]
        open_paths += [target for target in targets if (ROOT / target).exists()]

    return {path for path in seen if not path.startswith("docs/") and path != SCHEMA}


def outside_page(path: str) -> str:
    """Return a page for a file or folder outside docs/: a document as it is, code in a block."""
    if path.endswith(".md"):
        return (ROOT / path).read_text(encoding="utf-8")

    inside = sorted((ROOT / path).rglob("*")) if (ROOT / path).is_dir() else [ROOT / path]
    blocks = [
        f"## {file.relative_to(ROOT).as_posix()}\n\n"
        f"````{file.suffix[1:]}\n{file.read_text(encoding='utf-8')}````\n"
        for file in inside
        if file.suffix in (".py", ".toml", ".yaml", ".xml", ".md")
    ]
    return f"# {path}\n\n" + "\n".join(blocks)


def options_page() -> str:
    """Return every option of mappo-train with type, default and description, each under a heading."""
    from mappo_unity.config.option_table import option_table, short_type, show_value
    from mappo_unity.config.schema import Config

    table = option_table(Config)
    sections = [option for option in table.values() if option.is_section]
    parts = [
        "# Every option\n\nOptions of `mappo-train`, written `name=value` on the command line "
        "(`mappo-train env=3DBall ppo.lr=3e-4`); `mappo-train --help` prints the same, and the presets. "
        "What a preset or a recipe sets wins over the defaults here."
    ]

    # what stands in no section comes first
    for section in [None, *sections]:
        key = section.key if section else ""
        text = escaped(section.description) if section else "What stands in no section."
        parts.append(f"## {f'{key}.*' if section else 'The run'}\n\n{text}")

        for option in table.values():
            if option.key.rpartition(".")[0] != key or option.is_section:
                continue
            default = show_value(option.default)
            given = "must be given" if default == "???" else f"default `{default or repr(default)}`"
            kind = short_type(option.type)
            parts.append(f"### `{option.key}`\n\n`{kind}`, {given}<br>\n{escaped(option.description)}")

    return "\n\n".join(parts) + "\n"


def commands_page() -> str:
    """Return the text of --help of every command; mappo-train's without its options."""
    declared = re.findall(
        r"^(mappo-(\w+)) = ", (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE
    )
    parts = ["# Every command\n\nWhat `--help` prints."]

    for name, module in declared:
        with mock.patch.dict(os.environ, COLUMNS="84"):  # the help is as wide as the terminal
            text = importlib.import_module(f"mappo_unity.cli.{module}").help_text().rstrip()
        if name == "mappo-train":
            text = text.partition("\nOptions (")[0].rstrip()
        parts.append(f"## {name}\n\n```text\n{text}\n```")
        if name == "mappo-train":
            parts.append("Its options have a page of their own: [every option](options.md).")

    return "\n\n".join(parts) + "\n"


def escaped(text: str) -> str:
    """Return plain text for Markdown: its stars and angle brackets are meant as such, code stays code."""
    pieces = re.split(r"(`[^`]*`)", text)
    return "".join(
        piece if piece.startswith("`") else html.escape(piece, quote=False).replace("*", r"\*")
        for piece in pieces
    )


def _normal(path: str) -> str:
    return posixpath.normpath(path)


def _outside_source(uri: str) -> str | None:
    if uri == "index.md":
        return "README.md"
    path = uri.removeprefix("project/")
    return path if path != uri and (ROOT / path).is_file() else None
