"""The presets under conf/: where they are, which choices there are, what each says of itself.

Neither torch nor Hydra is imported, so that --help comes at once.
"""

from __future__ import annotations

import os
import shlex
from functools import cache
from pathlib import Path

NO_CHOICE = "none"
"""The choice of a group that changes nothing; null means the same."""

_OTHERS = ("hydra", "search")
"""Folders of conf/ that hold no presets of a run; mappo-search reads the second."""

_BASIC = {  # what Hydra brings itself, and takes by default
    "hydra/launcher": {"basic": "One job of a sweep after the other (the default)."},
    "hydra/sweeper": {"basic": "One job for each combination of the values given (the default)."},
}


def conf_dir() -> Path:
    """Return the folder of presets: inside an installed package, or at the top of a checkout."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "conf"
    return inside if inside.is_dir() else package.parent / "conf"


def hint_of_installed_scene(group: str, name: str) -> str:
    """Say how a scene is chosen that an installed package brings (`mappo_unity.scenes.registry`)."""
    from importlib.metadata import entry_points

    if group != "env" or name not in (entry.name for entry in entry_points(group="mappo_unity.scenes")):
        return ""
    return f" as a preset; the installed scene: env=custom env.backend=embedded env.name={name}"


def hint_of_word(word: str) -> str:
    """Say what a word that stands alone may have been meant as; an empty text where nothing is near."""
    for group, names in group_choices().items():
        for name in names:
            if name.lower() == word.lower():
                return f" (did you mean {group}={name}?)"

    is_path = os.path.exists(word)
    return f" (did you mean {shlex.quote(f'resume={word}')}?)" if is_path else ""


@cache
def group_choices() -> dict[str, list[str]]:
    """Return the choices of every group under conf/ (Hydra's own and spaces to search left out), sorted."""
    groups = {}

    for folder in sorted(path for path in conf_dir().iterdir() if path.is_dir() and path.name not in _OTHERS):
        names = sorted((path.stem for path in folder.glob("*.yaml")), key=str.lower)
        if names:
            groups[folder.name] = names

    return groups


def all_groups() -> list[str]:
    """Return every group under conf/ that a person chooses from, Hydra's own too: env first, Hydra's last."""
    conf = conf_dir()
    groups = {path.parent.relative_to(conf).as_posix() for path in conf.rglob("*.yaml")} - {"."}
    # a recipe chooses from the one, mappo-search reads the other
    groups = {group for group in groups if not group.startswith(("official", "search"))}
    return sorted(groups, key=lambda group: (group.startswith("hydra"), group != "env", group))


def describe_choices(group: str) -> dict[str, str]:
    """Return a group's choices, each with the first paragraph of its file's comment."""
    files = sorted((conf_dir() / group).glob("*.yaml"), key=lambda path: path.stem.lower())
    return {**_BASIC.get(group, {}), **{path.stem: _comment(path) for path in files}}


def _comment(path: Path) -> str:
    lines: list[str] = []

    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break

        # @package is meant for Hydra; what stands below an empty line, for readers of the file
        text = line.lstrip("# ")
        if lines and not text:
            break
        if "@package" not in line:
            lines.append(text)

    return " ".join(lines)
