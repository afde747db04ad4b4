"""mappo-learn: train with ML-Agents' configuration and flags."""

from __future__ import annotations

import math
import random
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mappo_unity.config.mlagents import flags as learn_flags
from mappo_unity.config.mlagents.environment import resumes, scene_of
from mappo_unity.config.mlagents.ineffective import about_flags, is_kept
from mappo_unity.errors import ConfigError
from mappo_unity.signals import interrupts_wait

if TYPE_CHECKING:
    from mappo_unity.config.mlagents.settings import Settings
    from mappo_unity.config.mlagents.translate import Translation
    from mappo_unity.config.schema import Config, EnvConfig

_SEEDS = 10_000  # of those that ML-Agents draws where none is given
_MOST_ROLLED_BACK = 4
_PLACES = {"hydra.run.dir": "--run-id=NAME", "output_dir": "--results-dir=FOLDER", "resume": "--resume"}
"""Options of ours that say where a run lies, and the flags that do so here."""
_OF_PLACES = re.compile(r"env\.(backend|port)=")
_OF_SCENES = re.compile(r"env\.(?!params\b)")
"""Lines that say where a run is trained: in a player or the Editor, and in a scene, which has no other."""


def help_text() -> str:
    """Return the text of --help."""
    return learn_flags.help_text()


def run(lines: list[str]) -> int:
    """Train, resume or play as ML-Agents' flags say; return the exit code."""
    from mappo_unity.config.mlagents.read import read_settings
    from mappo_unity.config.mlagents.translate import translate
    from mappo_unity.config.overrides import given_options, shell_word
    from mappo_unity.config.renamed import rename_lines
    from mappo_unity.config.schema import Config
    from mappo_unity.config.text_lines import literal_lines

    flags = learn_flags.parse_flags(lines)
    if flags.help:
        print(help_text())
        return 0
    settings = read_settings(flags)
    translation = translate(settings)
    renamed = rename_lines(flags.options, _tell)
    own = literal_lines(renamed, Config)
    for key in given_options(own):  # its value comes from the command line
        if key in _PLACES:
            raise ConfigError(f"{key} does not go with mappo-learn, whose flag is {_PLACES[key]}")
        translation.forget(key)

    options = [*translation.lines, *own]
    try:
        _composed(options)  # a mistake is the only line that is printed
    except ConfigError as error:
        raise translation.explain(error) from error

    for text in [*translation.warnings, *about_flags(settings, flags)]:
        _tell(text)
    if flags.print_options:
        print(*map(shell_word, options), sep="\n")
        return 0

    folder = _folder(settings)
    if settings.run["checkpoint_settings.inference"]:
        return _play(settings, folder, flags.deterministic)
    return _train(settings, translation, options, folder)


def _composed(lines: list[str]) -> Config:
    """Return the options of a run, those of each behavior checked, too."""
    from mappo_unity.config.compose import compose_config
    from mappo_unity.config.per_behavior import behavior_config

    config = compose_config(lines).config
    for name in config.behaviors:
        behavior_config(config, name)
    return config


def _folder(settings: Settings) -> Path:
    return _run_folder(settings, settings.run["checkpoint_settings.run_id"])


def _run_folder(settings: Settings, name: str, flag: str = "--run-id") -> Path:
    if name in ("", ".", "..") or Path(name).name != name:
        raise ConfigError(f"{flag}={name} must be the name of a folder, without others above it")
    return Path(settings.run["checkpoint_settings.results_dir"]) / name


def _train(settings: Settings, translation: Translation, options: list[str], folder: Path) -> int:
    from mappo_unity.config.mlagents.unnamed import check_named
    from mappo_unity.runs import results

    run = settings.run
    resume, force = resumes(settings.run), run["checkpoint_settings.force"]
    results.bring_back(folder)
    results.check_place(folder, resume, force)
    own = options[len(translation.lines) :]
    lines = _run_lines(settings, translation.lines, own, folder, resume)
    try:
        with interrupts_wait():
            if not resume:
                config = _check(lines)
                check_named(settings, config, own)
                results.check_beginning(folder, config)
        with results.replaced(folder, force and not resume):
            return _launch(settings, lines, folder)
    except ConfigError as error:
        raise translation.explain(error) from error


def _run_lines(
    settings: Settings, translated: list[str], own: list[str], folder: Path, resume: bool
) -> list[str]:
    """Return all lines of a run: below the options where it goes and what it begins with."""
    from mappo_unity.config.overrides import last_value
    from mappo_unity.config.text_lines import quoted_path
    from mappo_unity.runs.results import LOGS

    if resume:
        return _resumed_lines(settings, translated, own, folder)

    options = [*translated, *own]
    lines = [f"hydra.run.dir={quoted_path(folder)}", *_beginning(settings)]
    if settings.run["env_settings.seed"] < 0 and last_value(options, "seed") is None:
        seed = random.SystemRandom().randrange(_SEEDS)
        _tell(f"no seed is given: seed={seed} is drawn")
        lines.append(f"seed={seed}")

    if scene_of(settings) is None and settings.run["env_settings.env_path"] is not None:
        lines.append(f"env.player_logs={quoted_path(folder / LOGS)}")
    return [*lines, *options]


def _resumed_lines(settings: Settings, translated: list[str], own: list[str], folder: Path) -> list[str]:
    """Return all lines of a run that is resumed: without those of which it keeps its own."""
    from mappo_unity.config.compose import load_config
    from mappo_unity.config.mlagents.unnamed import lines_over
    from mappo_unity.config.text_lines import quoted_path
    from mappo_unity.runs.folder import CONFIG
    from mappo_unity.runs.results import read_configuration

    saved = load_config(folder / CONFIG)
    placed = _where_trained(settings, translated, saved.env, folder)
    over = lines_over(settings, read_configuration(folder), saved, own, _tell)

    options = [*placed, *over, *own]
    names = [line.partition("=")[0] for line in options]
    kept = [line for name, line in zip(names, options) if not is_kept(name)]
    return [*kept, f"resume={quoted_path(folder)}"]


def _where_trained(settings: Settings, translated: list[str], env: EnvConfig, folder: Path) -> list[str]:
    """Return the file's lines with those of the place where a run was trained, which goes on there.

    Raises:
        ConfigError: the flags say another scene, or a build where it was a scene.
    """
    from mappo_unity.config.schema import Backend

    is_scene = env.backend is Backend.embedded
    if settings.run["env_settings.env_path"] is None:  # where it was trained, not the Editor
        other = _OF_SCENES if is_scene else _OF_PLACES
        return [line for line in translated if not other.match(line)]

    if scene_of(settings) != (env.name if is_scene else None):
        trained = f"the embedded scene {env.name}" if is_scene else "a build or in the Editor"
        here = f"--env=scene:{env.name}" if is_scene else "leave it out, or name a build"
        where = settings.run.where("env_settings.env_path")
        raise ConfigError(
            f"{where}: the run in {folder} was trained in {trained} and goes on there: {here}, or start "
            f"a run with another --run-id and --initialize-from={folder.name}"
        )

    return [*translated, "env.backend=player"] if env.backend is Backend.editor else translated


def _beginning(settings: Settings) -> list[str]:
    """Return what --initialize-from says: a run of ours, or the ONNX files of one of mlagents-learn."""
    from mappo_unity.config.behavior_lines import written
    from mappo_unity.config.text_lines import quoted_path
    from mappo_unity.runs.folder import CONFIG, runs_below

    name = settings.run["checkpoint_settings.initialize_from"]
    if name is None:
        return []

    source = _run_folder(settings, name, "--initialize-from")
    if (source / CONFIG).is_file():
        return [f"init_from={quoted_path(source)}"]

    files = {behavior: source / f"{behavior}.onnx" for behavior in settings.behaviors}
    if not files or not all(path.is_file() for path in files.values()):
        raise ConfigError(
            f"--initialize-from={name}: {source} holds neither a run nor an ONNX file of each behavior"
            f"{runs_below(source.parent)}"
        )
    starts = {behavior: {"init_from": str(path)} for behavior, path in files.items()}
    return [f"behaviors={written(starts)}"]


def _check(lines: list[str]) -> Config:
    """Find mistakes before a run that is to be replaced is touched; return the options."""
    from mappo_unity.config.compose import check_effect
    from mappo_unity.policies.first_checks import check_environment

    config = _composed(lines)
    check_effect(lines, [config])
    check_environment(config)
    return config


def _launch(settings: Settings, lines: list[str], folder: Path) -> int:
    from mappo_unity.config.mlagents.resolved import resolved
    from mappo_unity.runs import results

    with interrupts_wait():
        from mappo_unity.training.launch import launch
        from mappo_unity.training.run_state import RunState

    policies: list[str] = []

    def look_on(state: RunState) -> None:
        if not policies:
            policies.extend(state.setup.learners)
            results.write_configuration(folder, resolved(settings))

    launched = launch(lines, warn=_tell, after_iteration=look_on)
    outcome = launched.outcome
    if outcome is None:
        print(launched.message)
        _publish(folder, launched.last_checkpoint)
        return 0

    steps = outcome.agent_steps
    print(f"finished: {steps:,} agent steps in {outcome.wall_s:.1f} s, mean return {outcome.return_mean:.4g}")
    _publish(folder, outcome.last_checkpoint, policies, outcome.return_mean)
    print(f"curves: tensorboard --logdir {folder.parent}", flush=True)
    if outcome.signal is None:
        return _MOST_ROLLED_BACK if outcome.status == "diverged" else 0
    name = signal.Signals(outcome.signal).name
    _tell(f"ended by {name}; --resume goes on")
    return 128 + outcome.signal


def _tell(text: str) -> None:
    print(f"mappo-learn: {text}", file=sys.stderr)


def _publish(folder: Path, last: Path | None, policies: Sequence[str] = (), mean: float = math.nan) -> None:
    """Put the last checkpoint's ONNX files where ML-Agents has them; say which, and which older ones stay.

    Without `policies` nothing was trained, and what is published already is left alone.
    """
    from mappo_unity.policies.export import RunExports
    from mappo_unity.runs import results
    from mappo_unity.runs.checkpoint_file import step_of

    if last is None:
        return
    if RunExports(folder, print).is_behind(step_of(last)):
        for path in (folder / f"{policy}.onnx" for policy in policies):
            if path.is_file():
                _tell(f"no ONNX file of {last} was written: {path} is older")
        return

    if policies:
        written = results.publish(folder, last, policies, mean, step_of(last))
    else:
        written = results.publish_late(folder, last)
    for path in written:
        print(f"policy: {path}")


def _play(settings: Settings, folder: Path, deterministic: bool) -> int:
    """Play the run of this name, or that of --initialize-from, without training."""
    from mappo_unity.cli import eval as evaluation
    from mappo_unity.config.text_lines import quoted_path
    from mappo_unity.runs.results import check_playable

    name = settings.run["checkpoint_settings.initialize_from"]
    if name is not None and not resumes(settings.run):
        folder = _run_folder(settings, name)
    check_playable(folder)
    return evaluation.run([f"run={quoted_path(folder)}", f"deterministic={str(deterministic).lower()}"])
