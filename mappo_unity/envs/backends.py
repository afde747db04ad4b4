"""Options to a running BaseEnv.

In: `EnvConfig`. Out: a function ``seed -> BaseEnv``. The only module that knows what runs an environment
(with `link`, which knows how players are talked to); must not know TorchRL.
"""

from __future__ import annotations

import importlib
import inspect
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from traceback import TracebackException
from typing import Any

from mappo_unity.config.option_table import did_you_mean, with_article
from mappo_unity.config.schema import Backend, ConfigError, EnvConfig, EnvironmentFailure
from mappo_unity.protocol.protobuf import install

install()

from mlagents_envs.base_env import BaseEnv  # noqa: E402

from mappo_unity.envs.user_env import GuardedEnv  # noqa: E402

MakeEnv = Callable[[int], BaseEnv]

EDITOR_PORT = 5004
"""Port on which Unity's Editor looks for a trainer."""
PLAYER_STRIDE = 100_003
"""Player n of several starts from the seed plus n times this (modulo 2^31)."""
OUR_FRAMES = (
    "<frozen importlib",
    str(Path(inspect.getfile(importlib)).parent),
    str(Path(__file__).parents[1]),
)
"""Beginnings of file names in a traceback that say nothing about a user's code."""


def make_env_function(cfg: EnvConfig, log_folder: Path | None = None) -> MakeEnv:
    """Return the function that opens the environment for a seed.

    Args:
        log_folder: where players write their logs, unless env.player_logs says; None: a temporary folder.

    Raises:
        ConfigError: the options name nothing that can be opened.
    """
    if cfg.backend in (Backend.embedded, Backend.custom) and "seed" in cfg.params:
        raise ConfigError(
            f"env.params.seed={cfg.params['seed']}: the environment's seed follows from the run's; use seed=N"
        )
    if cfg.backend is Backend.embedded:
        return _embedded(cfg)
    if cfg.backend is Backend.custom:
        return _custom(cfg)
    return _players(cfg, log_folder)


def _embedded(cfg: EnvConfig) -> MakeEnv:
    from mappo_unity.scenes import make_scene

    params = dict(cfg.params)
    if cfg.num_areas is not None:
        params["num_areas"] = cfg.num_areas
    return lambda seed: make_scene(cfg.name, seed=seed, **params)


def _players(cfg: EnvConfig, log_folder: Path | None) -> MakeEnv:
    from mappo_unity.protocol.client import PlayerOptions, UnityPlayer
    from mappo_unity.protocol.parallel_players import SeveralPlayers
    from mappo_unity.protocol.restarting_player import RestartingPlayer

    executable = find_player(cfg)
    folder = _log_folder(cfg, log_folder)

    def options(number: int) -> PlayerOptions:
        return PlayerOptions(
            executable,
            folder / f"Player-{number}.log",
            port=cfg.port or EDITOR_PORT if cfg.backend is Backend.editor else 0,
            timeout_s=cfg.timeout_s,
            arguments=list(cfg.player_args),
            no_graphics=cfg.no_graphics,
            num_areas=cfg.num_areas or 1,
            parameters={name: float(value) for name, value in cfg.params.items()},
            engine=_engine(cfg),
        )

    def start(number: int, seed: int) -> RestartingPlayer:
        name = f"player {number}" if cfg.num_players > 1 else _describe(cfg)
        first = (seed + PLAYER_STRIDE * number) % 2**31
        return RestartingPlayer(lambda s: UnityPlayer(options(number), s), first, cfg.max_restarts, name)

    def make(seed: int) -> BaseEnv:
        players: list[RestartingPlayer] = []
        try:
            for number in range(cfg.num_players):
                players.append(start(number, seed))
            for player in players:
                player.connect()
        except BaseException:
            for player in players:
                player.close()
            raise
        return players[0] if cfg.num_players == 1 else SeveralPlayers(players)

    return make


def find_player(cfg: EnvConfig) -> Path | None:
    """Return the executable that the options name; None for the Editor.

    Raises:
        ConfigError: there is no such player or registry entry.
    """
    from mappo_unity.protocol.process import find_executable

    if cfg.backend is Backend.editor:
        return None
    if cfg.backend is Backend.registry:
        from mappo_unity.protocol.registry import fetch_player

        return fetch_player(cfg.registry, cfg.registry_entry or cfg.name)
    return find_executable(str(cfg.file_name))


def _engine(cfg: EnvConfig) -> dict[str, Any]:
    return {
        "width": cfg.screen_width,
        "height": cfg.screen_height,
        "quality_level": cfg.quality_level,
        "time_scale": cfg.time_scale,
        "target_frame_rate": cfg.target_frame_rate,
    }


def _log_folder(cfg: EnvConfig, log_folder: Path | None) -> Path:
    if cfg.player_logs is not None:
        folder = Path(cfg.player_logs)
    elif log_folder is not None:
        folder = log_folder
    else:
        folder = Path(tempfile.mkdtemp(prefix="mappo-unity-players-"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"the folder {folder} for players' logs cannot be made: {error.strerror}; choose another with "
            "env.player_logs"
        ) from error
    return folder.absolute()


def _describe(cfg: EnvConfig) -> str:
    return {
        Backend.editor: "env.backend=editor",
        Backend.registry: f"registry entry {cfg.registry_entry or cfg.name}",
    }.get(cfg.backend, f"env.file_name={cfg.file_name}")


def _custom(cfg: EnvConfig) -> MakeEnv:
    name = f"env.factory={cfg.factory}"
    factory = load_factory(str(cfg.factory), name)
    return lambda seed: GuardedEnv(call_factory(factory, name, seed, cfg.params), name, explain_error)


def call_factory(factory: Callable[..., Any], name: str, seed: int, params: Mapping[str, Any]) -> BaseEnv:
    """Return a user's environment.

    Raises:
        ConfigError: the factory does not take the parameters, raised something (its `details` are the user's
            frames of the traceback), or returned no BaseEnv. ConfigError and EnvironmentFailure of its own
            pass.
    """
    check_call(factory, name, params)
    try:
        env = factory(seed=seed, **params)
    except (ConfigError, EnvironmentFailure):
        raise
    except Exception as error:
        raise explain_error(error, name) from error
    if not isinstance(env, BaseEnv):
        raise ConfigError(
            f"{name} returned {with_article(type(env).__name__)}; it must return a "
            "mlagents_envs.base_env.BaseEnv"
        )
    return env


def check_call(factory: Callable[..., Any], name: str, params: Mapping[str, Any]) -> None:
    """Raise ConfigError if a factory does not take these parameters, as far as its signature says."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        return  # a builtin without one
    try:
        signature.bind(seed=0, **params)
    except TypeError as error:
        raise ConfigError(
            f"{name} cannot be called with seed and {', '.join(params) or 'nothing else'}: {error}; it is "
            f"{getattr(factory, '__name__', 'function')}{signature}"
        ) from error


def load_factory(path: str, name: str) -> Callable[..., Any]:
    """Return the function that package.module:function names; raises ConfigError, which calls it `name`."""
    module_name, _, function_name = path.partition(":")
    if str(Path.cwd()) not in sys.path:  # as `python -m` does: modules beside the user count
        sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except Exception as error:  # the user's module raises what it likes
        raise explain_error(error, f"{name}: module {module_name!r} cannot be imported: it") from error
    function = getattr(module, function_name, None)
    if not callable(function):
        names = sorted(n for n, v in vars(module).items() if callable(v) and not n.startswith("_"))
        hint = did_you_mean(function_name, names)
        more = ", ..." if len(names) > 20 else ""
        raise ConfigError(
            f"{name}: {module_name} has no function {function_name!r}{hint}; it has "
            f"{', '.join(names[:20]) or 'none'}{more}"
        )
    return function


def explain_error(error: BaseException, who: str) -> ConfigError:
    """Return the mistake "`who` raised ..." with the traceback of the user's code, without our frames."""
    text = str(error).strip()
    mistake = ConfigError(
        f"{who} raised {type(error).__name__}" + (f": {' '.join(text.split())}" if text else "")
    )
    report = TracebackException.from_exception(error)
    part: TracebackException | None = report
    while part is not None:
        part.stack[:] = [frame for frame in part.stack if not frame.filename.startswith(OUR_FRAMES)]
        part = part.__cause__ or part.__context__
    mistake.details = tuple("".join(report.format()).splitlines())
    return mistake
