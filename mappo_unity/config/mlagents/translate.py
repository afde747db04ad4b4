"""From ML-Agents' settings to option lines of mappo-train: one pure function, `translate`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from mappo_unity.config.behavior_lines import written
from mappo_unity.config.mlagents.behavior import (
    Options,
    behavior_warnings,
    checkpoint_interval,
    learner_options,
    nested,
    team_change,
    values_of,
)
from mappo_unity.config.mlagents.environment import MANY, environment_options
from mappo_unity.config.mlagents.settings import Section, Settings, as_number
from mappo_unity.config.parameters.values import PLAYERS, read_parameters
from mappo_unity.config.text_lines import quoted_path
from mappo_unity.errors import ConfigError

_PLAIN_NAME = re.compile(r"[A-Za-z0-9_-]+")
_WORDS = ("name", "behavior", "measure", "sampler_type")  # keys of environment_parameters that are texts
_WHOLE = ("min_lesson_length", "seed")  # and those that are whole numbers
_PARAMETERS = "env.params."
_OF_SCENE = re.compile(r"scene \S+ has no parameter '(.*?)';|parameter (.*?)(?:=.*?)? of scene ")
"""What scenes say of a parameter, which they know without the option's sections before it."""
_SIMPLE = re.compile(r"(?!null$|true$|false$|inf$|nan$)[A-Za-z_][A-Za-z0-9_]*")


@dataclass
class Translation:
    """Option lines, what is to be told about them, and where each option's value comes from."""

    lines: list[str]
    warnings: list[str]
    sources: dict[str, str] = field(default_factory=dict)
    places: Callable[[str, str], str] = lambda name, rest: ""
    """See `Settings.places`."""

    def forget(self, key: str) -> None:
        """Take note that the command line gives an option, or a part of an environment parameter."""
        for name in [name for name in self.sources if name.startswith(_PARAMETERS)]:
            if f"{key}.".startswith(f"{name}.") or f"{key}." == _PARAMETERS:
                del self.sources[name]
        self.sources.pop(key, None)

    def explain(self, error: ConfigError) -> ConfigError:
        """Return an error about an option with the place that it comes from in front."""
        text = self._with_place(str(error))
        if text is None:
            return error
        told = ConfigError(text)
        told.details = error.details
        return told

    def _with_place(self, text: str) -> str | None:
        about = _OF_SCENE.match(text)
        for name in [key.removeprefix(_PARAMETERS) for key in self.sources if key.startswith(_PARAMETERS)]:
            if about is not None and name in about.groups():
                return f"{self.places(name, '')}: {text}"
            rest = text.removeprefix(f"{_PARAMETERS}{name}")
            if rest != text and rest[:1] in (".", "["):  # a key of the parameter, or one of its lessons
                return f"{self.places(name, rest)}{rest}"

        behavior = re.match(r"(behaviors\..+?\.)\w+: ", text)
        start, own = (behavior.end(), behavior[1]) if behavior else (0, "")
        option = re.match(r"[\w.]+", text[start:])

        # what behaviors share stands at the top, under its own name
        names = [] if option is None else [own + option[0], option[0]]
        where = next((self.sources[name] for name in names if name in self.sources), "")
        rest = text.removeprefix(where.rpartition(": ")[2] + ": ")
        return f"{where}: {rest}" if "line " in where else None


def translate(settings: Settings) -> Translation:
    """Return what a configuration is in options of ours.

    The lines name everything that ML-Agents has a value for, on top of ``recipe=mlagents``. Lengths that
    ML-Agents counts for each behavior are added up, since ours count the decisions of all.

    Raises:
        ConfigError: a value that has no meaning here.
    """
    sections = settings.behaviors
    behaviors = list(sections.values())
    if not behaviors and settings.default is not None:  # read_settings: one of the two is there
        behaviors = [settings.default]

    options: Options = {}
    warnings = list(settings.warnings)
    options |= environment_options(settings.run, warnings)
    options |= _lengths(behaviors, list(sections), warnings)
    options |= _self_play(behaviors, warnings)
    learners, sources = _learners(sections, settings.default)
    options |= learners
    options |= _parameters(settings, warnings)
    for section in behaviors:
        warnings += behavior_warnings(section)

    lines = [f"{key}={_line_value(key, value)}" for key, (value, _) in options.items()]
    sources |= {key: where for key, (_, where) in options.items()}
    sources |= {f"behaviors.{name}": section.place for name, section in sections.items()}
    sources |= {f"{_PARAMETERS}{name}": given.where for name, given in settings.parameters.items()}
    # what default_settings gives is told once, not for each behavior
    return Translation(lines, list(dict.fromkeys(warnings)), sources, settings.places)


def _line_value(key: str, value: Any) -> str:
    if isinstance(value, str) and (key == "env" or _SIMPLE.fullmatch(value)):
        return value
    if isinstance(value, str) and (key == "env.file_name" or key.rpartition(".")[2] == "init_from"):
        return quoted_path(value)
    return written(value)


# --- what counts for all behaviors


def _lengths(behaviors: list[Section], names: list[str], warnings: list[str]) -> Options:
    def total(key: str) -> tuple[int, str]:
        return sum(section[key] for section in behaviors), behaviors[0].where(key)

    if len(behaviors) > 1:
        warnings.append(
            f"{', '.join(names)} learn in one run: their max_steps, buffer_size, checkpoint_interval and the "
            "steps of self_play are added up, since ours count the decisions of all"
        )

    frequencies = {section["summary_freq"] for section in behaviors}
    if len(frequencies) > 1:
        warnings.append(f"summary_freq differs: all behaviors have the smallest, {min(frequencies)}")

    kept = [
        MANY if section["keep_checkpoints"] <= 0 else section["keep_checkpoints"] for section in behaviors
    ]
    return {
        "max_steps": total("max_steps"),
        "collect.batch_size": total("hyperparameters.buffer_size"),
        "checkpoint_interval": (
            sum(checkpoint_interval(section) for section in behaviors),
            behaviors[0].where("checkpoint_interval"),
        ),
        "keep_checkpoints": (max(kept), behaviors[0].where("keep_checkpoints")),
        "log.tags": ("mlagents", "ML-Agents"),
        "log.summary_freq": (min(frequencies), behaviors[0].where("summary_freq")),
    }


def _self_play(behaviors: list[Section], warnings: list[str]) -> Options:
    playing = [section for section in behaviors if section.has("self_play")]
    if not playing:
        return {"self_play.save_steps": (None, "self_play")}
    if len(playing) < len(behaviors):
        warnings.append("self_play is given for some behaviors only: all with two sides have it here")

    first = playing[0]

    def total(key: str, count: Callable[[Section], int]) -> tuple[int, str]:
        return sum(count(section) for section in playing), first.where(f"self_play.{key}")

    out: Options = {
        "self_play.save_steps": total("save_steps", lambda section: section["self_play.save_steps"]),
        "self_play.team_change": total("team_change", team_change),
        "self_play.swap_steps": total("swap_steps", lambda section: section["self_play.swap_steps"]),
        "self_play.num_opponents": (1, "ML-Agents"),
    }
    for key in ("window", "play_against_latest_model_ratio", "initial_elo"):
        values = [section[f"self_play.{key}"] for section in playing]
        if len(set(values)) > 1:
            warnings.append(
                f"{first.where(f'self_play.{key}')} differs between behaviors: {values[0]} is taken"
            )
        out[f"self_play.{key}"] = (values[0], first.where(f"self_play.{key}"))
    return out


# --- learners


def _learners(sections: dict[str, Section], default: Section | None) -> tuple[Options, dict[str, str]]:
    """Return what all behaviors share, and what each has of its own; and where what lies in it comes from."""
    own = {name: learner_options(name, section) for name, section in sections.items()}
    # what the file does not name has the default's, or there is none of it
    common = learner_options("default_settings", default) if default is not None else {}
    if not common:
        first = next(iter(own.values()))
        common = {k: v for k, v in first.items() if all(o.get(k, (None,))[0] == v[0] for o in own.values())}

    out: Options = dict(common)
    trees: dict[str, Any] = {}
    sources: dict[str, str] = {}
    for name, options in own.items():
        if "init_from" in common and "init_from" not in options:  # init_path: null
            options["init_from"] = (None, sections[name].where("init_path"))
        differing = {key: v for key, v in options.items() if key not in common or common[key][0] != v[0]}
        if _PLAIN_NAME.fullmatch(name) and differing:
            out |= {f"behaviors.{name}.{key}": value for key, value in differing.items()}
        else:  # a name with dots and the like, or a behavior that is only named
            trees[name] = nested(values_of(differing))
            sources |= {f"behaviors.{name}.{key}": where for key, (_, where) in differing.items()}
    if trees:
        out["behaviors"] = (trees, "behaviors")
    out["only_named_behaviors"] = (default is None, "behaviors")
    return out, sources


# --- environment parameters


def _parameters(settings: Settings, warnings: list[str]) -> Options:
    out: Options = {}
    others: dict[str, Any] = {}
    for name, given in settings.parameters.items():
        value = _with_numbers(given.value)
        warnings += _about_lessons(given.where, value)
        try:
            read_parameters({name: value}, PLAYERS)
        except ConfigError as error:
            rest = str(error).removeprefix(f"env.params.{name}")
            raise ConfigError(f"{settings.places(name, rest)}{rest}") from error
        if _PLAIN_NAME.fullmatch(name):
            out[f"env.params.{name}"] = (value, given.where)
        else:  # a name with dots and the like
            others[name] = value
    if others:
        out["env.params"] = (others, "environment_parameters")
    return out


def _with_numbers(value: Any, key: str = "") -> Any:
    """Return a parameter's value with numbers for texts such as 1e-3, which YAML takes for no number."""
    if isinstance(value, dict):
        return {name: _with_numbers(item, str(name)) for name, item in value.items()}
    if isinstance(value, list):
        return [_with_numbers(item, key) for item in value]
    if key in _WORDS or not isinstance(value, str | float):
        return value

    number = as_number(value)
    if number is None:
        return value
    return int(number) if key in _WHOLE and number.is_integer() else number


def _about_lessons(where: str, value: Any) -> Iterator[str]:
    lessons = value.get("curriculum") if isinstance(value, dict) else None
    if not isinstance(lessons, list):
        return
    for lesson in lessons[:-1]:
        criteria = lesson.get("completion_criteria") if isinstance(lesson, dict) else None
        if isinstance(criteria, dict) and "behavior" not in criteria:
            raise ConfigError(f"{where}: a lesson's completion_criteria have no behavior, which they need")
    last = lessons[-1] if lessons else None
    if isinstance(last, dict) and last.get("completion_criteria") is not None:
        yield f"{where}: the completion_criteria of the last lesson have no effect"
