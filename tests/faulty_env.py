"""A game with one fault at a time, and the options that are faults of their own: for mappo-doctor.

Without a fault it is learnt in some ten thousand decisions: the sign of the first element says which of two
actions earns 0.1, the other loses it; an episode has twenty decisions.
"""

from __future__ import annotations

import time

import numpy as np
from fakes import vector_spec
from mlagents_envs.base_env import ActionTuple, DecisionSteps, TerminalSteps
from probes import Probe

LENGTH = 20
OTHER = "Other?team=0"

IN_THE_GAME = {
    "constant": "constant",
    "huge": "huge",
    "tiny": "tiny",
    "clipped": "clipped",
    "same_for_all": "same for all",
    "no_reward": "no reward",
    "equal_returns": "equal returns",
    "huge_rewards": "huge rewards",
    "rare_rewards": "rare rewards",
    "never_ends": "never ends",
    "ends_at_once": "ends at once",
    "never_asked": "never asked",
    "idle": "idle agents",
    "one_action": "one action",
    "blind": "values",
    "noise": "no rise",
    "late_rewards": "short sight",
    "slow": "slow environment",
}
"""Faults of the game, and the kind of finding that each must lead to."""
WITH_OPTIONS = {
    "huge": ["model.normalize_obs=false"],
    "tiny": ["model.normalize_obs=false"],
    "huge_rewards": ["ppo.normalize_values=none"],
    "late_rewards": ["ppo.gamma=0.5"],
    "slow": ["env.params.teams=8", "max_steps=6000"],
    "never_ends": ["max_steps=100000"],
}
"""Options that a fault of the game needs to be one."""
IN_THE_OPTIONS = {
    "lr_huge": ("rollbacks", ["ppo.lr=0.3"]),
    "lr_tiny": ("no steps", ["ppo.lr=1e-9"]),
    "entropy_high": ("entropy stays", ["ppo.entropy_coef=10", "ppo.entropy_schedule=constant"]),
    "collapse": (
        "entropy collapsed",
        # no doubt at this rate: at a tenth of it rounding decides on which side of the limit the entropy ends
        ["ppo.lr=0.3", "ppo.max_kl=1e9", "ppo.epochs=20", "ppo.clip_epsilon=0.9", "env.params.fault=noise"],
    ),
    "epochs": (
        "slow learning",
        ["ppo.epochs=100", "ppo.minibatch_size=32", "max_steps=3000", "collect.batch_size=512"],
    ),
}
"""Faulty options: the kind of finding, and the lines."""


class Faulty(Probe):
    """Agents that see a number, whose sign is the right action, and a gauge of three that says nothing."""

    def __init__(self, seed: int, fault: str = "", teams: int = 32) -> None:
        self.fault = fault
        super().__init__(seed, teams=teams)
        if fault == "never_asked":
            self.behavior_specs_ = {**self.behavior_specs_, OTHER: self.spec}

    def sensor_specs(self):
        return [vector_spec(1, "heading"), vector_spec(3, "gauge")]

    def begin(self, teams):
        self.right = np.zeros(self.teams, int)
        self.draw()

    def draw(self):
        shape = (1,) if self.fault == "same_for_all" else (self.teams,)
        self.heading = np.broadcast_to(self.rng.uniform(-1, 1, shape), self.teams).copy()
        self.gauge = np.broadcast_to(self.rng.normal(size=(*shape, 3)), (self.teams, 3)).copy()

    def sensors(self):
        heading, gauge = self.heading[:, None], self.gauge
        if self.fault == "constant":
            gauge = np.full_like(gauge, 0.5)
        if self.fault == "huge":
            gauge = 1e4 * gauge
        if self.fault == "clipped":
            gauge = (2 * gauge).clip(-1, 1)
        if self.fault == "tiny":
            heading, gauge = 1e-5 * heading, 1e-5 * gauge
        if self.fault == "blind":
            heading = self.rng.uniform(-1, 1, heading.shape)
        return [heading, gauge]

    def earn(self, choice):
        if self.fault == "slow":
            time.sleep(0.03)
        is_right = (choice[:, 0] * self.heading > 0) * 1
        self.right = self.right + is_right
        reward = 0.1 * np.where(is_right, 1.0, -1.0)
        is_last = self.clock == LENGTH - 1

        rewards = {
            "no_reward": 0.0 * reward,
            "equal_returns": np.full(self.teams, 0.05),
            "huge_rewards": 1e4 * reward,
            # sixteen of twenty by chance: one episode in 170
            "rare_rewards": np.where(
                is_last & (self.right >= 16) & (self.rng.random(self.teams) < 0.3), 1.0, -0.01
            ),
            "noise": self.rng.normal(size=self.teams),
            "late_rewards": np.where(is_last, self.right / LENGTH, 0.0),
        }
        self.draw()
        return rewards.get(self.fault, reward)[:, None], np.zeros(self.teams)

    def ends(self):
        lengths = {"never_ends": 10**9, "ends_at_once": 1}
        return self.clock >= lengths.get(self.fault, LENGTH), np.zeros(self.teams, bool)

    def asked(self):
        asked = np.ones((self.teams, 1), bool)
        if self.fault == "idle":
            asked[: self.teams // 2] = self.clock[: self.teams // 2, None] == 0
        return asked

    def get_steps(self, behavior_name):
        if behavior_name == OTHER:
            return DecisionSteps.empty(self.spec), TerminalSteps.empty(self.spec)
        return self.result

    def set_actions(self, behavior_name, action: ActionTuple):
        if behavior_name != OTHER:
            super().set_actions(behavior_name, action)

    def _decisions(self, asked):
        found = super()._decisions(asked)
        if self.fault == "one_action":
            found.action_mask[0][:, 1] = True
        return found


class Idle(Faulty):
    """Half of the agents ask once and never end."""

    def ends(self):
        over, cut = super().ends()
        over[: self.teams // 2] = False
        return over, cut


def make(seed, fault="", teams=32):
    """Return the game; for ``env.factory``."""
    return (Idle if fault == "idle" else Faulty)(seed, fault, int(teams))
