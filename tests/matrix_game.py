"""Rock, paper, scissors with a twist, a game without a best pure strategy: a one-shot game of two sides.

Rock that crushes scissors counts double. The equilibrium plays rock, paper and scissors with probabilities
1/4, 1/2, 1/4: for ``PAYOFF p = 0`` and p > 0 that sums to 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from fakes import vector_spec
from mlagents_envs.base_env import (
    ActionSpec,
    ActionTuple,
    BaseEnv,
    BehaviorSpec,
    DecisionSteps,
    TerminalSteps,
)

PAYOFF = np.array([[0, -1, 2], [1, 0, -1], [-2, 1, 0]], np.float32)  # of the row against the column
EQUILIBRIUM = np.array([0.25, 0.5, 0.25])
SIDES = ("Rps?team=0", "Rps?team=1")


class MatrixGame(BaseEnv):
    """Play so many games side by side; every decision ends an episode."""

    def __init__(self, seed: int = 0, games: int = 32) -> None:
        self.games = games
        self.specs = {name: BehaviorSpec([vector_spec(1)], ActionSpec(0, (3,))) for name in SIDES}
        self.ids = {name: np.arange(games) + side * games for side, name in enumerate(SIDES)}
        self.choices = {name: np.zeros(games, int) for name in SIDES}
        self.played = False

    @property
    def behavior_specs(self) -> Any:
        """Return the two sides' specs."""
        return self.specs

    def reset(self) -> None:
        """Begin new games."""
        self.played = False

    def step(self) -> None:
        """Play a game in every place."""
        self.played = True

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Take a side's choices."""
        self.choices[behavior_name] = action.discrete[:, 0].astype(int)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Not needed here."""
        raise NotImplementedError

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the games that are over, and a request for the next choices."""
        other = SIDES[1 - SIDES.index(behavior_name)]
        count = self.games if self.played else 0
        earned = PAYOFF[self.choices[behavior_name], self.choices[other]][:count]
        ids, see = self.ids[behavior_name], np.zeros((self.games, 1), np.float32)
        nothing = np.zeros(self.games, np.float32)
        group = np.zeros(self.games, np.int32)
        terminal = TerminalSteps(
            [see[:count]], earned, np.zeros(count, bool), ids[:count], group[:count], nothing[:count]
        )
        return DecisionSteps([see], nothing, ids, None, group, nothing), terminal

    def close(self) -> None:
        """Nothing is open."""


def make(seed: int = 0, **params: Any) -> MatrixGame:
    """Open it, as `env.factory=matrix_game:make`."""
    return MatrixGame(seed, **params)
