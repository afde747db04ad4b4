"""The command line of mappo-player: its own switches among the arguments that Unity players take."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from typing import Any

from mappo_unity.cli.switches import Once, Parser, whole_number
from mappo_unity.config.ranges import check_range
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.ports import EDITOR_PORT

_DESCRIPTION = """\
Serve a scene as a Unity player, to a trainer that listens on a port of this machine; or build an executable
that does so when a trainer starts it. Other arguments of Unity players (-nographics, -batchmode ...) are
accepted and have no effect.

examples:
  mappo-player 3DBall                                     to a trainer that waits for the Editor
  mappo-player WallJump --mlagents-port 5005 --param big_wall_height=3
  mappo-player build 3DBall builds                        writes builds/3DBall.x86_64
  mappo-train env=unity env.file_name=builds/3DBall       trains on it
"""


class _PlayerParser(Parser):
    """Know our switches by their whole names alone: -headless is not -h, and -log not -logFile."""

    def _get_option_tuples(self, option_string: str) -> list[Any]:
        # argparse would complete what begins with a single dash, whatever allow_abbrev says
        return []


def parse(lines: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Return the values (`params` by name), and the arguments that have no effect here.

    Raises:
        ConfigError: a mistake, or a switch that is nearly one of ours.
    """
    parser = _parser()
    known, ignored = parser.parse_known_args(lines)

    _check_ignored(parser, lines, known.scene, ignored)
    if known.port is not None:
        check_range("--mlagents-port", known.port, 1, 65535)
    if known.num_areas is not None:
        check_range("--num-areas", known.num_areas, 1)

    known.params = dict(map(_parameter, known.param))
    return known, ignored


def check_build(known: argparse.Namespace, words: Sequence[str]) -> None:
    """Raise ConfigError if the arguments of mappo-player build are not a scene and a folder."""
    if len(words) < 2:
        raise ConfigError("build needs a scene and a folder: mappo-player build 3DBall builds")

    for option, given in (("--mlagents-port", known.port), ("-logFile", known.log_file)):
        if given is not None:
            raise ConfigError(f"{option} {given} has no effect on a build: its trainer gives it")


def help_text() -> str:
    """Return what mappo-player --help prints."""
    return _parser().format_help()


def _parameter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")

    try:
        number = float(value)
    except ValueError:
        number = math.nan

    if not name or not math.isfinite(number):
        raise ConfigError(f"--param {text} is not of the form NAME=NUMBER")

    return name, int(number) if number.is_integer() else number  # num_threads and others want whole ones


def _check_ignored(parser: Parser, lines: Sequence[str], scene: str, ignored: Sequence[str]) -> None:
    """Refuse what was meant for us; other arguments of Unity players have no effect here."""
    # the word right behind the scene: a second scene, or a parameter without --param
    second = lines[1] if len(lines) > 1 and lines[0] == scene != "build" else "-"
    if not second.startswith("-"):
        form = f"; parameters are given as --param {second}" if "=" in second else ": one scene is served"
        raise ConfigError(f"{second!r} behind the scene {scene!r} is no option{form}")

    for word in ignored:
        if word.startswith("--") and parser.near(word):
            raise ConfigError(f"{word} is not an option of mappo-player{parser.near(word)}")


def _parser() -> Parser:
    parser = _PlayerParser(
        prog="mappo-player",
        usage="mappo-player SCENE [--mlagents-port N] [options]   |   mappo-player build SCENE DIR [options]",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )

    parser.add_argument("scene", metavar="SCENE", help="a scene's name, or package.module:function")
    parser.add_argument(
        "--mlagents-port",
        dest="port",
        type=whole_number,
        action=Once,
        metavar="N",
        help=f"port of this machine on which the trainer listens; default {EDITOR_PORT}",
    )

    # spelled as Unity's players spell it
    parser.add_argument("-logFile", "-logfile", dest="log_file", metavar="PATH", help="log; default stdout")

    parser.add_argument(
        "--num-areas",
        type=whole_number,
        action=Once,
        metavar="N",
        help="areas, whatever the trainer asks for",
    )
    parser.add_argument(
        "--param",
        action="append",
        default=[],
        metavar="NAME=NUMBER",
        help="environment parameter of the scene; may stand several times",
    )
    parser.add_argument("--no-png", action="store_true", help="send pictures as floats")

    return parser
