"""The flags of mlagents-learn, which beat the file."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from typing import Any, NoReturn

from mappo_unity.config.mlagents.keys import FLAG, RUN, WHOLE
from mappo_unity.errors import ConfigError

_ENV_ARGS = "--env-args"
_OTHER_NAMES = {"env_settings.env_path": "--env", "torch_settings.device": "--torch-device"}
_NO_FLAG = ("checkpoint_settings.load_model", "checkpoint_settings.train_model", "env_settings.env_args")
_DEPRECATED = ("--load", "--train", "--torch", "--tensorflow")
_NO_EFFECT = "no effect here"
_HELP = {
    "env_settings.env_path": "Unity player; scene:NAME an embedded scene; none: the Editor, on port 5004",
    "env_settings.base_port": _NO_EFFECT,
    "env_settings.num_envs": "players that run side by side (1)",
    "env_settings.num_areas": "areas in each player; of a scene, 1: as many as Unity has (1)",
    "env_settings.timeout_wait": "seconds within which a player must connect, and must answer (60)",
    "env_settings.seed": "seed of the environment, the networks and the sampling; -1: draw one (-1)",
    "env_settings.max_lifetime_restarts": "times that a crashed player is started again; -1: always (10)",
    "env_settings.restarts_rate_limit_n": _NO_EFFECT,
    "env_settings.restarts_rate_limit_period_s": _NO_EFFECT,
    "engine_settings.width": "width of a player's screen in pixels (84)",
    "engine_settings.height": "height of a player's screen in pixels (84)",
    "engine_settings.quality_level": "Unity's quality level (5)",
    "engine_settings.time_scale": "how much faster than real time a player runs (20)",
    "engine_settings.target_frame_rate": "frames a second that a player draws; -1: no limit (-1)",
    "engine_settings.capture_frame_rate": _NO_EFFECT,
    "engine_settings.no_graphics": "start players without graphics; cameras then see nothing",
    "engine_settings.no_graphics_monitor": _NO_EFFECT,
    "checkpoint_settings.run_id": "name of the run's folder below the results (ppo)",
    "checkpoint_settings.initialize_from": "begin with the networks of the run of this name",
    "checkpoint_settings.resume": "resume the run of this name",
    "checkpoint_settings.force": "replace the run of this name",
    "checkpoint_settings.inference": "play 100 episodes of the run of this name, without training",
    "checkpoint_settings.results_dir": "folder of the results (results)",
    "torch_settings.device": "cpu, cuda or cuda:N (cpu)",
    "debug": _NO_EFFECT,
}
_DESCRIPTION = """\
Train with ML-Agents' configuration and flags (docs/from-mlagents.md).

examples:
  mappo-learn 3DBall.yaml --run-id=ball --env=builds/3DBall       a Unity build
  mappo-learn 3DBall.yaml --run-id=ball                           the Editor: press Play
  mappo-learn 3DBall.yaml --run-id=ball --env=scene:3DBall        an embedded scene, without Unity
  mappo-learn 3DBall.yaml --run-id=ball --resume                  where the run was trained
  mappo-learn 3DBall.yaml --env=scene:3DBall ppo.epochs=4         an option of mappo-train beats all
"""


@dataclass
class Flags:
    """A command line: the file, what flags set (dotted keys), and the rest of it."""

    config: str | None = None
    given: dict[str, Any] = field(default_factory=dict)
    options: list[str] = field(default_factory=list)
    """Options of ours, ppo.epochs=4, which beat everything."""
    deterministic: bool = False
    print_options: bool = False
    help: bool = False
    """In a short form that only the parser knows, such as --hel."""
    warnings: list[str] = field(default_factory=list)


def flag_of(key: str) -> str:
    """Return the flag of a key: ``--num-envs`` for env_settings.num_envs."""
    return _OTHER_NAMES.get(key, "--" + key.rpartition(".")[2].replace("_", "-"))


def help_text() -> str:
    """Return the text of --help."""
    return _parser().format_help().rstrip()


def before_env_args(arguments: list[str]) -> list[str]:
    """Return the words of a command line that are not the player's."""
    return arguments[: arguments.index(_ENV_ARGS)] if _ENV_ARGS in arguments else arguments


def parse_flags(arguments: list[str]) -> Flags:
    """Read a command line; raise ConfigError."""
    own = before_env_args(arguments)
    words_of_player = arguments[len(own) :]  # and the flag before them

    known = vars(_parser().parse_intermixed_args(own))
    words = known.pop("words")
    if known.pop("env_args") is not None:
        raise ConfigError(f"{_ENV_ARGS} is written {_ENV_ARGS} WORD ... at the end of the line")
    flags = Flags(options=[word for word in words if "=" in word])
    files = [word for word in words if "=" not in word]
    if len(files) > 1:
        raise ConfigError(f"{' and '.join(files)}: one configuration is taken")

    flags.config = files[0] if files else None
    flags.deterministic = known.pop("deterministic")
    flags.print_options = known.pop("print_options")
    flags.help = known.pop("help")
    for flag in _DEPRECATED:
        if known.pop(flag.lstrip("-")):
            flags.warnings.append(_about(flag))

    flags.given = {key: value for key, value in known.items() if value is not None}
    if words_of_player:
        flags.given["env_settings.env_args"] = words_of_player[1:]
    return flags


def _about(flag: str) -> str:
    if flag == "--load":
        return "--load is an old flag without effect, as in ML-Agents: --resume goes on with a run"
    default = "training" if flag == "--train" else "PyTorch"
    return f"{flag} is an old flag without effect: {default} is the default"


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (--help lists the flags)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mappo-learn",
        usage="mappo-learn [CONFIG.yaml] [--run-id=NAME] [--env=PATH] [flags] [option=value ...]",
        description=_DESCRIPTION,
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, max_help_position=34),
        add_help=False,
    )
    parser.add_argument("words", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--help", "-h", action="store_true", help="show this text")
    parser.add_argument(
        "--print-options",
        action="store_true",
        help="print the options of mappo-train that a file becomes, and end",
    )
    parser.add_argument("--deterministic", action="store_true", help="with --inference: most likely actions")

    for key, about in RUN.items():
        if key in _NO_FLAG:
            continue
        if about.kind == FLAG:
            parser.add_argument(
                flag_of(key), dest=key, action="store_true", default=None, help=_HELP.get(key)
            )
        else:
            kind: Any = str
            if about.kind != "a text":
                kind = int if about.kind == WHOLE else float
            parser.add_argument(
                flag_of(key), dest=key, type=kind, default=None, help=_HELP.get(key), metavar="VALUE"
            )
    parser.add_argument(_ENV_ARGS, metavar="...", help="the rest of the line goes to the player")
    for flag in _DEPRECATED:
        parser.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
    return parser
