"""Which options of the environment have an effect with which backend.

In: the options that were given, the configurations they led to. Out: nothing, or a `ConfigError`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.schema import Backend, Config, EnvConfig
from mappo_unity.errors import ConfigError

_STARTED = (Backend.player, Backend.registry)
_UNITY = (Backend.player, Backend.editor, Backend.registry)
_NEEDED = {
    "num_areas": (Backend.embedded, *_UNITY),
    "factory": (Backend.custom,),
    "file_name": (Backend.player,),
    "registry": (Backend.registry,),
    "registry_entry": (Backend.registry,),
    "num_players": _STARTED,
    "max_restarts": _UNITY,
    "timeout_s": _UNITY,
    "port": (Backend.editor,),
    "time_scale": _UNITY,
    "quality_level": _UNITY,
    "screen_width": _UNITY,
    "screen_height": _UNITY,
    "target_frame_rate": _UNITY,
    "no_graphics": _STARTED,
    "player_args": _STARTED,
    "player_logs": _STARTED,
}
"""Options of env that other backends do not look at; those of any backend are not here."""


def check_effect(given: Iterable[str], configs: list[Config]) -> None:
    """Refuse options that none of the configurations has a use for.

    Args:
        given: full names of the options on the command line.
        configs: what came of it, one a run; the jobs of a sweep may differ in their backends.

    Raises:
        ConfigError: naming the backends that look at the option.
    """
    backends = list(dict.fromkeys(config.env.backend for config in configs))
    for key in given:
        section, _, name = key.partition(".")
        needed = _NEEDED.get(name) if section == "env" else None
        if needed is None or set(needed) & set(backends):
            continue
        default = getattr(EnvConfig(), name)
        for value in (getattr(config.env, name) for config in configs):
            if value != default:
                raise ConfigError(_message(key, value, backends, needed))


def _message(key: str, value: Any, backends: list[Backend], needed: tuple[Backend, ...]) -> str:
    chosen = " and ".join(backend.value for backend in backends)
    names = [backend.value for backend in needed]
    wanted = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
    cure = "; give what the factory takes as env.params.NAME=..." if key == "env.num_areas" else ""
    return (
        f"{key}={show_value(value)} has no effect with env.backend={chosen}: "
        f"it needs env.backend={wanted}; or leave it out{cure}"
    )
