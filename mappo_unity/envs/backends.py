"""How options become the function that opens an environment: a scene, players, or a user's own factory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mappo_unity.config.option_table import show_value
from mappo_unity.config.parameters.values import later_values, values_at
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.ports import EDITOR_PORT
from mappo_unity.protocol.protobuf import install

install()

from mlagents_envs.base_env import BaseEnv  # noqa: E402

from mappo_unity.scenes.factory import call_factory, explain_error, load_factory  # noqa: E402
from mappo_unity.scenes.user_env import GuardedEnv  # noqa: E402

if TYPE_CHECKING:
    from mappo_unity.protocol.player_options import PlayerOptions

MakeEnv = Callable[[int], BaseEnv]

PLAYER_STRIDE = 100_003
"""Player n of several starts from the seed plus n times this (modulo 2^31)."""


def make_env_function(cfg: EnvConfig, log_folder: Path | None = None, is_training: bool = False) -> MakeEnv:
    """Return the function that opens the environment for a seed; parameters are at their first lessons.

    Args:
        log_folder: where players write their logs, unless env.player_logs says; None: a temporary folder.
        is_training: heed env.stagger; episodes that are measured are whole from the first one on.

    Raises:
        ConfigError: the options name nothing that can be opened.
    """
    if cfg.backend in (Backend.embedded, Backend.custom, Backend.pettingzoo) and "seed" in cfg.params:
        raise ConfigError(
            f"env.params.seed={cfg.params['seed']}: the environment's seed follows from the run's; use seed=N"
        )

    if cfg.backend is Backend.embedded:
        return _embedded(cfg, cfg.stagger and is_training)
    if cfg.backend is Backend.custom:
        return _custom(cfg)
    if cfg.backend is Backend.pettingzoo:
        return _pettingzoo(cfg)
    return _players(cfg, log_folder)


def _embedded(cfg: EnvConfig, is_staggered: bool) -> MakeEnv:
    from mappo_unity.scenes.registry import BUILT_IN, make_scene

    if "num_areas" in cfg.params:
        raise ConfigError(
            f"env.params.num_areas={show_value(cfg.params['num_areas'])} is no parameter of a scene, but an "
            "option of its own: use env.num_areas=N"
        )

    parameters = cfg.parameters
    params = values_at(parameters, {})
    if cfg.num_areas is not None:
        params["num_areas"] = cfg.num_areas

    def make(seed: int) -> BaseEnv:
        scene = make_scene(cfg.name, seed=seed, **params)
        for name, value in later_values(parameters):
            scene.parameters.check(name, value)
        scene.is_staggered = is_staggered

        if cfg.name in BUILT_IN:
            return scene
        return GuardedEnv(scene, f"scene {cfg.name}", explain_error)  # what it raises is its author's to mend

    return make


def _players(cfg: EnvConfig, log_folder: Path | None) -> MakeEnv:
    from mappo_unity.protocol.client import UnityPlayer
    from mappo_unity.protocol.parallel_players import SeveralPlayers
    from mappo_unity.protocol.restarting_player import RestartingPlayer

    executable, own_args = find_player(cfg)
    # in ML-Agents' order: an entry's arguments come behind those of the command line
    arguments = [*cfg.player_args, *own_args]
    # the Editor's log is its own, and lies where Unity writes it
    folder = Path() if cfg.backend is Backend.editor else _log_folder(cfg, log_folder)

    def start(number: int, seed: int) -> RestartingPlayer:
        name = f"player {number}" if cfg.num_players > 1 else _describe(cfg)
        # a player's seed is an int32 that is not negative
        first = (seed + PLAYER_STRIDE * number) % 2**31

        # Every restart has a log of its own: messages name that of the player that failed.
        restarts = count()

        def make_player(own_seed: int) -> UnityPlayer:
            restart = next(restarts)
            log_name = f"Player-{number}-restart-{restart}.log" if restart else f"Player-{number}.log"
            player_options = _player_options(cfg, executable, arguments, folder / log_name)
            return UnityPlayer(player_options, own_seed)

        return RestartingPlayer(make_player, first, cfg.max_restarts, name)

    def make(seed: int) -> BaseEnv:
        players: list[RestartingPlayer] = []

        # all players start before the first is waited for; on an error none may be left running
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


def _player_options(
    cfg: EnvConfig, executable: Path | None, arguments: list[str], log_file: Path
) -> PlayerOptions:
    from mappo_unity.protocol.player_options import PlayerOptions

    return PlayerOptions(
        executable,
        log_file,
        # only the Editor must be told its port; for players the system picks a free one (0)
        port=cfg.port or EDITOR_PORT if cfg.backend is Backend.editor else 0,
        timeout_s=cfg.timeout_s,
        arguments=arguments,
        no_graphics=cfg.no_graphics,
        num_areas=cfg.num_areas or 1,
        parameters=values_at(cfg.parameters, {}),
        engine=_engine(cfg),
    )


def find_player(cfg: EnvConfig) -> tuple[Path | None, list[str]]:
    """Return the executable that the options name, None for the Editor, and a registry entry's arguments.

    Raises:
        ConfigError: there is no such player or registry entry.
    """
    from mappo_unity.protocol.process import find_executable

    if cfg.backend is Backend.editor:
        return None, []

    if cfg.backend is Backend.registry:
        from mappo_unity.protocol.registry import fetch_player

        return fetch_player(cfg.registry, cfg.registry_entry or cfg.name)

    return find_executable(str(cfg.file_name)), []


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
    factory, params = load_factory(str(cfg.factory), name), values_at(cfg.parameters, {})
    return lambda seed: GuardedEnv(call_factory(factory, name, seed, params), name, explain_error)


def _pettingzoo(cfg: EnvConfig) -> MakeEnv:
    from mappo_unity.scenes.pettingzoo.opening import check_package, open_copies

    check_package()
    name = f"env.factory={cfg.factory}"
    factory, params = load_factory(str(cfg.factory), name), values_at(cfg.parameters, {})

    def make(seed: int) -> BaseEnv:
        copies = open_copies(factory, name, seed, params, cfg.num_areas or 1, cfg.teams)
        return GuardedEnv(copies, name, explain_error)

    return make
