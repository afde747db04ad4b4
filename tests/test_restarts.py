"""Players that come back with other behaviors than they left with, or do not come back."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import Record, ScriptedEnv, behavior_spec

from mappo_unity.cli.doctor import diagnose
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.protocol.client import UnityPlayer
from mappo_unity.protocol.parallel_players import SeveralPlayers
from mappo_unity.protocol.player_failures import PlayerFailure
from mappo_unity.protocol.player_options import PlayerOptions
from mappo_unity.protocol.restarting_player import RestartingPlayer

from mlagents_envs.base_env import ActionTuple  # isort: skip  # mappo_unity lets it import
from mlagents_envs.exception import UnityActionException  # isort: skip

GONE = None
"""A result of a player that has failed instead."""
RED, BLUE, GREEN = "Red?team=0", "Blue?team=0", "Green?team=0"


class ScriptedPlayer(ScriptedEnv):
    """A player that plays a script; it has the behaviors that it has shown so far."""

    def __init__(self, script: Sequence[list[Record] | None]) -> None:
        super().__init__([records or [] for records in script], {})
        self.fails = [records is GONE for records in script]

    def connect(self) -> None:
        pass

    def send_reset(self) -> None:
        self.reset()

    def send_step(self) -> None:
        self.step()

    def reset(self) -> None:
        super().reset()
        self.receive()

    def receive(self) -> None:
        if self.fails[self.at]:
            raise PlayerFailure("it is gone")
        for record in self.script[self.at]:
            self.specs.setdefault(record.behavior, behavior_spec())

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        if behavior_name not in self.specs:
            raise UnityActionException(f"there is no behavior {behavior_name!r}")
        super().set_actions(behavior_name, action)

    def pop_statistics(self) -> dict[str, Any]:
        return {}


def player(*scripts: Sequence[list[Record] | None]) -> RestartingPlayer:
    """Return a player that plays one script after each start."""
    left = iter(scripts)
    return RestartingPlayer(lambda seed: ScriptedPlayer(next(left)), 0, max_restarts=9)


def act(count: int) -> ActionTuple:
    return ActionTuple(np.zeros((count, 1), np.float32))


def test_actions_are_taken_while_a_restarted_player_has_shown_one_behavior_of_two() -> None:
    both = [Record(0, behavior=RED), Record(1, behavior=BLUE)]
    restarted = player([both, GONE], [[Record(0, behavior=RED)], both])
    steady = player([both] * 3)
    env = SeveralPlayers([restarted, steady])

    env.reset()
    env.step()
    assert env.restarts == 1
    assert [env.get_steps(name)[0].agent_id.tolist() for name in (RED, BLUE)] == [[0, 1], [3]]
    env.set_actions(RED, act(2))
    env.set_actions(BLUE, act(1))
    with pytest.raises(UnityActionException, match=r"\(0, 1\)"):
        restarted.set_actions(BLUE, act(1))

    env.step()
    assert env.get_steps(BLUE)[0].agent_id.tolist() == [2, 3]
    env.set_actions(BLUE, act(2))
    shown: Any = restarted.player
    assert [name for name, *_ in shown.actions] == [RED, BLUE]


def test_a_behavior_that_takes_the_place_of_another_is_seen() -> None:
    env = player(
        [[Record(0, behavior=RED), Record(1, behavior=BLUE)], GONE],
        [[Record(0, behavior=RED), Record(1, behavior=GREEN)]],
    )
    env.reset()
    env.step()
    assert list(env.behavior_specs) == [RED, BLUE, GREEN]


REASON = r"player Game.x86_64 did not start: \[Errno 86\] Bad CPU type in executable"


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A player that the system refuses to start."""
    game = tmp_path / "Game.x86_64"
    game.write_text("#!/bin/sh\n")
    game.chmod(0o755)

    def refuse(*args: Any, **kwargs: Any) -> None:
        raise OSError(86, "Bad CPU type in executable")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    return game


def test_a_first_player_that_the_system_refuses_is_a_mistake_in_the_options(refused: Path) -> None:
    cfg = EnvConfig(backend=Backend.player, file_name=str(refused), player_logs=str(refused.parent))
    with pytest.raises(ConfigError, match=f"env.file_name={refused} cannot be started: {REASON}"):
        make_env_function(cfg)(0)

    lines: list[str] = []
    assert diagnose(["--file-name", str(refused)], lines.append) == 1
    assert "did not start: [Errno 86] Bad CPU" in "".join(lines) and "for this system" in "".join(lines)


def test_a_player_that_the_system_refuses_to_start_again_uses_restarts_up(
    refused: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    first: Any = ScriptedPlayer([[Record(0)], GONE])
    again = PlayerOptions(refused, refused.with_suffix(".log"))
    env = RestartingPlayer(lambda seed: UnityPlayer(again, seed) if seed else first, 0, max_restarts=2)
    env.reset()
    with pytest.raises(EnvironmentFailure, match=f"{REASON}. It was restarted 2 times"):
        env.step()
