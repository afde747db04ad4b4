"""What a preset or a run that is resumed has, and the file does not name: the file rules there, too."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

import yaml

from mappo_unity.config.behavior_lines import dotted_options, written
from mappo_unity.config.compose import compose_tree
from mappo_unity.config.mlagents.behavior import learner_options, nested, values_of
from mappo_unity.config.mlagents.resolved import resolved
from mappo_unity.config.mlagents.settings import Settings
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError

_PARAMETERS, _BEHAVIORS = "env.params", "behaviors"
_DELETABLE = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")


def check_named(settings: Settings, config: Config, own: list[str]) -> None:
    """Refuse behaviors that are in a run's options only since the scene's preset names them.

    Args:
        settings: the file and the flags.
        config: the options of a new run.
        own: options of the command line, which may name behaviors, too.

    Raises:
        ConfigError: naming them, as ML-Agents refuses behaviors that have no section.
    """
    missing = [
        name
        for name in config.behaviors
        if name not in settings.behaviors and not _is_given(f"{_BEHAVIORS}.{name}", own)
    ]
    if config.only_named_behaviors and missing:
        raise ConfigError(
            f"the environment has {', '.join(missing)}, which the file does not name: give "
            f"{', '.join(f'{_BEHAVIORS}.{name}' for name in missing)} there, or default_settings"
        )


def lines_over(
    settings: Settings,
    before: Mapping[str, Any],
    saved: Config,
    own: list[str],
    tell: Callable[[str], None],
) -> list[str]:
    """Return lines with which a changed file rules over what a resumed run has and its lines do not name.

    What the command line gave the run stays as long as the file is the same.

    Args:
        settings: the file and the flags.
        before: the settings that the run had (`resolved`); empty: they are not known.
        saved: the run's own options.
        own: options of the command line.
        tell: takes a line for the user about each environment parameter that the run loses, or keeps.
    """
    if not settings.behaviors and settings.default is not None and not settings.default.given:
        return []  # there is no file

    lines = []
    now = yaml.safe_load(yaml.safe_dump(resolved(settings)))  # as it is read
    is_changed = bool(before) and any(before.get(key) != now[key] for key in (_BEHAVIORS, "default_settings"))
    # lines name what differs from the options of all: what differs no longer would stay as it was
    learners = dict(_learners(settings, saved)) if is_changed else {}
    if learners:
        lines.append(f"{_BEHAVIORS}={written(learners)}")

    were_named = before.get("environment_parameters") or {}
    for name in _dropped_parameters(settings, were_named, saved, own):
        is_gone = _DELETABLE.fullmatch(name) is not None
        if is_gone:
            lines.append(f"~{_PARAMETERS}.{name}")
        end = "goes on without it" if is_gone else "keeps it, since no override can take such a name away"
        tell(f"{_PARAMETERS}.{name} stands neither in the file nor among the options: the run {end}")
    return lines


def _learners(settings: Settings, saved: Config) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield each behavior's options that the saved run has for it alone, nested, with the file's values."""
    for name, tree in saved.behaviors.items():
        section = settings.behaviors.get(name, settings.default)
        if section is not None:
            values = values_of(learner_options(name, section))
            values.pop("init_from", None)  # a resumed run has its own networks
            held = {key: value for key, value in values.items() if _holds(tree, key)}
            if held:
                yield name, nested(held)


def _dropped_parameters(
    settings: Settings, were_named: Collection[str], saved: Config, own: list[str]
) -> list[str]:
    """Return the environment parameters that the file named, and file, options and preset name no more."""
    names = [
        name
        for name in saved.env.params
        if name in were_named
        and name not in settings.parameters
        and not _is_given(f"{_PARAMETERS}.{name}", own)
    ]
    if not names:  # composing a preset takes a while
        return []

    preset = [line for line in own if line.startswith("parameters=")]
    if saved.env.name in group_choices()["env"]:  # env.name may be any name
        preset.append(f"env={saved.env.name}")
    known = compose_tree(preset).env.params
    return [name for name in names if name not in known]


def _is_given(option: str, lines: list[str]) -> bool:
    """Return whether lines set an option or one below it, or delete it."""
    names = [name for line in lines for name in dotted_options(line.lstrip("+~"))]
    return any(name == option or name.startswith(f"{option}.") for name in names)


def _holds(tree: Any, key: str) -> bool:
    for part in key.split("."):
        if not isinstance(tree, Mapping) or part not in tree:
            return False
        tree = tree[part]
    return True
