"""What mappo-doctor learns from a player or the Editor: its handshake, behaviors, rhythm and speed."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from mappo_unity.cli.examine.findings import CURES, Report
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.protocol.ports import check_port

TIME_SCALES = (1.0, 20.0, 100.0)
PATIENCE_STEPS = 200  # environment steps within which some agent should request a decision


def examine_player(report: Report, options: argparse.Namespace) -> None:
    """Start or await a player and report all that can be learned from it."""
    from mappo_unity.protocol.process import find_executable

    executable = None
    try:
        if options.editor:
            check_port(options.port, "--port")
        else:
            executable = find_executable(options.file_name, "--file-name")
            report.good(f"executable {executable}")
    except ConfigError as error:  # says what to do
        return report.mistake(error)

    folder = Path(tempfile.mkdtemp(prefix="mappo-doctor-"))
    try:
        _examine_running(report, options, executable, folder / "Player.log")
    finally:
        if not report.failures:  # else a finding may name the log in it
            shutil.rmtree(folder, ignore_errors=True)


def _examine_running(
    report: Report, options: argparse.Namespace, executable: Path | None, log_file: Path
) -> None:
    from mappo_unity.protocol.client import UnityPlayer
    from mappo_unity.protocol.player_failures import PlayerFailure
    from mappo_unity.protocol.player_options import PlayerOptions

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
    except PlayerFailure as error:
        return report.fail(str(error), CURES["not started"])

    # in this order: each part needs what the one before it has shown to work
    try:
        _examine_handshake(report, player)
        if _examine_behaviors(report, player):
            _examine_rhythm(report, player)
            _examine_contract(report, player)
            _examine_speed(report, player, options.seconds)
    except (PlayerFailure, EnvironmentFailure) as error:
        report.fail(str(error), _cure_of(player, error))
    finally:
        player.close()


def _cure_of(player: Any, error: Exception) -> str:
    from mappo_unity.protocol.player_failures import ProtocolMismatch

    if isinstance(error, ProtocolMismatch):
        return CURES["old package"]

    if player.handshake is not None and not player.behavior_specs:
        return CURES["no behavior"]

    # nothing was started here: it is the Editor that was waited for
    if player.process is None:
        return f"see Unity's Console, or the Editor's log: {editor_log()}"

    if player.handshake is not None:
        return CURES["log"]  # the finding names it

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

    # behaviors show up with their first agent, which may request a decision some steps after the reset
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
        # group 0 stands for an agent without a team
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
    decisions, ends, masked = [], [], 0  # decisions and ends of each step

    for _ in range(steps):
        asked = ended = 0
        for name, spec in player.behavior_specs.items():
            decision, terminal = player.get_steps(name)
            asked, ended = asked + len(decision), ended + len(terminal)
            masked += sum(int(mask.sum()) for mask in decision.action_mask or [])
            player.set_actions(name, spec.action_spec.random_action(len(decision)))

        decisions.append(asked)
        ends.append(ended)
        player.step()

    if any(decisions):
        only_ends = sum(not asked and ended > 0 for asked, ended in zip(decisions, ends, strict=True))
        report.good(
            f"rhythm, random actions: {sum(decisions) / steps:.1f} decisions a step, {sum(ends)} episodes "
            f"ended, {only_ends} of {steps} steps with ends only, {masked} actions masked"
        )

    if not any(decisions[1:]):
        report.warn("nobody asked a second time", CURES["rhythm"])


def _examine_contract(report: Report, player: Any) -> None:
    from mappo_unity.scenes.contract.check import ContractError, check_env

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
        # the new scale holds from this step on
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
