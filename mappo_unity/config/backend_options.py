"""Which options of the environment have an effect with which backend."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.schema import BACKENDS, Backend, Config, EnvConfig
from mappo_unity.errors import ConfigError


def check_effect(given: Iterable[str], configs: list[Config]) -> None:
    """Refuse options that none of the configurations has a use for.

    Args:
        given: full names of the options on the command line.
        configs: what came of it, one a run; the jobs of a sweep may differ in their backends.

    Raises:
        ConfigError: naming the backends that look at the option.
    """
    backends = list(dict.fromkeys(config.env.backend for config in configs))
    looked_at = {item.name: item.metadata.get(BACKENDS) for item in fields(EnvConfig)}

    for key in given:
        section, _, name = key.partition(".")
        needed = looked_at.get(name) if section == "env" else None
        if needed is None or set(needed) & set(backends):
            continue

        # giving the default changes nothing, so it is no mistake with any backend
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
