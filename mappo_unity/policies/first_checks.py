"""What mappo-eval, mappo-play and mappo-export can know about their options before torch is loaded.

A mistake is told in a second instead of many. Only embedded scenes are opened, with a single area, to see
whether the policies fit; other environments would have to be started.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from mappo_unity.config.packages import PER_MEMBER, ExportError, import_package
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Backend, Config, EnvConfig, EvalConfig, ExportConfig, PlayConfig
from mappo_unity.envs.backends import EDITOR_PORT, find_player, make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.policies.layouts import check_layout, check_two_sides
from mappo_unity.policies.onnx_policy import OnnxFolder, OnnxPolicy
from mappo_unity.policies.policy_files import SUFFIX, Kind, Source, check_checkpoint, check_resumable, locate
from mappo_unity.protocol.demos.recording_env import recording_files
from mappo_unity.protocol.ports import check_port
from mappo_unity.runs.folder import CONFIG, find_run
from mappo_unity.runs.options import config_to_play
from mappo_unity.scenes import scene_names
from mappo_unity.scenes.factory import check_factory
from mappo_unity.scenes.mujoco_check import check_mujoco
from mappo_unity.scenes.pettingzoo.opening import check_package

_FILE_ENDING = re.compile(rf"\.(?!{SUFFIX[1:]}$)[A-Za-z][A-Za-z0-9]{{0,3}}")
"""An ending of files other than ONNX files; that of a folder such as exports.v1.2 is none."""


def check_evaluation(cfg: EvalConfig, params: Sequence[str] = ()) -> None:
    """Raise ConfigError if nothing can be evaluated with these options; `params`: see `config_to_play`."""
    check_mujoco()
    sources = [locate(cfg.run, "run")]
    if cfg.opponent is not None:
        sources.append(locate(cfg.opponent, "opponent"))
    known = [open_known(source, cfg.deterministic) for source in sources]

    config = _environment(sources[0], known[0], cfg.env, "mappo-eval", params)
    try:
        check_environment(config)
    except ConfigError as error:
        if cfg.env is not None:
            raise
        file = find_run(sources[0].path, "run") / CONFIG  # mappo-eval takes no env.file_name and the like
        told = ConfigError(f"{error}; so says {file}, where it can be changed")
        told.details = error.details
        raise told from error

    behaviors = behaviors_seen(config.env)
    if behaviors and cfg.opponent is not None:
        check_two_sides(behaviors)
    check_fit(sources, known, behaviors)


def check_film(cfg: PlayConfig) -> None:
    """Raise ConfigError if nothing can be shown with these options; what shows it is looked at elsewhere."""
    option = "run" if cfg.run is not None else "policy"
    source = locate(cfg.run or cfg.policy or "random", option)
    known = open_known(source, cfg.deterministic)

    config = _environment(source, known, cfg.env, "mappo-play")
    check_embedded(config.env)
    check_environment(config)
    behaviors = behaviors_seen(config.env)
    check_fit([source], [known], behaviors)
    if cfg.record is not None:
        recording_files(Path(cfg.record), behaviors)


def check_export(cfg: ExportConfig) -> None:
    """Raise ConfigError if nothing can be exported with these options."""
    if cfg.out is not None:
        check_out(cfg.out)
    check_mujoco()
    check_resumable(Path(cfg.run), "run")
    for package in ("onnx", "onnxruntime"):
        import_package(package)

    # A team of one has no network for each member, whatever share_parameters says.
    known = check_checkpoint(locate(cfg.run, "run"))
    for name, layout in known["layout"].items():
        if layout["team_size"] > 1 and not known["model"][name]["share_parameters"]:
            raise ExportError(PER_MEMBER)


def check_out(out: str) -> None:
    """Raise ConfigError if an export cannot go there: another ending, no place for a file, no permission."""
    path = Path(out)
    wanted = "give a file NAME.onnx, or a folder"

    try:
        is_folder = stat.S_ISDIR(path.stat().st_mode)
        is_file = stat.S_ISREG(path.stat().st_mode)
    except FileNotFoundError:
        if path.is_symlink():
            raise ConfigError(f"out={out} is a symbolic link that leads nowhere: {wanted}") from None
        is_folder = is_file = False
    except NotADirectoryError:
        above = next(folder for folder in path.parents if folder.exists())
        raise ConfigError(f"out={out} cannot be written: {above} is a file, not a folder") from None
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written: {error.strerror}") from error

    if is_file and path.suffix != SUFFIX:
        raise ConfigError(f"out={out} is a file that is there already, of another kind: {wanted}")
    if path.exists() and not is_file and not is_folder:
        raise ConfigError(f"out={out} is neither a file nor a folder, but a device or the like: {wanted}")
    if not path.exists() and _FILE_ENDING.fullmatch(path.suffix) and not out.endswith(("/", os.sep)):
        raise ConfigError(
            f"out={out} does not end in {SUFFIX}: ONNX files do, out={path.with_suffix(SUFFIX)}; a new "
            f"folder of that name is out={out}/"
        )

    # What is not there yet is made in the nearest folder above it that is there.
    folder = next(folder for folder in (path, *path.absolute().parents) if folder.is_dir())
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(f"out={out} cannot be written: no permission to write in the folder {folder}")


def check_environment(config: Config) -> None:
    """Raise ConfigError if the environment of a run cannot be opened: no such factory, player or port."""
    check_mujoco()  # torchrl loads it, whatever the environment is
    if config.env.backend is Backend.pettingzoo:
        check_package()
    check_factory(config.env)
    if config.env.backend is Backend.player:
        find_player(config.env)
    if config.env.backend is Backend.editor:
        check_port(config.env.port or EDITOR_PORT, "env.port")


def check_embedded(env: EnvConfig) -> None:
    """Raise ConfigError if an environment is no embedded scene, which is all that can be drawn."""
    if env.backend is not Backend.embedded:
        raise ConfigError(
            f"mappo-play shows embedded scenes, but this environment has env.backend={env.backend.value}: "
            "look at it in Unity; mappo-eval run=... plays it for its figures"
        )


def open_known(source: Source, deterministic: bool) -> Any:
    """Return what can be known of a policy: a checkpoint's plain values, an ONNX policy, None for chance."""
    if source.kind is Kind.random:
        return None
    if source.kind is Kind.onnx:
        return OnnxPolicy(source.path, deterministic)
    if source.kind is Kind.onnx_folder:
        return OnnxFolder(source.path, deterministic)
    return check_checkpoint(source)


def _environment(
    source: Source, known: Any, env: str | None, command: str, params: Sequence[str] = ()
) -> Config:
    """Return the options of the environment to play in; see `config_to_play`."""
    scenes = [name for name in group_choices()["env"] if name in scene_names()]

    if env is None and (source.kind is Kind.random or not _lies_in_run(source)):
        trained = _trained_in(known)
        example = trained if trained in scenes else "NAME"
        alone = f"has no {CONFIG} of a run beside it, which would say where it plays"
        reason = "plays anywhere" if source.kind is Kind.random else alone
        raise ConfigError(
            f"{source.option}={source.path} {reason}: say in which environment to play it: env={example} "
            f"({', '.join(scenes)})"
        )

    if env in group_choices()["env"] and env not in scenes:
        raise ConfigError(
            f"env={env} needs options of an environment of your own, which {command} does not take: leave "
            "env out and name a run of that environment, or a file in its folder, and its own options count"
        )

    return config_to_play(source.path, env, params)


def _lies_in_run(source: Source) -> bool:
    try:
        find_run(source.path, source.option)
    except ConfigError:
        return False
    return True


def _trained_in(known: Any) -> str | None:
    """Return the environment that a checkpoint or an ONNX file says it was trained in."""
    values = known if isinstance(known, Mapping) else getattr(known, "metadata", {})
    name = values.get("env_name")
    return name if isinstance(name, str) else None


def behaviors_seen(env: EnvConfig) -> Mapping[str, Any]:
    """Return the specs of an embedded scene's behaviors; nothing of others, which are not started here."""
    if env.backend is not Backend.embedded:
        return {}

    # One area is enough to see them.
    scene = make_env_function(replace(env, num_areas=1))(0)
    try:
        scene.reset()
        return dict(scene.behavior_specs)
    finally:
        scene.close()


def check_fit(sources: Iterable[Source], known: Iterable[Any], behaviors: Mapping[str, Any]) -> None:
    for source, policy in zip(sources, known):
        for name, spec in behaviors.items():
            if isinstance(policy, Mapping):
                check_layout(f"{source.option}={source.path}", policy["layout"], name, spec)
            elif policy is not None:
                policy.check(name, spec)
