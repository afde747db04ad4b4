"""Flags and options that have no effect beside others, or with a run that is resumed or played."""

from __future__ import annotations

from mappo_unity.config.mlagents.environment import resumes
from mappo_unity.config.mlagents.flags import Flags, flag_of
from mappo_unity.config.mlagents.settings import Settings

_FIXED = ("env", "recipe", "seed", "env.num_areas")
_KEPT = ("env_settings.seed", "env_settings.num_areas")
"""Options of a run that a resumed one keeps, and ML-Agents' names of two that have flags."""
_OF_PLAYERS = ("env_settings.num_envs", "env_settings.env_args", "engine_settings.no_graphics")
"""What is said anew with a build, and else kept as well."""


def about_flags(settings: Settings, flags: Flags) -> list[str]:
    """Return lines about flags that have no effect beside others."""
    run, said = settings.run, []
    if run["checkpoint_settings.inference"]:
        ignored = [flag_of(key) for key in flags.given if not key.startswith("checkpoint_")]
        ignored += flags.options
        if flags.config is not None:
            ignored.insert(0, flags.config)
        if ignored:
            said.append(
                f"{', '.join(ignored)}: without effect, --inference plays what the run was trained in"
            )
    elif flags.deterministic:
        said.append("--deterministic has no effect without --inference: training samples its actions")

    if resumes(settings.run) and not run["checkpoint_settings.inference"]:
        fixed = _KEPT if run["env_settings.env_path"] is not None else (*_KEPT, *_OF_PLAYERS)
        kept = [flag_of(key) for key in fixed if key in flags.given]
        kept += [line for line in flags.options if is_kept(line.partition("=")[0].lstrip("+"))]
        if kept:
            said.append(f"{', '.join(kept)}: without effect, a resumed run keeps its own")

    if resumes(settings.run) and run["checkpoint_settings.initialize_from"] is not None:
        where = run.where("checkpoint_settings.initialize_from")
        said.append(f"{where} has no effect: the run is resumed with its own networks")
    return said


def is_kept(name: str) -> bool:
    """Return whether a resumed run keeps its own value of an option; what it begins with is no matter."""
    return name in _FIXED or name.rpartition(".")[2] == "init_from"
