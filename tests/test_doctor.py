"""mappo-doctor finds what is wrong and names the cure."""

from __future__ import annotations

import re
import shlex
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fakes import Record, ScriptedEnv

from mappo_unity.cli import doctor_main
from mappo_unity.cli.doctor import CURES, diagnose, port_state
from mappo_unity.cli.examine.findings import Report
from mappo_unity.cli.examine.player import _examine_rhythm
from mappo_unity.cli.player import run as player_main
from mappo_unity.config.ranges import check_duration
from mappo_unity.errors import ConfigError

BAD_PLAYER = Path(__file__).with_name("bad_player.py")


def examine(*arguments: str) -> tuple[int, str]:
    lines: list[str] = []
    code = diagnose([*arguments, "--seconds", "0.05"], lines.append)
    return code, "\n".join(lines)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def bad_player(tmp_path: Path, mode: str, after: int) -> str:
    path = tmp_path / "Bad.x86_64"
    path.write_text(
        f'#!/bin/sh\nexec {shlex.join([sys.executable, str(BAD_PLAYER), mode, str(after)])} "$@"\n'
    )
    path.chmod(0o755)
    return str(path)


def test_a_sound_player_is_described(tmp_path: Path) -> None:
    player_main(["build", "3DBall", str(tmp_path), "--num-areas", "3"])
    code, text = examine("--file-name", str(tmp_path / "3DBall"), "--no-graphics")
    assert code == 0 and "FAIL" not in text
    for words in (
        "protobuf is compiled (upb)",
        "3DBall, package",
        "protocol 1.5.0",
        "all 7 capabilities",
        "behavior 3DBall?team=0: 2 continuous actions",
        "obs_0 (8,) VectorSensor_size8",
        "3 agents ask: 0 teams, 3 agents alone",
        "decisions a step",
        "contract checker",
        "time scale 1:",
        "time scale 100:",
    ):
        assert words in text, words


@pytest.mark.parametrize(
    ("mode", "after", "words"),
    [
        ("silent", 2, [CURES["no behavior"]]),
        ("exit", 0, ["exit code 7; its log"]),
        ("version", 0, ["speaks version '2.0.0'", CURES["old package"]]),
        ("hang", 2, ["DecisionRequester"]),
        ("crash", 9, ["killed by SIGKILL; its log", CURES["log"]]),
    ],
)
def test_a_sick_player_is_told_its_cure(tmp_path: Path, mode: str, after: int, words: list[str]) -> None:
    patience_s = "5" if mode == "hang" else "20"
    code, text = examine("--file-name", bad_player(tmp_path, mode, after), "--timeout-s", patience_s)
    assert code == 1 and "FAIL" in text
    assert all(part in text for part in words), text


@pytest.mark.parametrize(("again", "warnings"), [(False, 1), (True, 0)])
def test_agents_that_ask_only_once_are_told(again: bool, warnings: int) -> None:
    lines: list[str] = []
    report = Report(lines.append)
    env = ScriptedEnv(
        [[Record(1), Record(2)], [Record(1, ends="terminated")], [Record(2)] if again else [], []]
    )
    env.reset()
    _examine_rhythm(report, env, steps=3)

    per_step = 1.0 if again else 0.7
    assert f"{per_step} decisions a step, 1 episodes ended, 1 of 3 steps with ends only" in lines[0]
    assert report.warnings == warnings and ("second time" in lines[-1]) == (not again)


def test_a_player_without_a_log_is_not_said_to_have_one(tmp_path: Path) -> None:
    game = tmp_path / "Mute.x86_64"
    game.write_text("#!/bin/sh\nexit 3\n")
    game.chmod(0o755)
    code, text = examine("--file-name", str(game))
    assert code == 1 and "exit code 3; it printed and logged nothing" in text and "its log" not in text


def test_files_that_are_no_players(tmp_path: Path) -> None:
    code, text = examine("--file-name", str(tmp_path / "Nothing"))
    assert code == 1 and "no Unity player is there" in text
    (tmp_path / "Game.x86_64").write_text("")
    code, text = examine("--file-name", str(tmp_path / "Game"))
    assert code == 1 and "chmod +x" in text
    (tmp_path / "Game.x86_64").chmod(0o755)
    code, text = examine("--file-name", str(tmp_path / "Game"))
    assert code == 1 and "cannot be run on this system: it is empty" in text
    code, text = examine("--file-name", "")
    assert code == 1 and "--file-name= is empty" in text


def test_a_taken_port_is_one_finding_and_no_line_of_grpc(capfd: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        code, text = examine("--editor", "--port", str(port))
    assert code == 1 and f"port {port} of 127.0.0.1 is in use" in text and "(--port) on both sides" in text
    assert capfd.readouterr().err == ""


def test_nothing_is_left_of_a_sound_player(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "doctor"
    monkeypatch.setattr("mappo_unity.cli.examine.player.tempfile.mkdtemp", lambda prefix: str(folder))
    monkeypatch.setattr(
        "mappo_unity.cli.examine.player._examine_running",
        lambda report, options, game, log: log.parent.mkdir(),
    )
    (tmp_path / "Game").write_text("#!/bin/sh\n")
    (tmp_path / "Game").chmod(0o755)
    assert examine("--file-name", str(tmp_path / "Game"))[0] == 0 and not folder.exists()


def test_an_opengl_that_keeps_mujoco_from_loading(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")

    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr("mappo_unity.scenes.mujoco_check.importlib.import_module", fail)
    code, text = examine()
    assert code == 1 and "environment variable MUJOCO_GL=osmesa ('NoneType' object has no attribute" in text
    assert "unset it, or set it to egl or osmesa and install that" in text


def test_the_editor_presses_play(tmp_path: Path) -> None:
    player_main(["build", "3DBall", str(tmp_path), "--num-areas", "2"])
    port = free_port()
    play = subprocess.Popen(
        [tmp_path / "3DBall.x86_64", "--mlagents-port", str(port)], stdout=subprocess.DEVNULL
    )
    try:
        code, text = examine("--editor", "--port", str(port), "--timeout-s", "20")
        assert code == 0 and "2 agents ask" in text
        assert play.wait(20) == 0
    finally:
        play.kill()


def test_an_editor_that_never_plays() -> None:
    code, text = examine("--editor", "--port", str(free_port()), "--timeout-s", "0.3")
    assert code == 1 and "press Play" in text
    assert (
        re.search(r"see Unity's Console, or the Editor's log: /.*Editor\.log", text) and "its log" not in text
    )


def test_ports_in_use_are_told_from_ports_that_linger() -> None:
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as gRPC's servers do
        server.bind(("127.0.0.1", 0))
        server.listen()
        port = server.getsockname()[1]
        assert port_state(port) == "in use"
        client = socket.create_connection(("127.0.0.1", port))
        accepted, _ = server.accept()
    accepted.close()  # the side that closes first is the one in TIME_WAIT
    client.close()
    assert port_state(port) == "TIME_WAIT"
    assert port_state(free_port()) == "free"
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen()
        _, text = examine("--port", str(server.getsockname()[1]))
        assert CURES["in use"] in text


def test_slow_protobuf_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("google.protobuf.internal.api_implementation.Type", lambda: "python")
    code, text = examine()
    assert code == 1 and CURES["protobuf"] in text


def test_a_missing_protobuf_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google.protobuf.internal", None)
    code, text = examine()
    assert code == 1 and "FAIL  protobuf cannot be imported (" in text and "ports and display" in text

    monkeypatch.setitem(sys.modules, "mappo_unity.protocol.client", None)
    code, text = examine("--editor")
    assert code == 1 and "FAIL  no player can be examined (" in text and "2 failed" in text


def test_mistakes_in_the_options(capsys: Any) -> None:
    assert doctor_main(["--fil-name", "Game"]) == 2
    assert doctor_main(["--file-name", "Game", "--editor"]) == 2
    assert "not allowed with" in capsys.readouterr().err
    for lines, words in (
        (["--fil-name", "Game"], "--fil-name is not an option of mappo-doctor (did you mean --file-name?)"),
        (["--port", "many"], "--port: 'many' is not a whole number"),
        (["--seconds", "x"], "--seconds: 'x' is not a number"),
        (["--port", "1", "--port", "2"], "--port is given twice, 1 and 2"),
        (["Game"], "(did you mean --file-name Game?)"),
        (["env.file_name=Game"], "(did you mean --file-name Game?)"),
        (["--no-graphics"], "--no-graphics is for a player that is started: it needs --file-name GAME"),
        (["--editor", "--argument=x"], "--argument is for a player that is started"),
    ):
        assert doctor_main(lines) == 2
        told = capsys.readouterr().err
        assert words in told and told.count("\n") == 1, told
    assert doctor_main(["--help"]) == 0
    assert "--timeout-s" in capsys.readouterr().out


def test_a_run_s_folder_alone_is_a_run_meant(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").touch()
    with pytest.raises(ConfigError, match=f"did you mean run={tmp_path}"):
        diagnose([str(tmp_path)], print)


@pytest.mark.parametrize(
    ("option", "value"),
    [("--port", "99999"), ("--timeout-s", "-1"), ("--timeout-s", "nan"), ("--seconds", "0")],
)
def test_options_out_of_range_are_named(option, value):
    with pytest.raises(ConfigError, match=f"{option} {value} is out of range: it must be"):
        diagnose(["--editor", option, value], print)


def test_a_duration_must_be_finite() -> None:
    for value, words in ((float("inf"), "must be > 0 and finite"), (0.0, "must be > 0 and finite")):
        with pytest.raises(ConfigError, match=f"--timeout {value:g} is out of range: it {words}$"):
            check_duration("--timeout", value)
