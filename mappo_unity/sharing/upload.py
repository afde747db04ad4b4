"""What of a folder, an ONNX file or an export goes to the hub, and under which names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_policy import OnnxPolicy, file_name
from mappo_unity.policies.policy_files import SUFFIX
from mappo_unity.sharing.beside import CARD
from mappo_unity.sharing.card import card_text, is_ours, merged
from mappo_unity.sharing.facts import facts_of_file
from mappo_unity.sharing.hub import FILMS, README


def upload_of(path: Path) -> dict[str, Path | bytes]:
    """Return what is uploaded of an ONNX file or a folder of them, by its name in the repository.

    ONNX files are named after their behaviors, so that a folder of them plays. Their cards become one
    README.md, unless the folder has one that somebody wrote by hand, or that knows more than bare files do:
    that of a pulled folder.

    Raises:
        ConfigError: nothing to upload, a file that is no ML-Agents model, or two of one behavior.
    """
    models = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
    if not models:
        raise ConfigError(f"nothing to upload: the folder {path} holds no *{SUFFIX}")

    files: dict[str, Path] = {}
    for model in models:
        name = _name(model)
        if name in files:
            raise ConfigError(
                f"{files[name]} and {model} are both of the behavior {Path(name).stem}: push one of them, by "
                "its file"
            )
        files[name] = model

    films = _films(path, models)
    if path.is_dir() and _goes_as_it_is(path / README, files):
        return {**files, README: path / README, **films}
    cards = [_card(model, name) for name, model in files.items()]
    return {**files, README: merged(cards).encode(), **films}


def _name(model: Path) -> str:
    behavior = OnnxPolicy(model, deterministic=False).metadata.get("behavior_name")
    return file_name(behavior) if behavior else model.name


def _goes_as_it_is(readme: Path, files: Mapping[str, Path]) -> bool:
    if not readme.is_file():
        return False
    text = readme.read_text(encoding="utf-8", errors="replace")
    if not is_ours(text):
        return True
    # one of ours, unless a file has a card of its own or has come later
    return not any(map(_own_card, files.values())) and all(name in text for name in files)


def _own_card(model: Path) -> Path | None:
    path = model.with_suffix(CARD)
    return path if path.is_file() and path.name != README else None


def _card(model: Path, name: str) -> str:
    """Return the card beside a file, else one of what the file says of itself; with its name on the hub."""
    path = _own_card(model)
    if path is None:
        return card_text(replace(facts_of_file(model), file=name))

    text = path.read_text(encoding="utf-8", errors="replace")
    return re.sub(rf"(?<![\w.-]){re.escape(model.name)}", name, text) if is_ours(text) else text


def _films(path: Path, models: Sequence[Path]) -> dict[str, Path | bytes]:
    """Return the films: all of a folder, of a file the one with its name."""
    if path.is_dir():
        found = [film for film in sorted(path.iterdir()) if film.suffix in FILMS]
    else:
        found = [models[0].with_suffix(suffix) for suffix in FILMS]
    return {film.name: film for film in found if film.is_file()}
