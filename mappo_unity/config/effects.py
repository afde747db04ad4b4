"""Which options have an effect: those of the environment with a backend, those of a teacher that is on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from operator import attrgetter
from typing import Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.schema import BACKENDS, Backend, Config, Engine, EnvConfig
from mappo_unity.errors import ConfigError


def check_effect(given: Iterable[str], configs: list[Config]) -> None:
    """Refuse options that none of the configurations has a use for.

    Args:
        given: full names of the options on the command line.
        configs: what came of it, one a run; the jobs of a sweep may differ in their backends.

    Raises:
        ConfigError: naming what would look at the option.
    """
    given = list(given)
    _check_backends(given, configs)
    _check_workers(given, configs)
    _check_teachers(given, configs)
    if "log.dashboard_port" in given and not any(config.log.dashboard for config in configs):
        raise ConfigError(
            f"{_shown('log.dashboard_port', configs[0])} has no effect without log.dashboard=true: give it, "
            "or leave the port out"
        )


def _check_backends(given: list[str], configs: list[Config]) -> None:
    backends = list(dict.fromkeys(config.env.backend for config in configs))
    looked_at = {item.name: item.metadata.get(BACKENDS) for item in fields(EnvConfig)}

    for key in given:
        section, _, name = key.partition(".")
        needed = looked_at.get(name) if section == "env" else None
        if needed is None or set(needed) & set(backends):
            continue
        # workers' processes are started again with every backend
        if key == "env.max_restarts" and any(_has_processes(config) for config in configs):
            continue

        # giving the default changes nothing, so it is no mistake with any backend
        default = getattr(EnvConfig(), name)
        for value in (getattr(config.env, name) for config in configs):
            if value != default:
                raise ConfigError(_message(key, value, backends, needed))


def _check_workers(given: list[str], configs: list[Config]) -> None:
    """Refuse options of workers' processes where there are none."""
    if any(_has_processes(config) for config in configs):
        return
    for config in configs:
        asks = config.collect.engine is not Engine.local and not config.collect.workers
        if "collect.timeout_s" in given or ("collect.engine" in given and asks):
            key = "collect.timeout_s" if "collect.timeout_s" in given else "collect.engine"
            raise ConfigError(
                f"{_shown(key, config)} has no effect without processes of workers: give collect.workers=2 "
                "(with collect.engine=processes or ray), or leave it out"
            )


def _has_processes(config: Config) -> bool:
    return config.collect.workers > 0 and config.collect.engine is not Engine.local


def _message(key: str, value: Any, backends: list[Backend], needed: tuple[Backend, ...]) -> str:
    chosen = " and ".join(backend.value for backend in backends)
    names = [backend.value for backend in needed]
    wanted = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
    cure = "; give what the factory takes as env.params.NAME=..." if key == "env.num_areas" else ""

    return (
        f"{key}={show_value(value)} has no effect with env.backend={chosen}: "
        f"it needs env.backend={wanted}; or leave it out{cure}"
    )


def _check_teachers(given: list[str], configs: list[Config]) -> None:
    """Refuse options of reward streams, of their critic and of cloning that nobody learns from."""
    if all(config.bc.only for config in configs):
        for key in given:
            is_idle = key.startswith("rewards.") or key == "ppo.critic_warmup_steps"
            if is_idle and _is_changed(key, configs):
                raise ConfigError(
                    f"{_shown(key, configs[0])} has no effect with bc.only=true, which "
                    "learns from the demonstrations alone; leave one of the two out"
                )

    # whoever gives the switch as well has turned it off on purpose
    for section, switch, example in _SWITCHES:
        if f"{section}.{switch}" in given or any(_is_on(section, switch, config) for config in configs):
            continue
        for key in given:
            if key.startswith(f"{section}.") and _is_changed(key, configs):
                raise ConfigError(
                    f"{_shown(key, configs[0])} has no effect without "
                    f"{section}.{switch}: give {section}.{switch}={example}, or leave it out"
                )


_SWITCHES = (
    *((f"rewards.{stream}", "strength", "0.1") for stream in ("curiosity", "rnd", "gail")),
    ("bc", "demos", "[expert.demo]"),
)
"""Section, the option that turns it on, a value that does."""


def _is_on(section: str, switch: str, config: Config) -> bool:
    """Return whether the section is on for a behavior at least."""
    if _value(f"{section}.{switch}", config):
        return True
    for own in config.behaviors.values():
        for name in (*section.split("."), switch):
            own = own.get(name) if isinstance(own, dict) else None
        if own:
            return True
    return False


def _is_changed(key: str, configs: list[Config]) -> bool:
    return any(_value(key, config) != _value(key, Config()) for config in configs)


def _value(key: str, config: Config) -> Any:
    return attrgetter(key)(config)


def _shown(key: str, config: Config) -> str:
    value = _value(key, config)
    return key if is_dataclass(value) else f"{key}={show_value(value)}"
