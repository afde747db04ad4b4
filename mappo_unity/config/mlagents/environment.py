"""Where a run plays: an embedded scene, Unity players or the Editor (env_settings, engine_settings)."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from mappo_unity.config.mlagents.behavior import Options
from mappo_unity.config.mlagents.settings import Section, Settings
from mappo_unity.config.presets import group_choices
from mappo_unity.errors import ConfigError

SCENE = "scene:"
"""Before the name of an embedded scene, in the place of a player's path."""
_NO_SCENES = ("custom", "pettingzoo", "unity")
"""Presets whose environment is the user's own."""
MANY = 1_000_000
"""What stands for no limit."""


def scene_of(settings: Settings) -> str | None:
    """Return the embedded scene that ``--env=scene:NAME`` names; None: a player or the Editor."""
    path = settings.run["env_settings.env_path"]
    return path[len(SCENE) :] if path is not None and path.startswith(SCENE) else None


def resumes(run: Section) -> bool:
    """Return whether a run is resumed: --initialize-from beats a file that says both, or resume alone."""
    starts = run.given.get("checkpoint_settings.initialize_from")
    by_file = run.where("checkpoint_settings.resume") != "--resume"
    if starts is not None and starts.where == "--initialize-from" and by_file:
        return False
    return bool(run["checkpoint_settings.resume"])


def environment_options(run: Section, warnings: list[str]) -> Options:
    """Return the options of env, the device and the seed; adds to `warnings`; raises ConfigError."""
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
    scenes = [name for name in group_choices()["env"] if name not in _NO_SCENES]
    if scene not in scenes:
        raise ConfigError(f"{where}: there is no embedded scene {scene!r}; scenes: {', '.join(scenes)}")

    for key in run.given:
        is_players = key.startswith(("engine_settings.", "env_settings.")) and key not in _OF_SCENES
        if is_players and key not in _NO_EFFECT and run[key] != run.table[key].default:
            warnings.append(
                f"{run.where(key)} has no effect: it is for Unity, and {SCENE}{scene} is embedded"
            )

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
        # a run that goes on, or is played, is where it was trained: maybe not in the Editor
        is_new = not (resumes(run) or run["checkpoint_settings.inference"])
        if is_new and run["env_settings.num_envs"] > 1:
            raise ConfigError(f"{run.where('env_settings.num_envs')}: more than one needs --env=PATH")
        if is_new and "engine_settings.no_graphics" in run.given and run["engine_settings.no_graphics"]:
            warnings.append(f"{run.where('engine_settings.no_graphics')} has no effect in the Editor")
    else:
        out["env.file_name"] = (path, where)
        take("env.num_players", "env_settings.num_envs")
        take("env.no_graphics", "engine_settings.no_graphics")
        take("env.player_args", "env_settings.env_args", lambda value: value or [])
    if run["env_settings.num_areas"] != 1:
        take("env.num_areas", "env_settings.num_areas")

    take("env.timeout_s", "env_settings.timeout_wait")
    take("env.max_restarts", "env_settings.max_lifetime_restarts", lambda n: MANY if n < 0 else n)
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
