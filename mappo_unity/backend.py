"""Options to a running BaseEnv.

In: `EnvConfig`. Out: a function ``seed -> BaseEnv``. The only module that knows what runs an
environment; must not know TorchRL.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mlagents_envs.base_env import BaseEnv

from mappo_unity.config import Backend, ConfigError, EnvConfig

MakeEnv = Callable[[int], BaseEnv]


def make_env_function(cfg: EnvConfig) -> MakeEnv:
    """Return the function that opens the environment for a seed.

    Raises:
        ConfigError: the options name nothing that can be opened.
    """
    return {Backend.embedded: _embedded, Backend.custom: _custom}[cfg.backend](cfg)


def _embedded(cfg: EnvConfig) -> MakeEnv:
    from mappo_unity.scenes import make_scene

    params = dict(cfg.params)
    if cfg.num_areas is not None:
        params["num_areas"] = cfg.num_areas
    return lambda seed: make_scene(cfg.name, seed=seed, **params)


def _custom(cfg: EnvConfig) -> MakeEnv:
    factory = _load_factory(str(cfg.factory))

    def make(seed: int) -> BaseEnv:
        try:
            env = factory(seed=seed, **cfg.params)
        except TypeError as error:
            raise ConfigError(
                f"env.factory={cfg.factory} could not be called as function(seed={seed}, **env.params) with "
                f"env.params={dict(cfg.params)}: {error}"
            ) from error
        if not isinstance(env, BaseEnv):
            raise ConfigError(
                f"env.factory={cfg.factory} returned a {type(env).__name__}; it must return a "
                "mlagents_envs.base_env.BaseEnv"
            )
        return env

    return make


def _load_factory(path: str) -> Callable[..., Any]:
    module_name, _, function_name = path.partition(":")
    if str(Path.cwd()) not in sys.path:  # as `python -m` does: modules beside the user count
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(
            f"env.factory={path}: module {module_name!r} cannot be imported: {error}"
        ) from error
    function = getattr(module, function_name, None)
    if not callable(function):
        names = sorted(n for n, v in vars(module).items() if callable(v) and not n.startswith("_"))
        raise ConfigError(
            f"env.factory={path}: {module_name} has no function {function_name!r}; it has {names}"
        )
    return function
