"""Options from a file: ``mappo-train --config my.yaml ppo.lr=1e-4``.

The file is YAML such as a run's config.yaml, or a part of one. It wins over the presets, and the command line
wins over the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mappo_unity.config import presets
from mappo_unity.config.overrides import check_value, last_value, shell_word
from mappo_unity.config.parameters.values import is_whole
from mappo_unity.config.renamed import rename_keys
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError

SWITCH = "--config"
CLEARED = "cleared"
"""The name under which Hydra finds what `cleared` returns."""
_SUFFIXES = (".yaml", ".yml")
_CHOICES = ("env", "parameters", "recipe")  # groups that a file may choose by name


def take_file(lines: list[str]) -> tuple[list[str], Path | None]:
    """Return the lines without ``--config FILE``, and the file; raise ConfigError if it is named wrongly."""
    rest: list[str] = []
    files: list[str] = []

    # an iterator, since --config takes the word behind it too
    left = iter(lines)
    for line in left:
        name, equals, value = line.partition("=")
        if name == SWITCH:
            files.append(value if equals else next(left, ""))
        elif not equals and line.lower().endswith(_SUFFIXES):
            raise ConfigError(
                f"{line} alone says nothing: a file of options is given as {_typed(line)}, ML-Agents' own "
                f"configuration as mappo-learn {shell_word(line)}"
            )
        else:
            rest.append(line)

    if len(files) > 1:
        raise ConfigError(f"{SWITCH} is given {len(files)} times ({', '.join(files)}): one file is taken")
    if files and not files[0]:
        raise ConfigError(f"{SWITCH} names no file: {_typed('my.yaml')}")

    if files and last_value(rest, "resume") is not None:
        raise ConfigError(
            f"{SWITCH} and resume cannot go together: a run is resumed with the options in its own "
            "config.yaml; give those that change as option=value"
        )

    return rest, Path(files[0]) if files else None


def file_root(path: Path, lines: list[str]) -> dict[Any, Any]:
    """Return what Hydra starts from: conf/config.yaml with the file's options on top of its presets.

    A recipe of the command line wins over the file, one of the file itself does not. Raises ConfigError.
    """
    options, choices = _read(path)
    root: Any = OmegaConf.to_container(OmegaConf.load(presets.conf_dir() / "config.yaml"))
    entries = [_chosen(entry, choices) for entry in root.pop("defaults")]

    own_env = options.get("env", {}).get("name")
    chosen = last_value(lines, "env")
    if chosen is not None and own_env is not None and chosen != own_env:
        raise ConfigError(
            f"env={chosen} differs from env.name={own_env} in {path}: leave one of them out "
            "(without env.name the file's other options go with any env)"
        )

    # _self_ stands for the file's options: what comes behind it wins over them
    if last_value(lines, "recipe") is not None:
        entries.remove("_self_")
        entries.insert(1 + [_group(entry) for entry in entries].index("env"), "_self_")
    entries.insert(entries.index("_self_"), CLEARED)

    return {"defaults": entries, **root, **options}


def cleared(root: dict[Any, Any]) -> dict[str, Any]:
    """Return what lies right below a file's options: null for each parameter that they give as a whole.

    Hydra would mix the keys of its sampler or lessons with those of a preset.
    """
    params = root.get("env", {}).get("params", {})
    return {"env": {"params": {name: None for name, raw in params.items() if is_whole(raw)}}}


def read_yaml(path: Path, missing: str | None = None) -> Any:
    """Return what a YAML file holds; raise ConfigError where it cannot be read.

    Args:
        missing: the message where there is no such file; None: as for any that cannot be read.
    """
    try:
        return OmegaConf.to_container(OmegaConf.load(path))
    except Exception as error:  # whatever a damaged file makes YAML raise
        if missing is not None and isinstance(error, FileNotFoundError):
            raise ConfigError(missing) from error
        raise ConfigError(f"{path} cannot be read ({' '.join(str(error).split())})") from error


def _read(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return a file's options, nested, and the presets that it chooses."""
    saved = read_yaml(path, missing=f"{_typed(path)}: there is no such file")
    if not isinstance(saved, dict) or not saved:
        raise ConfigError(
            f"{path} holds no options: it must be YAML such as a run's config.yaml, ppo: {{lr: 1e-4}}"
        )

    saved = rename_keys(saved)
    if saved.pop("resume", None) is not None:
        raise ConfigError(f"{path}: resume belongs on the command line, mappo-train resume=RUN")

    try:
        # a group's name with a text chooses a preset, with a section it sets options
        choices = {group: _choice(group, saved.pop(group)) for group in _CHOICES if _is_name(saved, group)}

        # keys may be nested or dotted (ppo.lr): both end up nested
        tree = OmegaConf.create({})
        for key, value in saved.items():
            check_value(str(key), value, Config)
            OmegaConf.update(tree, str(key), value, merge=True)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error

    options: Any = OmegaConf.to_container(tree)

    # env.name alone chooses its preset too, if there is one of that name
    name = options.get("env", {}).get("name")
    if name in presets.group_choices()["env"]:
        choices.setdefault("env", name)

    return options, choices


def _is_name(saved: dict[Any, Any], group: str) -> bool:
    return group in saved and not isinstance(saved[group], dict)


def _choice(group: str, name: Any) -> str:
    known = presets.group_choices()[group]
    if name is None and presets.NO_CHOICE in known:
        return presets.NO_CHOICE
    if name not in known:
        raise ConfigError(f"{group}={name} does not exist; choices: {', '.join(known)}")
    return str(name)


def _group(entry: Any) -> str:
    return next(iter(entry)) if isinstance(entry, dict) else str(entry)


def _chosen(entry: Any, choices: dict[str, str]) -> Any:
    group = _group(entry)
    return {group: choices[group]} if group in choices else entry


def _typed(path: str | Path) -> str:
    return f"mappo-train {SWITCH} {shell_word(path)}"
