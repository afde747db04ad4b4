"""The options of a run that is there: to resume it, or to play what was trained in it.

The module of env.factory may lie where the run found it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mappo_unity.config.compose import check_effect, compose_config, load_config
from mappo_unity.config.option_table import show_value
from mappo_unity.config.overrides import last_value, parse
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Config
from mappo_unity.config.text_lines import quoted
from mappo_unity.config.user_modules import look_in
from mappo_unity.errors import ConfigError
from mappo_unity.runs.folder import CONFIG, factory_folder, find_run


def compose_resumed(lines: list[str], base: Path) -> Config:
    """Compose the options of a run that is resumed: its config.yaml, then overrides; raise ConfigError.

    What says which run it is (env, env.name, the folders) cannot be overridden.
    """
    saved = load_config(base)

    chosen = last_value(lines, "env")
    if chosen is not None and chosen != saved.env.name:
        raise ConfigError(
            f"env={chosen} differs from the run's env={saved.env.name}: a run is resumed in its own env; "
            "leave env out, or start a new run without resume"
        )

    # The same env given again is no change; its preset must not come on top of what was saved.
    rest = [line for line in lines if parse([line])[0].key_or_group != "env"]
    for key in ("env.name", "output_dir", "hydra.run.dir"):
        if last_value(rest, key) is not None:
            raise ConfigError(
                f"{key} cannot change with resume: a run is resumed in its own folder {base.parent}"
            )

    config = compose_config(rest, base).config
    # The values are compared: the same seed given again is no change.
    if config.seed != saved.seed:
        raise ConfigError(
            f"seed={config.seed} cannot change with resume: the run has seed={saved.seed}, and its random "
            "numbers go on where they were; leave seed out, or start a new run without resume"
        )

    if config.bc.only != saved.bc.only:
        raise ConfigError(
            f"bc.only={show_value(config.bc.only)} cannot change with resume: the run has "
            f"bc.only={show_value(saved.bc.only)}; a new run can begin with its networks, "
            f"init_from={base.parent}"
        )

    check_effect(rest, [config])
    if config.env.factory is not None:
        look_in(factory_folder(base.parent), config.env.factory, base.parent)

    return config


def config_to_play(run: Path, env: str | None, params: Sequence[str] = ()) -> Config:
    """Return the options of the environment in which a run or an ONNX file is played; raise ConfigError.

    `env` names a preset; without it it is that of the run's folder, or of the one the file lies in. Then the
    module of env.factory may also lie where the run found it. `params`: lines such as env.params.mass=2.
    """
    if env is not None:
        return compose_config([f"env={quoted(env)}", *params]).config

    try:
        folder = find_run(run, "run")
        config = load_config(folder / CONFIG)
    except ConfigError as error:
        # A file of a policy can be played without its run, once the environment is named.
        if not run.is_file() and not list(run.glob("*.onnx")):
            raise
        choices = ", ".join(group_choices()["env"])
        raise ConfigError(f"{error}; or say in which environment to play it: env=NAME ({choices})") from error

    if params:
        config = compose_config(list(params), folder / CONFIG).config
    if config.env.factory is not None:
        look_in(factory_folder(folder), config.env.factory, folder)
    # what its players noted while it trained stays
    return replace(config, env=replace(config.env, player_logs=None))
