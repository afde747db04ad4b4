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
)
from mappo_unity.config.mlagents.read import Section, Settings
from mappo_unity.config.parameters.values import PLAYERS, read_parameters
from mappo_unity.config.presets import group_choices
from mappo_unity.config.text_lines import quoted_path
from mappo_unity.errors import ConfigError

SCENE = "scene:"
"""Before the name of an embedded scene, in the place of a player's path."""
_MANY = 1_000_000  # checkpoints, where all are to stay
_PLAIN_NAME = re.compile(r"[A-Za-z0-9_-]+")
_SIMPLE = re.compile(r"(?!null$|true$|false$|inf$|nan$)[A-Za-z_][A-Za-z0-9_]*")


@dataclass
class Translation:
    """Option lines, what is to be told about them, and where each option's value comes from."""

    lines: list[str]
    warnings: list[str]
    sources: dict[str, str] = field(default_factory=dict)

    def explain(self, error: ConfigError) -> ConfigError:
        """Return an error about an option with the place that it comes from in front."""
        text = str(error)
        for option, where in self.sources.items():
            if re.match(rf"(behaviors\.[^:]*: )?{re.escape(option)}(=|:| )", text) and "line " in where:
                return ConfigError(f"{where}: {text}")
        return error


def translate(settings: Settings) -> Translation:
    """Return what a configuration is in options of ours.

    The lines name everything that ML-Agents has a value for, on top of ``recipe=mlagents``. Lengths that
    ML-Agents counts for each behavior are added up, since ours count the decisions of all.

    Raises:
        ConfigError: a value that has no meaning here.
    """
    sections = settings.behaviors
    known = list(sections.values()) or [settings.default]  # read_settings: one of the two is there
    behaviors = [section for section in known if section is not None]

    options: Options = {}
    warnings = list(settings.warnings)
    options |= _environment(settings.run, warnings)
    options |= _lengths(behaviors, list(sections), warnings)
    options |= _self_play(behaviors, warnings)
    options |= _learners(sections, settings.default)
    options |= _parameters(settings, warnings)
    for name, section in sections.items():
        warnings += behavior_warnings(name, section)

    lines = [f"{key}={_line_value(key, value)}" for key, (value, _) in options.items()]
    sources = {key: where for key, (_, where) in options.items()}
    return Translation(lines, warnings, sources)


def scene_of(settings: Settings) -> str | None:
    """Return the embedded scene that ``--env=scene:NAME`` names; None: a player or the Editor."""
    path = settings.run["env_settings.env_path"]
    return path[len(SCENE) :] if path is not None and path.startswith(SCENE) else None


def _line_value(key: str, value: Any) -> str:
    if isinstance(value, str) and (key == "env" or _SIMPLE.fullmatch(value)):
        return value
    if key == "env.file_name" or key.rpartition(".")[2] == "init_from":
        return quoted_path(value)
    return written(value)


# --- environment


def _environment(run: Section, warnings: list[str]) -> Options:
    path = run["env_settings.env_path"]
    where = run.where("env_settings.env_path")
    if path is not None and path.startswith(SCENE):
        out = _scene(run, path[len(SCENE) :], where, warnings)
    else:
        out = _unity(run, path, where, warnings)

    for key, reason in _NO_EFFECT.items():
        if key in run.given and run[key] != run.table[key].default:
            warnings.append(f"{run.where(key)} has no effect: {reason}")

    device = run["torch_settings.device"]
    if device is not None:
        if not re.fullmatch(r"cpu|cuda(:[0-9]+)?", device):
            place = run.where("torch_settings.device")
            raise ConfigError(f"{place}: {device} is not supported; choices: cpu, cuda, cuda:N")
        out["device"] = (device, run.where("torch_settings.device"))
    if run["env_settings.seed"] >= 0:
        out["seed"] = (run["env_settings.seed"], run.where("env_settings.seed"))
    return out


def _scene(run: Section, scene: str, where: str, warnings: list[str]) -> Options:
    scenes = [name for name in group_choices()["env"] if name not in ("custom", "unity")]
    if scene not in scenes:
        raise ConfigError(f"{where}: there is no embedded scene {scene!r}; scenes: {', '.join(scenes)}")

    for key in run.given:
        is_players = key.startswith(("engine_settings.", "env_settings.")) and key not in _OF_SCENES
        if is_players and key not in _NO_EFFECT and run[key] != run.table[key].default:
            warnings.append(f"{run.where(key)} has no effect: it is for Unity, and {SCENE}{scene} is embedded")

    out: Options = {"env": (scene, where), "recipe": ("mlagents", "ML-Agents")}
    if run["env_settings.num_areas"] != 1:
        out["env.num_areas"] = (run["env_settings.num_areas"], run.where("env_settings.num_areas"))
    return out


def _unity(run: Section, path: str | None, where: str, warnings: list[str]) -> Options:
    out: Options = {"env": ("unity", where), "recipe": ("mlagents", "ML-Agents")}

    def take(option: str, key: str, change: Callable[[Any], Any] = lambda value: value) -> None:
        out[option] = (change(run[key]), run.where(key))

    if path is None:
        out["env.backend"] = ("editor", where)
        if run["env_settings.num_envs"] > 1:
            raise ConfigError(f"{run.where('env_settings.num_envs')}: more than one needs --env=PATH")
        if "engine_settings.no_graphics" in run.given and run["engine_settings.no_graphics"]:
            warnings.append(f"{run.where('engine_settings.no_graphics')} has no effect in the Editor")
    else:
        out["env.file_name"] = (path, where)
        take("env.num_players", "env_settings.num_envs")
        take("env.no_graphics", "engine_settings.no_graphics")
        take("env.player_args", "env_settings.env_args", lambda value: value or [])
    if run["env_settings.num_areas"] != 1:
        take("env.num_areas", "env_settings.num_areas")

    take("env.timeout_s", "env_settings.timeout_wait")
    take("env.max_restarts", "env_settings.max_lifetime_restarts", lambda n: _MANY if n < 0 else n)
    take("env.screen_width", "engine_settings.width")
    take("env.screen_height", "engine_settings.height")
    take("env.quality_level", "engine_settings.quality_level")
    take("env.time_scale", "engine_settings.time_scale")
    take("env.target_frame_rate", "engine_settings.target_frame_rate")
    return out


_OF_SCENES = ("env_settings.env_path", "env_settings.num_areas", "env_settings.seed")
_NO_EFFECT = {
    "env_settings.base_port": "players get ports that are free; the Editor listens on 5004",
    "env_settings.restarts_rate_limit_n": "restarts are counted over the run, not over a minute",
    "env_settings.restarts_rate_limit_period_s": "restarts are counted over the run, not over a minute",
    "engine_settings.capture_frame_rate": "a player keeps the rate that it was built with",
    "engine_settings.no_graphics_monitor": "players draw all, or with no_graphics none",
    "debug": "messages are the same with and without it",
    "checkpoint_settings.load_model": "it is an old spelling, --resume goes on with a run",
    "checkpoint_settings.train_model": "training is what there is without --inference",
}


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

    kept = [_MANY if section["keep_checkpoints"] <= 0 else section["keep_checkpoints"] for section in behaviors]
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

    def change(section: Section) -> int:
        given = section["self_play.team_change"]
        return 5 * section["self_play.save_steps"] if given is None else given

    out: Options = {
        "self_play.save_steps": total("save_steps", lambda section: section["self_play.save_steps"]),
        "self_play.team_change": total("team_change", change),
        "self_play.swap_steps": total("swap_steps", lambda section: section["self_play.swap_steps"]),
        "self_play.num_opponents": (1, "ML-Agents"),
    }
    for key in ("window", "play_against_latest_model_ratio", "initial_elo"):
        values = [section[f"self_play.{key}"] for section in playing]
        if len(set(values)) > 1:
            warnings.append(f"{first.where(f'self_play.{key}')} differs between behaviors: {values[0]} is taken")
        out[f"self_play.{key}"] = (values[0], first.where(f"self_play.{key}"))
    return out


# --- learners


def _learners(sections: dict[str, Section], default: Section | None) -> Options:
    """Return what all behaviors share, and what each has of its own."""
    own = {name: learner_options(name, section) for name, section in sections.items()}
    # what the file does not name has the default's, or there is none of it
    common = learner_options("default_settings", default) if default is not None else {}
    if not common:
        first = next(iter(own.values()))
        common = {k: v for k, v in first.items() if all(o.get(k, (None,))[0] == v[0] for o in own.values())}

    out: Options = dict(common)
    trees: dict[str, Any] = {}
    for name, options in own.items():
        differing = {key: v for key, v in options.items() if key not in common or common[key][0] != v[0]}
        if _PLAIN_NAME.fullmatch(name) and differing:
            out |= {f"behaviors.{name}.{key}": value for key, value in differing.items()}
        else:  # a name with dots and the like, or a behavior that is only named
            trees[name] = _tree(differing)
    if trees:
        out["behaviors"] = (trees, "behaviors")
    out["only_named_behaviors"] = (default is None, "behaviors")
    return out


def _tree(options: Options) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for key, (value, _) in options.items():
        inside = tree
        *above, last = key.split(".")
        for part in above:
            inside = inside.setdefault(part, {})
        inside[last] = value
    return tree


# --- environment parameters


def _parameters(settings: Settings, warnings: list[str]) -> Options:
    out: Options = {}
    for name, given in settings.parameters.items():
        value = given.value
        warnings += _about_lessons(given.where, value)
        try:
            read_parameters({name: value}, PLAYERS)
        except ConfigError as error:
            rest = str(error).removeprefix(f"env.params.{name}")
            raise ConfigError(f"{given.where}{rest}") from error
        out[f"env.params.{name}"] = (value, given.where)
    return out


def _about_lessons(where: str, value: Any) -> Iterator[str]:
    lessons = value.get("curriculum") if isinstance(value, dict) else None
    if not isinstance(lessons, list):
        return
    for lesson in lessons[:-1]:
        criteria = lesson.get("completion_criteria") if isinstance(lesson, dict) else None
        if isinstance(criteria, dict) and "behavior" not in criteria:
            raise ConfigError(f"{where}: a lesson's completion_criteria have no behavior, which they need")
    if lessons and isinstance(lessons[-1], dict) and "completion_criteria" in lessons[-1]:
        yield f"{where}: the completion_criteria of the last lesson have no effect"
