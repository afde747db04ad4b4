"""Options of the environment: `env.*`."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Optional

from mappo_unity.config.parameters.values import (
    FACTORY,
    LARGEST_FLOAT32,
    PLAYERS,
    SCENE,
    read_parameters,
)
from mappo_unity.config.schema.checks import above, at_least, at_most, within
from mappo_unity.errors import ConfigError


class Backend(Enum):
    """What runs the environment."""

    embedded = "embedded"
    custom = "custom"
    pettingzoo = "pettingzoo"
    player = "player"
    editor = "editor"
    registry = "registry"


LARGEST_INT32 = 2**31 - 1
BACKENDS = "backends"
"""Metadata of an option of env: the backends that look at it; without it all do."""
_STARTED = {BACKENDS: (Backend.player, Backend.registry)}
_UNITY = {BACKENDS: (Backend.player, Backend.editor, Backend.registry)}
_ANY_BUT_CUSTOM = {BACKENDS: tuple(backend for backend in Backend if backend is not Backend.custom)}
_FACTORY = {BACKENDS: (Backend.custom, Backend.pettingzoo)}


@dataclass
class EnvConfig:
    """The environment."""

    name: str = "3DBall"
    """Name of the environment: a preset in conf/env, also the name of the run's folder."""
    backend: Backend = Backend.embedded
    """What runs it: an embedded scene, a simulator of your own (custom), a PettingZoo parallel environment, a
    built Unity player, the Unity Editor, or a player that ML-Agents' registry names (registry)."""
    num_areas: Optional[int] = field(default=None, metadata=_ANY_BUT_CUSTOM)
    """Copies of the playing area inside one environment; null: as many as the Unity scene has."""
    stagger: bool = field(default=False, metadata={BACKENDS: (Backend.embedded,)})
    """In training, let each area's first episode begin with a random part of its time limit over: areas that
    begin together, and end by the limit, would all be at the same time of their episodes in every batch."""
    params: dict[str, Any] = field(default_factory=dict)
    """Environment parameters (env.params.mass=2) of the scene or player, or arguments of env.factory. Also a
    sampler, {sampler: uniform, min: 0.5, max: 10}, or a curriculum, {lessons: [...]}."""
    factory: Optional[str] = field(default=None, metadata=_FACTORY)
    """With backend=custom or pettingzoo: package.module:function, called as function(seed=..., **env.params);
    with pettingzoo the seed only if it takes one."""
    teams: str = field(default="all", metadata={BACKENDS: (Backend.pettingzoo,)})
    """With backend=pettingzoo, who shares a team: all, none, or package.module:function, called with an
    agent's name, which returns its team (a whole number or a text; None: alone)."""
    file_name: Optional[str] = field(default=None, metadata={BACKENDS: (Backend.player,)})
    """With backend=player: path of the built Unity player, with or without its extension."""
    registry: str = field(default="default", metadata={BACKENDS: (Backend.registry,)})
    """With backend=registry: path or URL of a registry's YAML file, or default (ML-Agents' own)."""
    registry_entry: Optional[str] = field(default=None, metadata={BACKENDS: (Backend.registry,)})
    """With backend=registry: the entry to play; null: the one called env.name."""
    num_players: int = field(default=1, metadata=_STARTED)
    """Players that run side by side, their agents in one batch."""
    max_restarts: int = field(default=20, metadata=_UNITY)
    """Times that each player is started again in a run after it crashed, hung or sent nonsense; and each
    worker's process (collect.workers)."""
    timeout_s: float = field(default=60.0, metadata=_UNITY)
    """Seconds within which a player (or the Editor) must connect, and must answer."""
    port: Optional[int] = field(default=None, metadata={BACKENDS: (Backend.editor,)})
    """With backend=editor: the port to wait on; null: 5004, as in Unity. Players get free ports."""
    time_scale: float = field(default=20.0, metadata=_UNITY)
    """How much faster than real time a player runs; a high one may change its physics."""
    quality_level: Optional[int] = field(default=None, metadata=_UNITY)
    """Unity's quality level; null: as built."""
    screen_width: Optional[int] = field(default=None, metadata=_UNITY)
    """Width of a player's screen in pixels; null: as built."""
    screen_height: Optional[int] = field(default=None, metadata=_UNITY)
    """Height of a player's screen in pixels; null: as built."""
    target_frame_rate: Optional[int] = field(default=-1, metadata=_UNITY)
    """Frames a second that a player draws; -1: no limit, null: as built."""
    no_graphics: bool = field(default=False, metadata=_STARTED)
    """Start players without graphics (machines without a display); cameras then see nothing."""
    player_args: list[str] = field(default_factory=list, metadata=_STARTED)
    """Further arguments of a player's command line."""
    player_logs: Optional[str] = field(default=None, metadata=_STARTED)
    """Folder of the players' logs; null: players/ in the run's folder."""
    max_team_size: Optional[int] = None
    """Agent slots of a team; null: the largest team seen at the start."""
    max_teams: Optional[int] = None
    """Team slots of a behavior; null: as many as are seen at the start."""
    note: Optional[str] = None
    """Said when a training run begins: what the environment needs and the trainer does not have."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[\w.-]*\w[\w.-]*", self.name):
            raise ConfigError(
                f"env.name={self.name!r} must consist of letters, digits, '_', '-' and '.': it names a folder"
            )

        at_least("env.num_areas", self.num_areas, 1)
        at_least("env.max_team_size", self.max_team_size, 1)
        at_least("env.max_teams", self.max_teams, 1)
        at_least("env.num_players", self.num_players, 1)
        at_least("env.max_restarts", self.max_restarts, 0)
        above("env.timeout_s", self.timeout_s, 0)
        above("env.time_scale", self.time_scale, 0)
        # what the engine is told has 32 bits
        at_most("env.time_scale", self.time_scale, LARGEST_FLOAT32)
        within("env.quality_level", self.quality_level, 0, LARGEST_INT32)
        within("env.screen_width", self.screen_width, 1, LARGEST_INT32)
        within("env.screen_height", self.screen_height, 1, LARGEST_INT32)
        within("env.target_frame_rate", self.target_frame_rate, -1, LARGEST_INT32)
        within("env.port", self.port, 1, 65535)

        self._check_players()
        _ = self.parameters  # which looks for mistakes

        if self.backend in (Backend.custom, Backend.pettingzoo) and not self.factory:
            kind = "BaseEnv" if self.backend is Backend.custom else "pettingzoo.ParallelEnv"
            raise ConfigError(
                f"env.factory is not given, but env.backend={self.backend.value} needs it: "
                f"env.factory=package.module:function, a function that returns a {kind}"
            )
        if self.factory is not None and self.factory.count(":") != 1:
            raise ConfigError(f"env.factory={self.factory!r} is not of the form package.module:function")
        if self.teams not in ("all", "none") and self.teams.count(":") != 1:
            raise ConfigError(
                f"env.teams={self.teams!r} must be all, none, or a function, package.module:function"
            )

    def _check_players(self) -> None:
        if self.backend is Backend.player and not self.file_name:
            raise ConfigError(
                "env.file_name is not given, but env.backend=player needs it: the path of a built Unity "
                "player, env.file_name=builds/Game (env.backend=editor trains in the Unity Editor instead)"
            )

        if (self.screen_width is None) != (self.screen_height is None):
            raise ConfigError("env.screen_width and env.screen_height belong together: give both or neither")

        if self.backend not in (Backend.player, Backend.registry) and self.num_players > 1:
            has_areas = self.backend in (Backend.embedded, Backend.pettingzoo)
            larger = " (env.num_areas makes it larger)" if has_areas else ""
            raise ConfigError(
                f"env.num_players={self.num_players} needs env.backend=player or registry; with "
                f"env.backend={self.backend.value} there is one environment{larger}"
            )

    @property
    def parameters(self) -> dict[str, Any]:
        """What env.params says, read: see `read_parameters`; raises ConfigError."""
        takers = {Backend.embedded: SCENE, Backend.custom: FACTORY, Backend.pettingzoo: FACTORY}
        return read_parameters(self.params, takers.get(self.backend, PLAYERS))
