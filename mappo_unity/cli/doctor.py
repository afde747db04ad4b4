"""mappo-doctor: look for what keeps a Unity game from being trained on, and say what cures it.

The installation is always examined, a player or the Editor if it is named; with ``run=FOLDER`` a training run
instead. The exit code is 0 when nothing fails and nothing is found.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

from mappo_unity.cli.examine.findings import CURES, Report, Say
from mappo_unity.cli.switches import Once, Parser, number, whole_number
from mappo_unity.config.ranges import check_duration, check_range
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.ports import FORBIDDEN, port_state
from mappo_unity.scenes.mujoco_check import check_mujoco

PACKAGES = ("torch", "torchrl", "tensordict", "mlagents-envs", "protobuf", "grpcio", "numpy", "mujoco")
EDITOR_PORT = 5004


def run(lines: list[str]) -> int:
    """Examine and print; return the exit code."""
    return diagnose(lines, print)


def diagnose(arguments: Sequence[str], say: Say) -> int:
    """Examine the installation and, if one is named, a player or the Editor, or a run; return the exit code.

    Raises:
        ConfigError: a mistake in the options, or no such file.
    """
    if any(argument.startswith("run=") for argument in arguments):
        return _diagnose_runs(arguments, say)

    options = _parser().parse_args(arguments)

    check_range("--port", options.port, 1, 65535)
    check_duration("--timeout-s", options.timeout_s)
    check_duration("--seconds", options.seconds)

    for name, given in (("--no-graphics", options.no_graphics), ("--argument", options.argument)):
        if given and options.file_name is None:
            raise ConfigError(f"{name} is for a player that is started: it needs --file-name GAME")

    report = Report(say)
    report.head("installation")
    examine_packages(report)

    report.head("ports and display")
    examine_ports(report, options.port)

    if options.file_name is not None or options.editor:
        # only now: most of what it says needs no player, and comes at once
        from mappo_unity.cli.examine.player import examine_player

        report.head("Editor" if options.editor else "player")
        try:
            examine_player(report, options)
        except ModuleNotFoundError as error:  # a package, as was told above
            report.fail(f"no player can be examined ({error})", "install what is missing first")

    report.head(f"{report.failures} failed, {report.warnings} to look at")
    return 1 if report.failures else 0


def _diagnose_runs(arguments: Sequence[str], say: Say) -> int:
    from mappo_unity.cli.examine.training_run import examine_runs

    report = Report(say)
    examine_runs(report, arguments)
    return 1 if report.warnings else 0


def examine_packages(report: Report) -> None:
    """Report versions, and whether protobuf is compiled."""
    from mappo_unity import __version__

    report.good(f"mappo-unity {__version__}, Python {platform.python_version()}, {platform.platform()}")

    for name in PACKAGES:
        try:
            report.good(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            report.fail(
                f"{name} is not installed", "pip install mappo-unity, which brings what goes together"
            )

    _examine_protobuf(report)
    try:
        check_mujoco()
    except ConfigError as error:
        report.mistake(error)


def _examine_protobuf(report: Report) -> None:
    try:
        from google.protobuf.internal import api_implementation
    except ImportError as error:  # missing, or installed in part
        report.fail(f"protobuf cannot be imported ({error})", "pip install --force-reinstall protobuf")
        return

    kind = api_implementation.Type()
    if kind == "python":
        report.fail("protobuf runs in pure Python", CURES["protobuf"])
    else:
        report.good(f"protobuf is compiled ({kind})")


def examine_ports(report: Report, editor_port: int) -> None:
    """Report whether ports of the loopback address can be had, and whether there is a display."""
    try:
        with socket.socket() as free:
            # port 0: any that is free
            free.bind(("127.0.0.1", 0))
            report.good(f"free ports for players, for example {free.getsockname()[1]}")
    except OSError as error:
        cure = "bring the loopback interface up: ip link set lo up"
        report.fail(f"no port of 127.0.0.1 can be had: {error}", cure)

    state = port_state(editor_port)
    if state == "free":
        report.good(f"port {editor_port} (Unity Editor) is free")
    else:
        what = "may not be listened on" if state == FORBIDDEN else "is taken"
        report.warn(f"port {editor_port} (Unity Editor) {what}", CURES[state])

    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        report.warn("DISPLAY is not set", CURES["display"])


def help_text() -> str:
    """Return what mappo-doctor --help prints."""
    return _parser().format_help()


class _Parser(Parser):
    """Tell also what a word alone was meant for."""

    def near(self, word: str) -> str:
        """Return a hint: the near switch, --file-name for a path, run= for a run."""
        from mappo_unity.config.overrides import shell_word

        path = word.rpartition("=")[2]
        if word.startswith("-") or not path:
            return super().near(word)

        if (Path(path) / "config.yaml").is_file():
            return f" (did you mean {shell_word(f'run={path}')}?)"

        return f" (did you mean --file-name {shell_word(path)}?)"


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mappo-doctor",
        usage="mappo-doctor [OPTIONS]\n       mappo-doctor run=FOLDER ...",
        description="Find out what keeps a Unity game from being trained on, or a run from learning.",
        epilog="run=FOLDER looks at a run's observations, rewards, masks, episodes and updates, and "
        "says what keeps it from learning; a folder of runs does, too. Exit code: 0 when nothing is found.",
        allow_abbrev=False,
    )

    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--file-name", action=Once, metavar="GAME", help="a built Unity player, as env.file_name"
    )
    what.add_argument("--editor", action="store_true", help="wait for the Unity Editor")

    for name, kind, default, text in (
        ("--port", whole_number, EDITOR_PORT, "port for the Editor; default 5004"),
        ("--timeout-s", number, 60.0, "patience with the player; default 60"),
        ("--seconds", number, 2.0, "length of each speed test; default 2"),
    ):
        parser.add_argument(name, type=kind, action=Once, default=default, metavar="N", help=text)

    parser.add_argument("--no-graphics", action="store_true", help="start the player without graphics")
    parser.add_argument(
        "--argument", action="append", default=[], help="further argument of the player; --argument=--level"
    )

    return parser
