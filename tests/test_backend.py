"""Players below the BaseEnv seam: connection, failures, restarts, several at once, registry, no orphans."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mappo_unity.cli import train_main
from mappo_unity.cli.player import run as player_main
from mappo_unity.config.parameters.samplers import Sampler
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs.backends import PLAYER_STRIDE, make_env_function
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.protocol.parallel_players import SeveralPlayers
from mappo_unity.protocol.ports import FORBIDDEN, check_port
from mappo_unity.protocol.process import find_executable
from mappo_unity.protocol.restarting_player import SEED_STRIDE, RestartingPlayer
from mappo_unity.protocol.server import Link
from mappo_unity.scenes import make_scene

from mlagents_envs.base_env import ActionTuple, BaseEnv  # isort: skip  # mappo_unity lets it import

BALL = "3DBall?team=0"
BAD_PLAYER = Path(__file__).with_name("bad_player.py")


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A built 3DBall."""
    folder = tmp_path_factory.mktemp("build")
    player_main(["build", "3DBall", str(folder)])
    return str(folder / "3DBall")


@pytest.fixture
def bad(tmp_path: Path) -> Callable[[str, int], str]:
    """Return a function that builds a player which misbehaves after some messages."""

    def build_bad(mode: str, after: int) -> str:
        path = tmp_path / f"{mode}.x86_64"
        command = shlex.join([sys.executable, str(BAD_PLAYER), mode, str(after)])
        path.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        path.chmod(0o755)
        return str(path)

    return build_bad


def options(file_name: str, tmp_path: Path, **more: Any) -> EnvConfig:
    defaults: dict[str, Any] = {"num_areas": 2, "timeout_s": 30.0, "player_logs": str(tmp_path / "logs")}
    return EnvConfig(backend=Backend.player, file_name=file_name, **(defaults | more))


def shell_player(folder: Path, script: str) -> str:
    """Return a player that is a shell script."""
    path = folder / "Shell.x86_64"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


def act_and_step(env: BaseEnv) -> None:
    count = len(env.get_steps(BALL)[0])
    env.set_actions(BALL, ActionTuple(np.zeros((count, 2), np.float32)))
    env.step()


def is_running(pid: int) -> bool:
    """Tell whether a process runs; one that ended but was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def wait_until(holds: Callable[[], bool], seconds: float = 20.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if holds():
            return True
        time.sleep(0.05)
    return False


class TestPlayer:
    """One player that works."""

    def test_it_draws_from_samplers_as_the_embedded_scene(self, build: str, tmp_path: Path) -> None:
        done = {"measure": "progress", "threshold": 0.5}
        first = {"sampler": "uniform", "min": 0.5, "max": 2}
        scale = {"lessons": [{"value": first, "completion": done}, {"value": 1}]}
        player = make_env_function(options(build, tmp_path, params={"scale": scale}))(5)
        scene: Any = make_env_function(EnvConfig(num_areas=2, params={"scale": scale}))(5)
        later = Sampler("multirangeuniform", (0.5, 0.75, 3.0, 3.5))

        sizes = set()
        with contextlib.closing(player):
            for env in (player, scene):
                env.reset()
            for step in range(60):
                mine, theirs = (env.get_steps(BALL)[0].obs[0] for env in (player, scene))
                np.testing.assert_array_equal(mine, theirs)
                for env in (player, scene):
                    if step == 30:
                        env.set_parameter("scale", later)
                    env.reset() if step == 40 else act_and_step(env)
                sizes |= set(scene.scale.tolist())
        assert len(sizes) > 3 and max(sizes) > 2

    def test_several_players_and_a_restarted_one_are_told_a_new_value(
        self, build: str, tmp_path: Path
    ) -> None:
        cfg = options(
            build, tmp_path, num_players=2, params={"scale": {"sampler": "uniform", "min": 1, "max": 2}}
        )
        players = make_env_function(cfg)(5)
        assert isinstance(players, SeveralPlayers)
        with contextlib.closing(players):
            players.reset()
            players.set_parameter("scale", 3.0)
            process = players.players[1].player.process
            assert process is not None
            process.kill()
            act_and_step(players)
            assert players.restarts == 1
        for log in ("Player-0.log", "Player-1-restart-1.log"):
            assert "environment parameter scale = 3" in (tmp_path / "logs" / log).read_text()

    def test_the_same_seed_gives_the_embedded_trajectory(self, build: str, tmp_path: Path) -> None:
        player = make_env_function(options(build, tmp_path, params={"mass": 2.0}))(7)
        scene = make_scene("3DBall", seed=7, num_areas=2, mass=2.0)
        rng = np.random.default_rng(0)
        try:
            player.reset()
            scene.reset()
            assert dict(player.behavior_specs) == dict(scene.behavior_specs)
            for step in range(120):
                for mine, theirs in zip(player.get_steps(BALL), scene.get_steps(BALL), strict=True):
                    for name in ("reward", "agent_id", "group_id"):
                        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
                    np.testing.assert_array_equal(mine.obs[0], theirs.obs[0])
                action = rng.uniform(-1, 1, (len(scene.get_steps(BALL)[0]), 2)).astype(np.float32)
                for env in (player, scene):
                    env.set_actions(BALL, ActionTuple(action))
                    env.reset() if step == 60 else env.step()
        finally:
            player.close()
        assert "mass = 2" in (tmp_path / "logs" / "Player-0.log").read_text()

    def test_only_the_loopback_address_is_listened_on(self) -> None:
        link = Link()
        try:
            addresses = {
                str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)
            }
            addresses |= {"127.0.0.2"}  # of this machine too, on Linux
            with socket.create_connection(("127.0.0.1", link.port), timeout=5):
                pass
            for address in addresses - {"127.0.0.1"}:
                with pytest.raises(OSError), socket.create_connection((address, link.port), timeout=5):
                    pass
            with pytest.raises(OSError), socket.create_connection(("::1", link.port), timeout=5):
                pass
        finally:
            link.close()

    def test_a_second_caller_is_turned_away(self) -> None:
        import grpc

        from mappo_unity.protocol.messages import METHOD

        link = Link()
        try:
            with grpc.insecure_channel(f"127.0.0.1:{link.port}") as first:
                pending = first.unary_unary(METHOD).future(b"hello")
                assert link.receive(10) == b"hello"
                local_pool = (("grpc.use_local_subchannel_pool", 1),)  # a connection of its own
                with grpc.insecure_channel(f"127.0.0.1:{link.port}", local_pool) as second:
                    with pytest.raises(grpc.RpcError, match="has a player already"):
                        second.unary_unary(METHOD)(b"intruder", timeout=10)
                link.reply(b"answer")
                assert pending.result(10) == b"answer"
        finally:
            link.close()

    def test_links_never_share_a_port(self) -> None:
        links = [Link() for _ in range(20)]
        try:
            assert len({link.port for link in links}) == 20
            with pytest.raises(ConfigError, match=f"port {links[0].port} of 127.0.0.1 is in use"):
                Link(links[0].port)
        finally:
            for link in links:
                link.close()

    def test_closing_leaves_no_process(self, build: str, tmp_path: Path) -> None:
        env = make_env_function(options(build, tmp_path))(0)
        assert isinstance(env, RestartingPlayer) and env.player.process is not None
        pid = env.player.process.pid
        env.reset()
        assert is_running(pid)
        env.close()
        env.close()
        assert not is_running(pid)


class TestFailures:
    """Players that crash, hang, leave or send nonsense."""

    @pytest.mark.parametrize(
        ("mode", "words"),
        [
            ("crash", "killed by SIGKILL"),
            ("exit", "exit code 7"),
            ("hang", r"did not answer within env.timeout_s=6"),
            ("close", "closed the connection: Academy was destroyed"),
            ("malformed", "sent a malformed message of 4 bytes"),
            ("nan", "agent 1: its sensor obs_0 holds nan"),
            ("statistics", "sent a malformed message"),
            ("engine", "sent a malformed message"),
        ],
    )
    def test_it_is_restarted_and_its_episodes_are_cut_off(
        self, bad: Any, tmp_path: Path, caplog: Any, mode: str, words: str
    ) -> None:
        timeout = 6.0 if mode == "hang" else 30.0  # a player also starts within it, on a busy machine
        env = make_env_function(options(bad(mode, 6), tmp_path, max_restarts=1, timeout_s=timeout))(3)
        assert isinstance(env, RestartingPlayer)
        with caplog.at_level(logging.WARNING):
            env.reset()
            first = env.get_steps(BALL)[0]
            steps = 0
            while not env.restarts:
                before = env.get_steps(BALL)[0]
                assert not env.crashed_agents
                act_and_step(env)
                steps += 1
                assert steps < 30
        decision, terminal = env.get_steps(BALL)
        assert (
            env.crashed_agents[BALL].tolist()
            == [0, 1]
            == terminal.agent_id.tolist()
            == decision.agent_id.tolist()
        )
        assert terminal.interrupted.all() and not terminal.reward.any()
        np.testing.assert_array_equal(terminal.obs[0], before.obs[0])
        fresh = make_scene("3DBall", seed=3 + SEED_STRIDE, num_areas=2)
        fresh.reset()
        np.testing.assert_array_equal(decision.obs[0], fresh.get_steps(BALL)[0].obs[0])
        assert not np.array_equal(decision.obs[0], first.obs[0])
        assert re.search(words, caplog.text) and "restart 1 of at most 1" in caplog.text
        logs = tmp_path / "logs"
        assert f"its log: {logs / 'Player-0.log'}" in caplog.text
        assert {log.name for log in logs.glob("*.log")} == {"Player-0.log", "Player-0-restart-1.log"}
        act_and_step(env)
        assert not env.crashed_agents and not len(env.get_steps(BALL)[1])
        with pytest.raises(
            EnvironmentFailure, match="restarted 1 times, and env.max_restarts=1 allows no more"
        ):
            for _ in range(30):
                act_and_step(env)
        env.close()

    def test_a_stopped_process_is_ended_and_replaced(self, build: str, tmp_path: Path) -> None:
        env = make_env_function(options(build, tmp_path, timeout_s=6.0, max_restarts=3))(0)
        assert isinstance(env, RestartingPlayer)
        env.reset()
        process = env.player.process
        assert process is not None
        os.kill(process.pid, signal.SIGSTOP)
        act_and_step(env)
        assert env.restarts == 1 and not is_running(process.pid)
        env.close()

    def test_pauses_grow_with_failures_in_a_row(self) -> None:
        from mappo_unity.protocol.restarting_player import _pause_s

        assert [_pause_s(n) for n in range(5)] == [0, 0.5, 1, 2, 4]
        assert _pause_s(50) == 10

    @pytest.mark.parametrize(
        ("mode", "after", "words"),
        [
            ("version", 0, "speaks version '2.0.0' of the ML-Agents protocol .package 9.9.9.*1.5.0"),
            ("exit", 0, "ended while it started: exit code 7; its log: .*Player-0"),
            ("hang", 0, "did not connect within env.timeout_s=6: it may need env.no_graphics=true"),
            ("hang", 2, "did not answer within env.timeout_s=6: no agent requested.*DecisionRequester"),
        ],
    )
    def test_a_player_that_never_worked_is_a_mistake_in_the_options(
        self, bad: Any, tmp_path: Path, mode: str, after: int, words: str
    ) -> None:
        with pytest.raises(ConfigError, match=words):
            make_env_function(options(bad(mode, after), tmp_path, timeout_s=6.0))(0).reset()

    @pytest.mark.parametrize(
        ("script", "words"),
        [
            ("exit 3", "ended while it started: exit code 3; it printed and logged nothing$"),
            (
                "echo one; echo two; echo; printf '\\033libfoo.so: not found\\n' >&2; echo four; exit 3",
                r"it wrote no log, but printed \(.*/Player-0.out\): two \| libfoo.so: not found \| four$",
            ),
            ("sleep 100", "did not connect within env.timeout_s=1: .*; it printed and logged nothing$"),
            (
                'while [ "$1" != -logFile ]; do shift; done; echo text > "$2"; exit 3',
                "; its log: .*/Player-0.log$",
            ),
        ],
    )
    def test_what_it_left_to_read_is_named(self, tmp_path: Path, script: str, words: str) -> None:
        with pytest.raises(ConfigError, match=words):
            make_env_function(options(shell_player(tmp_path, script), tmp_path, timeout_s=1.0))(0)

    def test_a_log_that_the_user_chose_is_named(self, tmp_path: Path) -> None:
        mine = tmp_path / "mine.log"
        cfg = options(
            shell_player(tmp_path, f"echo text > {mine}"), tmp_path, player_args=["-logFile", str(mine)]
        )
        with pytest.raises(ConfigError, match=f"; its log: {mine}$"):
            make_env_function(cfg)(0)

    def test_a_file_that_the_system_cannot_execute(self, tmp_path: Path) -> None:
        game = Path(shell_player(tmp_path, ""))
        game.write_bytes(b"\x7fELF but not really")
        with pytest.raises(ConfigError, match=f"printed .*: {game} cannot be executed: Exec format error$"):
            make_env_function(options(str(game), tmp_path))(0)

    def test_behaviors_that_never_appear_are_missed(
        self, bad: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        from mappo_unity.envs import unity_env

        monkeypatch.setattr(unity_env, "MAX_SILENT_STEPS", 50)
        with pytest.raises(ConfigError, match="no behavior with an agent that requests"):
            unity_env.UnityEnv(make_env_function(options(bad("silent", 2), tmp_path)))


class TestEnds:
    """However the trainer ends, the player does too."""

    SCRIPT = """
import sys, time
from mappo_unity.envs.backends import make_env_function
from mappo_unity.config.schema import Backend, EnvConfig
env = make_env_function(EnvConfig(
    backend=Backend.player, file_name=sys.argv[1], player_logs=sys.argv[2], timeout_s=60, num_players=2))(0)
env.reset()
print(*[p.player.process.pid for p in env.players], flush=True)
if sys.argv[3] == "exit":
    sys.exit(0)
if sys.argv[3] == "raise":
    raise RuntimeError("on purpose")
while True:
    env.step()
"""

    @pytest.mark.skipif(not sys.platform.startswith("linux"), reason="a stopped player lives on elsewhere")
    @pytest.mark.parametrize("way", ["SIGKILL", "SIGTERM", "SIGINT", "exit", "raise", "stopped player"])
    def test_no_player_is_left(self, build: str, tmp_path: Path, way: str) -> None:
        trainer = subprocess.Popen(
            [sys.executable, "-c", self.SCRIPT, build, str(tmp_path), way],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert trainer.stdout is not None
        pids = [int(word) for word in trainer.stdout.readline().split()]
        assert len(pids) == 2
        if way == "stopped player":
            os.kill(pids[0], signal.SIGSTOP)
        if way not in ("exit", "raise"):
            assert all(is_running(pid) for pid in pids)
            trainer.send_signal(getattr(signal, way, signal.SIGKILL))
        assert trainer.wait(30) != (0 if way != "exit" else 1)
        assert wait_until(lambda: not any(is_running(pid) for pid in pids))


class TestSeveral:
    """Two players as one environment."""

    def test_agents_of_both_stand_side_by_side(self, build: str, tmp_path: Path) -> None:
        env = make_env_function(options(build, tmp_path, num_players=2))(5)
        scenes = [make_scene("3DBall", seed=5 + n * PLAYER_STRIDE, num_areas=2) for n in range(2)]
        rng = np.random.default_rng(0)
        try:
            env.reset()
            for scene in scenes:
                scene.reset()
            for _ in range(60):
                decision, terminal = env.get_steps(BALL)
                parts = [scene.get_steps(BALL) for scene in scenes]
                for mine, index in ((decision, 0), (terminal, 1)):
                    theirs = [part[index] for part in parts]
                    np.testing.assert_array_equal(mine.obs[0], np.concatenate([s.obs[0] for s in theirs]))
                    ids = [2 * agent + n for n, s in enumerate(theirs) for agent in s.agent_id.tolist()]
                    assert mine.agent_id.tolist() == ids
                actions = [rng.uniform(-1, 1, (len(d), 2)).astype(np.float32) for d, _ in parts]
                env.set_actions(BALL, ActionTuple(np.concatenate(actions)))
                env.step()
                for scene, action in zip(scenes, actions, strict=True):
                    scene.set_actions(BALL, ActionTuple(action))
                    scene.step()
        finally:
            env.close()
        assert (tmp_path / "logs" / "Player-0.log").exists() and (tmp_path / "logs" / "Player-1.log").exists()

    def test_one_that_dies_is_replaced_and_the_other_plays_on(self, build: str, tmp_path: Path) -> None:
        env = make_env_function(options(build, tmp_path, num_players=2))(5)
        assert isinstance(env, SeveralPlayers)
        env.reset()
        victim = env.players[1].player.process
        assert victim is not None
        os.kill(victim.pid, signal.SIGKILL)
        act_and_step(env)
        decision, terminal = env.get_steps(BALL)
        assert env.restarts == 1 and env.crashed_agents[BALL].tolist() == [1, 3] == terminal.agent_id.tolist()
        assert sorted(decision.agent_id.tolist()) == [0, 1, 2, 3]
        env.close()

    def test_groups_of_two_players_stay_apart(self) -> None:
        env = SeveralPlayers([None, None])  # type: ignore[list-item]
        ids = [env._groups(np.array([0, 1, 2]), player).tolist() for player in range(2)]
        assert ids == [[0, 1, 3], [0, 2, 4]]


class TestEditor:
    """The Editor presses Play: here mappo-player does."""

    def test_it_connects_and_says_what_it_waits_for(self, build: str, caplog: Any) -> None:
        port = free_port()
        play = subprocess.Popen([f"{build}.x86_64", "--mlagents-port", str(port)], stdout=subprocess.DEVNULL)
        try:
            with caplog.at_level(logging.WARNING):
                env = make_env_function(EnvConfig(backend=Backend.editor, port=port, timeout_s=30))(0)
            assert f"Unity Editor on port {port}: press Play" in caplog.text
            env.reset()
            assert len(env.get_steps(BALL)[0]) == 12
            env.close()
            assert play.wait(20) == 0
        finally:
            play.kill()

    def test_an_editor_that_never_comes(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        port = free_port()
        with pytest.raises(
            ConfigError, match=f"did not connect to port {port} within env.timeout_s=0.5: press"
        ):
            make_env_function(EnvConfig(backend=Backend.editor, port=port, timeout_s=0.5))(0)
        assert not list(tmp_path.iterdir()), "its log is its own, and needs no folder"

    def test_a_port_in_use(self, capfd: pytest.CaptureFixture[str]) -> None:
        with socket.socket() as holder:
            holder.bind(("127.0.0.1", 0))
            holder.listen()
            port = holder.getsockname()[1]
            with pytest.raises(ConfigError, match=f"port {port} of 127.0.0.1 is in use"):
                make_env_function(EnvConfig(backend=Backend.editor, port=port, timeout_s=1))(0)
        assert capfd.readouterr().err == ""  # no line of gRPC's

    def test_a_port_that_this_user_may_not_have(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("mappo_unity.protocol.ports.port_state", lambda port: FORBIDDEN)
        with pytest.raises(
            ConfigError, match=r"port 80 of 127.0.0.1 may not be listened on.*1024 up \(env.port\)"
        ):
            check_port(80, "env.port")


class TestRegistry:
    """A registry on this disk, with a player in a zip."""

    @pytest.fixture
    def registry(self, build: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "cache"))
        (tmp_path / "cache").mkdir()
        archive = tmp_path / "ball.zip"
        with zipfile.ZipFile(archive, "w") as file:
            file.write(f"{build}.x86_64", "Ball/Ball.x86_64")
        path = tmp_path / "registry.yaml"
        entry = "    expected_reward: 100\n    description: a ball\n    darwin_url: null\n    win_url: null\n"
        path.write_text(
            f"environments:\n- Ball:\n{entry}    linux_url: {archive.as_uri()}\n"
            f"- Broken:\n{entry}    linux_url: {(tmp_path / 'absent.zip').as_uri()}\n"
            f"- Heavy:\n{entry}    linux_url: {archive.as_uri()}\n"
            "    additional_args: [--param, mass=3, --level, 3]\n"
            f"- Text:\n{entry}    linux_url: {archive.as_uri()}\n    additional_args: --level 3\n"
        )
        return path

    def test_an_entry_is_fetched_and_played(self, registry: Path, capfd: Any) -> None:
        cfg = EnvConfig(name="Ball", backend=Backend.registry, registry=str(registry), num_areas=2)
        env = make_env_function(cfg)(0)
        env.reset()
        assert len(env.get_steps(BALL)[0]) == 2
        env.close()
        assert not capfd.readouterr().out

    def test_an_entry_s_arguments_come_behind_the_command_line_s(
        self, registry: Path, tmp_path: Path
    ) -> None:
        cfg = EnvConfig(
            name="Heavy",
            backend=Backend.registry,
            registry=str(registry),
            player_args=["--speed", "5"],
            player_logs=str(tmp_path / "logs"),
        )
        env = make_env_function(cfg)(0)
        env.close()
        assert isinstance(env, RestartingPlayer)
        assert env.player.options.arguments == ["--speed", "5", "--param", "mass=3", "--level", "3"]
        log = (tmp_path / "logs" / "Player-0.log").read_text()
        assert "accepted and without effect" in log and "--speed 5 --level 3" in log

    def test_entries_that_do_not_exist_or_give_nothing(self, registry: Path, tmp_path: Path) -> None:
        cfg = {"backend": Backend.registry, "registry": str(registry)}
        with pytest.raises(ConfigError, match="has no entry 'Bal'; choices: Ball, Broken, Heavy, Text"):
            make_env_function(EnvConfig(registry_entry="Bal", **cfg))  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="entry 'Broken'.*absent.zip gives no player"):
            make_env_function(EnvConfig(registry_entry="Broken", **cfg))  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="additional_args is '--level 3'; it must be a list"):
            make_env_function(EnvConfig(registry_entry="Text", **cfg))  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="cannot be read"):
            make_env_function(EnvConfig(backend=Backend.registry, registry=str(tmp_path / "no.yaml")))


class Simulator:
    """What a user's factory might make: it fails, inside code of ours and out of another error."""

    def __init__(self, seed: int, size: int) -> None:
        try:
            make_scene("3DBall", seed=seed, num_areas=2).set_actions(BALL, None)  # type: ignore[arg-type]
        except AttributeError as error:
            raise ValueError(f"size {size}\n is bad") from error


class TestCustom:
    """A factory of the user's, which may do anything."""

    def test_what_it_raised_and_where(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
    ) -> None:
        monkeypatch.chdir(tmp_path)
        factory = "env.factory=test_backend:Simulator"
        assert train_main(["env=custom", factory, "env.params.size=3"]) == 2
        first, *details = capsys.readouterr().err.splitlines()
        assert first == f"mappo-train: {factory} raised ValueError: size 3 is bad"
        frames = [line for line in details if line.startswith("  File")]
        assert sum(__file__ in line for line in frames) == 2
        assert not any("/mappo_unity/" in line for line in frames)
        assert sum(line.startswith("Traceback") for line in details) == 2
        assert any(line.startswith("AttributeError") for line in details)

    @pytest.mark.parametrize(
        ("factory", "words"),
        [
            ("test_backend:free_port", r"cannot be called with seed and size: .*'seed'; it is free_port\(\)"),
            (
                "test_backend:options",
                "cannot be called with seed and size: missing a required argument: 'file_name'",
            ),
            ("builtins:dict", "returned a dict; it must return a mlagents_envs.base_env.BaseEnv"),
            ("test_backend:refuse", "^size=3 is odd$"),
            (
                "broken_by_hand:make",
                "the module broken_by_hand cannot be imported: it raised ZeroDivisionError: ",
            ),
            (
                "absent_module:make",
                "the module absent_module cannot be imported: it raised ModuleNotFoundError: ",
            ),
        ],
    )
    def test_other_ways_to_fail(
        self, factory: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "broken_by_hand.py").write_text("1 / 0\n")
        monkeypatch.syspath_prepend(tmp_path)
        with pytest.raises(ConfigError, match=words) as caught:
            make_env_function(EnvConfig(backend=Backend.custom, factory=factory, params={"size": 3}))(0)
        assert "\n" not in str(caught.value)
        if factory.startswith("broken"):
            assert [line for line in caught.value.details if "File" in line] == [
                f'  File "{tmp_path}/broken_by_hand.py", line 1, in <module>'
            ]

    @pytest.mark.parametrize("backend", [Backend.custom, Backend.embedded])
    def test_the_seed_is_no_parameter(self, backend: Backend) -> None:
        factory = "test_backend:refuse" if backend is Backend.custom else None
        cfg = EnvConfig(name="3DBall", backend=backend, factory=factory, params={"seed": 3})
        with pytest.raises(ConfigError, match="env.params.seed=3: .* use seed=N$"):
            make_env_function(cfg)

    def test_the_number_of_areas_is_no_parameter_of_a_scene(self) -> None:
        with pytest.raises(
            ConfigError, match="env.params.num_areas=3 is no parameter .* use env.num_areas=N$"
        ):
            make_env_function(EnvConfig(name="Basic", params={"num_areas": 3}))

    def test_a_failure_of_its_own_passes(self) -> None:
        cfg = EnvConfig(backend=Backend.custom, factory="test_backend:refuse", params={"size": 2})
        with pytest.raises(EnvironmentFailure, match="^the simulator is gone$"):
            make_env_function(cfg)(0)


def refuse(seed: int, size: int) -> None:
    """Stand for a factory that knows our errors."""
    if size % 2:
        raise ConfigError(f"size={size} is odd")
    raise EnvironmentFailure("the simulator is gone")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class TestOptions:
    """Mistakes that are seen before anything starts."""

    def test_files_that_are_no_players(self, build: str, tmp_path: Path) -> None:
        with pytest.raises(
            ConfigError, match="no Unity player is there; looked for .*Gaem with .x86_64.*3DBall"
        ):
            make_env_function(options(str(Path(build).with_name("Gaem")), tmp_path))
        plain = tmp_path / "My Game.x86_64"
        plain.write_text("")
        with pytest.raises(ConfigError, match="is not executable; run: chmod .x '/.*My Game.x86_64'"):
            make_env_function(options(str(plain), tmp_path))

    @pytest.mark.skipif(os.name == "nt", reason="what is said of files differs there")
    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"", "cannot be run on this system: it is empty"),
            (b"echo hello\n", "it is a text without a first line such as #!/bin/sh"),
            (b"#!/no/such/shell -e\n", "it is a script for '/no/such/shell -e', which is not there"),
            (b"#!/bin/sh\r\nexit 3\r\n", r"it is a script for '/bin/sh\\r', which is not there"),
            (b"MZ\x90\x00", "it is built for Windows; build one for this system"),
        ],
    )
    def test_files_that_this_system_cannot_run(self, tmp_path: Path, content: bytes, words: str) -> None:
        game = tmp_path / "Game"
        game.write_bytes(content)
        game.chmod(0o755)
        with pytest.raises(ConfigError, match=words):
            find_executable(str(game))

    def test_folders_and_links_that_are_no_players(self, tmp_path: Path) -> None:
        folder = tmp_path / "folder"
        folder.mkdir()
        (folder / "Game.x86_64").touch()
        with pytest.raises(ConfigError, match=r"folder is a folder; players in it: Game.x86_64\)"):
            find_executable(str(folder))
        (tmp_path / "loop").symlink_to("loop")
        with pytest.raises(
            ConfigError, match="loop cannot be opened: it is a symbolic link that leads in a circle"
        ):
            find_executable(str(tmp_path / "loop"))
        (tmp_path / "dangling").symlink_to("gone")
        with pytest.raises(ConfigError, match="dangling is a symbolic link to gone, which does not exist"):
            find_executable(str(tmp_path / "dangling"))
        with pytest.raises(ConfigError, match="cannot be opened: File name too long"):
            find_executable("a" * 300)
        with pytest.raises(ConfigError, match="--file-name= is empty"):
            find_executable("", "--file-name")

    def test_a_player_in_a_folder_with_brackets_is_found(self, tmp_path: Path) -> None:
        (tmp_path / "v[1]").mkdir()
        game = tmp_path / "v[1]" / "Game"
        game.write_text("#!/bin/sh\n")
        game.chmod(0o755)
        assert find_executable(str(game)) == game

    @pytest.mark.parametrize(
        ("fields", "words"),
        [
            ({"backend": Backend.player}, "env.file_name is not given, but env.backend=player needs it"),
            ({"num_players": 2}, "env.num_players=2 needs env.backend=player"),
            ({"num_players": 0}, "env.num_players=0 is out of range"),
            ({"timeout_s": 0.0}, "env.timeout_s=0.0 is out of range"),
            ({"port": 70000}, "env.port=70000 is out of range"),
            ({"screen_width": 80}, "env.screen_width and env.screen_height belong together"),
            (
                {"backend": Backend.editor, "params": {"mass": "big"}},
                "env.params.mass=big must be a number, a sampler",
            ),
            (
                {"backend": Backend.editor, "params": {"größe": 1}},
                "env.params.größe: players only know names",
            ),
            (
                {"backend": Backend.editor, "params": {"mass": -1e39}},
                r"env.params.mass: -1e\+39 is out of range",
            ),
            (
                {
                    "backend": Backend.editor,
                    "params": {
                        "mass": {
                            "lessons": [
                                {"value": 1, "completion": {"threshold": 1}},
                                {"value": {"sampler": "gaussian", "mean": 0, "st_dev": 1e40}},
                            ]
                        }
                    },
                },
                r"env.params.mass: 1e\+40 is out of range: players take numbers \(float32\)",
            ),
            ({"time_scale": 1e39}, r"env.time_scale=1e\+39 is out of range"),
            ({"screen_width": 2**31, "screen_height": 9}, "env.screen_width=2147483648 is out of range"),
            ({"target_frame_rate": 2**31}, "env.target_frame_rate=2147483648 is out of range"),
            ({"quality_level": 2**31}, "env.quality_level=2147483648 is out of range"),
        ],
    )
    def test_options_that_cannot_be(self, fields: dict[str, Any], words: str) -> None:
        with pytest.raises(ConfigError, match=words):
            EnvConfig(**fields)
