"""mappo-doctor: look for what keeps a Unity game from being trained on, and say what cures it.

In: nothing, or a player's file, or the Editor. Out: lines of findings, and an exit code, 0 when nothing
fails. Imports neither torch nor TorchRL; prints through the function it is given.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mappo_unity.cli.arguments import check_duration, check_range
from mappo_unity.config.schema import ConfigError, EnvironmentFailure

PACKAGES = ("torch", "torchrl", "tensordict", "mlagents-envs", "protobuf", "grpcio", "numpy", "mujoco")
EDITOR_PORT = 5004
TIME_SCALES = (1.0, 20.0, 100.0)
PATIENCE_STEPS = 200  # environment steps within which some agent should ask

CURES = {
    "protobuf": "messages are parsed in pure Python, 10 to 80 times slower: pip install --upgrade protobuf, "
    "and unset PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION",
    "TIME_WAIT": "a run that ended less than a minute ago holds it (TIME_WAIT); it comes free by itself",
    "in use": "another training or a game started by hand holds it: end that one, or use env.port",
    "display": "no display: start players with env.no_graphics=true (no cameras then), or under xvfb-run",
    "no behavior": "the player runs, but no agent asks for a decision: give every Agent a DecisionRequester "
    "(or call RequestDecision), set Behavior Type to Default, and see that the agents' objects are active",
    "rhythm": "no agent asked again after its first decision: is DecisionRequester's period very long, or "
    "are the agents destroyed without EndEpisode?",
    "old package": "build the game with com.unity.ml-agents 2.0 or later (release 18), for groups and hybrid "
    "actions",
}
"""Cures in words, by trouble."""

Say = Callable[[str], None]


def diagnose(arguments: Sequence[str], say: Say) -> int:
    """Examine the installation and, if one is named, a player or the Editor; return the exit code.

    Raises:
        ConfigError: a mistake in the options, or no such file.
    """
    options = _parser().parse_args(arguments)
    check_range("--port", options.port, 1, 65535)
    check_duration("--timeout-s", options.timeout_s)
    check_duration("--seconds", options.seconds)
    report = Report(say)
    report.head("installation")
    examine_packages(report)
    report.head("ports and display")
    examine_ports(report, options.port)
    if options.file_name or options.editor:
        report.head("player" if options.file_name else "Editor")
        examine_player(report, options)
    report.head(f"{report.failures} failed, {report.warnings} to look at")
    return 1 if report.failures else 0


class Report:
    """Say findings as they come, and count the bad ones."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self.failures = self.warnings = 0

    def head(self, text: str) -> None:
        """Begin a section."""
        self._say(text)

    def good(self, text: str) -> None:
        """Say that something is as it should be."""
        self._say(f"  ok    {text}")

    def warn(self, text: str, cure: str) -> None:
        """Say that something may be in the way, and what to do."""
        self.warnings += 1
        self._say(f"  look  {text}\n        {cure}")

    def fail(self, text: str, cure: str = "") -> None:
        """Say that something does not work, and what to do."""
        self.failures += 1
        self._say(f"  FAIL  {text}" + (f"\n        {cure}" if cure else ""))


def examine_packages(report: Report) -> None:
    """Report versions, and whether protobuf is compiled."""
    from mappo_unity import __version__

    report.good(f"mappo-unity {__version__}, Python {platform.python_version()}, {platform.platform()}")
    for name in PACKAGES:
        try:
            report.good(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            report.fail(f"{name} is not installed", f"pip install {name}")
    from google.protobuf.internal import api_implementation

    kind = api_implementation.Type()
    if kind == "python":
        report.fail("protobuf runs in pure Python", CURES["protobuf"])
    else:
        report.good(f"protobuf is compiled ({kind})")


def examine_ports(report: Report, editor_port: int) -> None:
    """Report whether ports of the loopback address can be had, and whether there is a display."""
    try:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            report.good(f"free ports for players, for example {free.getsockname()[1]}")
    except OSError as error:
        report.fail(f"no port of 127.0.0.1 can be had: {error}", "is the loopback interface up?")
    state = port_state(editor_port)
    if state == "free":
        report.good(f"port {editor_port} (Unity Editor) is free")
    else:
        report.warn(f"port {editor_port} (Unity Editor) is taken", CURES[state])
    if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        report.warn("DISPLAY is not set", CURES["display"])


def port_state(port: int) -> str:
    """Return "free", "TIME_WAIT" or "in use" for a port of the loopback address."""
    for reuse, verdict in ((0, "free"), (1, "TIME_WAIT")):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, reuse)
            try:
                probe.bind(("127.0.0.1", port))
                return verdict
            except OSError:
                continue
    return "in use"


def examine_player(report: Report, options: argparse.Namespace) -> None:
    """Start or await a player and report all that can be learned from it."""
    from mappo_unity.protocol.client import PlayerFailure, PlayerOptions, UnityPlayer
    from mappo_unity.protocol.process import find_executable

    executable = None
    if options.file_name:
        try:
            executable = find_executable(options.file_name, "--file-name")
        except ConfigError as error:
            return report.fail(str(error))
        report.good(f"executable {executable}")
    log_file = Path(tempfile.mkdtemp(prefix="mappo-doctor-")) / "Player.log"
    settings = PlayerOptions(
        executable,
        log_file,
        port=0 if executable else options.port,
        timeout_s=options.timeout_s,
        arguments=list(options.argument),
        no_graphics=options.no_graphics,
        engine={"time_scale": 20.0},
    )
    try:
        player = UnityPlayer(settings)
    except ConfigError as error:
        return report.fail(str(error), CURES["in use"])
    try:
        _examine_handshake(report, player)
        if _examine_behaviors(report, player):
            _examine_rhythm(report, player)
            _examine_contract(report, player)
            _examine_speed(report, player, options.seconds)
    except (PlayerFailure, EnvironmentFailure) as error:
        report.fail(str(error), _cure_of(player))
    finally:
        player.close()


def _cure_of(player: Any) -> str:
    if player.handshake is not None and not player.behavior_specs:
        return CURES["no behavior"]
    if player.process is None:
        return f"see Unity's Console, or the Editor's log: {editor_log()}"
    if player.handshake is not None:
        return ""  # the finding names the log
    return (
        f"{CURES['display']}; the build must be for this system, must not wait for a user, and needs an "
        "agent with Behavior Type Default"
    )


def editor_log() -> str:
    """Return where Unity's Editor writes its log on this system (Unity Manual, "Log files reference")."""
    places = {"darwin": "~/Library/Logs/Unity/Editor.log", "win32": r"%LOCALAPPDATA%\Unity\Editor\Editor.log"}
    return os.path.expanduser(os.path.expandvars(places.get(sys.platform, "~/.config/unity3d/Editor.log")))


def _examine_handshake(report: Report, player: Any) -> None:
    begin = time.perf_counter()
    player.connect()
    shake = player.handshake
    report.good(
        f"handshake after {time.perf_counter() - begin:.1f} s: {shake.name or 'unnamed'}, package "
        f"{shake.package_version or 'unknown'}, protocol {shake.communication_version}"
    )
    from mappo_unity.protocol.messages import CAPABILITIES

    missing = [name for name in CAPABILITIES if not getattr(shake.capabilities, name)]
    if missing:
        report.warn(f"capabilities missing: {', '.join(missing)}", CURES["old package"])
    else:
        report.good(f"all {len(CAPABILITIES)} capabilities")


def _examine_behaviors(report: Report, player: Any) -> bool:
    player.reset()
    for _ in range(PATIENCE_STEPS):
        if any(len(player.get_steps(name)[0]) for name in player.behavior_specs):
            break
        player.step()
    if not player.behavior_specs:
        report.fail(f"no behavior within {PATIENCE_STEPS} steps", CURES["no behavior"])
        return False
    for name, spec in player.behavior_specs.items():
        report.good(f"behavior {name}: {_actions(spec.action_spec)}")
        for i, sensor in enumerate(spec.observation_specs):
            report.good(f"  obs_{i} {tuple(sensor.shape)} {sensor.name}")
        decision = player.get_steps(name)[0]
        groups = sorted(set(map(int, decision.group_id)))
        alone = sum(int(group) == 0 for group in decision.group_id)
        teams = f"{len([g for g in groups if g])} teams" + (f", {alone} agents alone" if alone else "")
        report.good(f"  {len(decision)} agents ask: {teams}")
    return True


def _actions(spec: Any) -> str:
    parts = [f"{spec.continuous_size} continuous actions"] if spec.continuous_size else []
    if spec.discrete_branches:
        parts.append(f"discrete branches {tuple(int(n) for n in spec.discrete_branches)}")
    return " and ".join(parts) or "no actions"


def _examine_rhythm(report: Report, player: Any, steps: int = PATIENCE_STEPS) -> None:
    decisions = terminals = only_terminals = masked = 0
    for _ in range(steps):
        asked = ended = 0
        for name, spec in player.behavior_specs.items():
            decision, terminal = player.get_steps(name)
            asked, ended = asked + len(decision), ended + len(terminal)
            masked += sum(int(mask.sum()) for mask in decision.action_mask or [])
            player.set_actions(name, spec.action_spec.random_action(len(decision)))
        decisions, terminals = decisions + asked, terminals + ended
        only_terminals += int(not asked and ended > 0)
        player.step()
    if decisions:
        report.good(
            f"rhythm, random actions: {decisions / steps:.1f} decisions a step, {terminals} episodes ended, "
            f"{only_terminals} of {steps} steps with ends only, {masked} actions masked"
        )
    if decisions <= sum(len(player.get_steps(name)[0]) for name in player.behavior_specs):
        report.warn("nobody asked a second time", CURES["rhythm"])


def _examine_contract(report: Report, player: Any) -> None:
    from mappo_unity.scenes.core.contract import ContractError, check_env

    try:
        seen = check_env(player, steps=PATIENCE_STEPS)
    except ContractError as error:
        report.fail(
            f"contract checker: {error}", "an adapter cannot rely on such records; see the scene's scripts"
        )
    else:
        report.good(f"contract checker: {seen.steps} steps, {seen.terminals} ends as they should be")


def _examine_speed(report: Report, player: Any, seconds: float) -> None:
    for scale in TIME_SCALES:
        player.set_time_scale(scale)
        player.step()
        begin, steps, decisions = time.perf_counter(), 0, 0
        while (elapsed := time.perf_counter() - begin) < seconds:
            for name, spec in player.behavior_specs.items():
                count = len(player.get_steps(name)[0])
                player.set_actions(name, spec.action_spec.random_action(count))
                decisions += count
            player.step()
            steps += 1
        report.good(
            f"time scale {scale:g}: {steps / elapsed:.0f} steps/s, "
            f"{decisions / elapsed:.0f} agent decisions/s"
        )


def help_text() -> str:
    """Return what mappo-doctor --help prints."""
    return _parser().format_help()


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> Any:
        raise ConfigError(f"{message}; {self.format_usage().strip()}")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="mappo-doctor",
        description="Find out what keeps a Unity game from being trained on.",
        allow_abbrev=False,
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--file-name", metavar="GAME", help="a built Unity player, as env.file_name")
    what.add_argument("--editor", action="store_true", help="wait for the Unity Editor")
    parser.add_argument("--port", type=int, default=EDITOR_PORT, help="port for the Editor; default 5004")
    parser.add_argument("--timeout-s", type=float, default=60.0, help="patience with the player; default 60")
    parser.add_argument("--no-graphics", action="store_true", help="start the player without graphics")
    parser.add_argument("--argument", action="append", default=[], help="further argument of the player")
    parser.add_argument("--seconds", type=float, default=2.0, help="length of each speed test; default 2")
    return parser
