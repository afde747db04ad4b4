"""What a league is, and what can be known of it before torch is loaded."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from mappo_unity.config.compose import check_effect
from mappo_unity.config.parameters.values import params_at
from mappo_unity.config.presets import group_choices
from mappo_unity.config.schema import Backend, Config, EnvConfig, LeagueConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.first_checks import behaviors_seen, check_environment, check_fit, open_known
from mappo_unity.policies.layouts import check_two_sides
from mappo_unity.policies.league.words import short_names
from mappo_unity.policies.policy_files import RANDOM, SUFFIX, Kind, Source, choose_checkpoint, locate
from mappo_unity.runs.atomic import write_atomically
from mappo_unity.runs.folder import find_run
from mappo_unity.runs.json_record import record_to_resume
from mappo_unity.runs.lock import locked
from mappo_unity.runs.options import config_to_play
from mappo_unity.scenes.mujoco_check import check_mujoco

OUT = "outputs/league"
RECORD = "league.json"
_OPTION = "policy"


@dataclass(frozen=True)
class Player:
    """A policy that plays: its name in the tables, the file or folder that it is, the digest of that."""

    name: str
    where: str
    digest: str


@dataclass(frozen=True)
class League:
    """Who plays whom, where, how often and with which random numbers."""

    players: tuple[Player, ...]
    env: EnvConfig
    matches: int
    deterministic: bool
    seed: int
    folder: Path

    @property
    def names(self) -> list[str]:
        """The players' names."""
        return [player.name for player in self.players]

    def record(self) -> dict[str, Any]:
        """Return what its results depend on, as plain values."""
        env = OmegaConf.to_container(OmegaConf.structured(self.env), enum_to_str=True)
        return {
            "policies": {player.name: player.digest for player in self.players},
            "env": env,
            "matches": self.matches,
            "deterministic": self.deterministic,
            "seed": self.seed,
        }


def check_league(cfg: LeagueConfig, lines: Sequence[str] = ()) -> League:
    """Return the league that the options mean.

    Args:
        cfg: the options.
        lines: those of the environment, env.NAME=... in mappo-train's grammar.

    Raises:
        ConfigError: nothing can be played with these options, or the folder is that of another league.
    """
    check_mujoco()
    sources = [locate(word, _OPTION) for word in cfg.policies]
    files = [_file(source) for source in sources]
    _check_different(cfg.policies, files)
    known = [open_known(source, cfg.deterministic) for source in sources]

    config = _environment(cfg, sources, lines)
    check_environment(config)
    behaviors = behaviors_seen(config.env)
    if behaviors:
        check_two_sides(behaviors)
    check_fit(sources, known, behaviors)

    names = short_names(cfg.policies)
    players = tuple(Player(*values) for values in zip(names, files, map(digest_of, files)))
    league = League(
        players,
        _for_matches(config.env, cfg.matches),
        cfg.matches,
        cfg.deterministic,
        cfg.seed,
        Path(cfg.out or OUT),
    )
    _check_folder(league)
    return league


@contextmanager
def begun(league: League) -> Iterator[None]:
    """Make the league's folder, hold its lock, and write what the league is.

    Raises:
        ConfigError: it cannot be made or written, is in use, or holds another league by now.
    """
    with _told_as_out(league.folder):
        league.folder.mkdir(parents=True, exist_ok=True)

    with locked(league.folder, f"the league in {league.folder} is being played"):
        # once more: whoever held the lock before may have begun another league
        _check_folder(league)
        with _told_as_out(league.folder):
            write_atomically(league.folder / RECORD, _text(league.record()))
        yield


@contextmanager
def _told_as_out(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"out={folder} cannot be made or written ({error.strerror or error}: {error.filename})"
        ) from error


def digest_of(file: str) -> str:
    """Return the SHA-256 of what plays, shortened; of a folder that of its ONNX files."""
    if file == RANDOM:
        return RANDOM
    path, digest = Path(file), hashlib.sha256()
    for part in sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]:
        digest.update(part.read_bytes())
    return digest.hexdigest()[:16]


def check_unchanged(player: Player) -> None:
    """Raise ConfigError if what plays, now that it is open, is not what the league began with."""
    if player.where == RANDOM:
        return

    try:
        is_same = digest_of(player.where) == player.digest
    except OSError:  # it is gone
        is_same = False
    if not is_same:
        raise ConfigError(
            f"the policy {player.name} has changed since the league began: {player.where} is not what it "
            "was. A run that trains replaces its best checkpoint: name one that stays, or a copy, and "
            "another folder as out"
        )


def _file(source: Source) -> str:
    """Return the file (of ONNX files also the folder) that plays, or the word for chance.

    A path is absolute: ./zoo and ./random, as `Path` writes them, would be words again.
    """
    if source.kind is Kind.random:
        return RANDOM
    is_checkpoint = source.kind in (Kind.run, Kind.checkpoint)
    return os.path.abspath(choose_checkpoint(source.path, _OPTION) if is_checkpoint else source.path)


def _check_different(words: Sequence[str], files: Sequence[str]) -> None:
    seen: dict[str, str] = {}
    for word, file in zip(words, files):
        path = file if file == RANDOM else os.path.realpath(file)
        if path in seen:
            same = "twice" if seen[path] == word else f"as {seen[path]} and as {word}, both {file}"
            raise ConfigError(f"the policy {word} plays {same}: name each policy once")
        seen[path] = word


def _environment(cfg: LeagueConfig, sources: Sequence[Source], lines: Sequence[str]) -> Config:
    """Return the options to play with: those of a preset, else those of the first run among the players."""
    runs = [source.path for source in sources if source.kind is not Kind.random and _lies_in_run(source)]
    if cfg.env is None and not runs:
        raise ConfigError(
            "none of the policies lies in the folder of a run, which would say where it plays: say in which "
            f"environment to play, env=NAME ({', '.join(group_choices()['env'])})"
        )

    config = config_to_play(runs[0] if runs else Path(cfg.policies[0]), cfg.env, lines)
    check_effect(list(lines), [config])
    if config.env.backend is Backend.editor:
        raise ConfigError(
            "env.backend=editor: a league opens the environment anew for every pair, and the Editor would "
            "want Play to be pressed each time; build a player, env.backend=player env.file_name=..."
        )
    return config


def _lies_in_run(source: Source) -> bool:
    try:
        find_run(source.path, _OPTION)
    except ConfigError:
        return False
    return True


def _for_matches(env: EnvConfig, matches: int) -> EnvConfig:
    """Return the environment at its last lessons, with no more areas than matches are played side by side."""
    areas = env.num_areas
    if areas is not None and env.backend is Backend.embedded:
        areas = min(areas, (matches + 1) // 2)
    return replace(env, num_areas=areas, params=params_at(env.params, {}, missing=-1))


def _check_folder(league: League) -> None:
    """Raise ConfigError if the folder for the results is that of another league, or of something else."""
    saved = record_to_resume(league.folder, RECORD, "league")
    if saved is None:
        return

    wanted = json.loads(_text(league.record()))
    differing = [name for name in wanted if saved.get(name) != wanted[name]]
    # a pair's number, which its seeds come from, is its place among the policies as they are named
    if "policies" not in differing and list(saved["policies"]) != list(wanted["policies"]):
        differing.insert(0, "policies")
    if differing:
        names = " and ".join(map(_named, differing))
        raise ConfigError(
            f"out={league.folder} holds another league, which differs in {names} "
            f"({_difference(saved, wanted, differing[0])}): give another folder as out, or the same options, "
            "and it goes on"
        )


def _named(name: str) -> str:
    return {"policies": "its policies", "env": "its environment"}.get(name, name)


def _difference(saved: dict[str, Any], wanted: dict[str, Any], name: str) -> str:
    """Say how two leagues differ in one of the entries of their records."""
    old, new = saved.get(name), wanted[name]
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return f"{name}={old} there, {name}={new} here"
    if name == "policies" and list(old) != list(new):
        return f"{', '.join(old)} there, {', '.join(new)} here"

    first = next(key for key in {**new, **old} if old.get(key) != new.get(key))
    if name == "policies":
        return f"{first} has changed since"
    return f"env.{first}={old.get(first)} there, env.{first}={new.get(first)} here"


def _text(record: dict[str, Any]) -> bytes:
    return (json.dumps(record, indent=2, default=str) + "\n").encode()
