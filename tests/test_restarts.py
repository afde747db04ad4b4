"""Players that come back with other behaviors than they left with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from fakes import Record, ScriptedEnv, behavior_spec

from mappo_unity.protocol.parallel_players import SeveralPlayers
from mappo_unity.protocol.player_failures import PlayerFailure
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
