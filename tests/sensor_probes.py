"""Probes with entities, images and goal signals: what only these sensors tell must be learned from them."""

from __future__ import annotations

from typing import Any

import numpy as np
from mlagents_envs.base_env import BaseEnv, DimensionProperty, ObservationSpec, ObservationType
from probes import Probe

NONE, SHIFT, MANY = (
    DimensionProperty.NONE,
    DimensionProperty.TRANSLATIONAL_EQUIVARIANCE,
    DimensionProperty.VARIABLE_SIZE,
)


def sensor(name: str, *shape: int, goal: bool = False) -> ObservationSpec:
    """Return a sensor as Unity describes it: a vector, entities ``[N, F]`` or an image ``[C, H, W]``."""
    flags = {1: (NONE,), 2: (MANY, NONE), 3: (NONE, SHIFT, SHIFT)}[len(shape)]
    kind = ObservationType.GOAL_SIGNAL if goal else ObservationType.DEFAULT
    return ObservationSpec(shape, flags, kind, name)


class Largest(Probe):
    """Up to five entities in two sensors: the reward is the choice, times the colour of the largest one.

    An entity is its size (0.1 to 1) and its colour (+1 or -1). Nobody there: nothing to earn.
    """

    SIZES = (3, 2)

    def sensor_specs(self):
        return [sensor(f"entities {size}", size, 2) for size in self.SIZES]

    def begin(self, teams):
        if not hasattr(self, "entities"):
            self.entities = np.zeros((self.teams, sum(self.SIZES), 2))
        count, total = int(teams.sum()), sum(self.SIZES)
        drawn = np.stack(
            [self.rng.uniform(0.1, 1.0, (count, total)), self.rng.choice([-1.0, 1.0], (count, total))], -1
        )
        # from none to all of them are there
        drawn[self.rng.random((count, total)) < self.rng.random((count, 1))] = 0.0
        self.entities[teams] = drawn

    def sensors(self):
        return np.split(self.entities, [self.SIZES[0]], axis=1)

    def earn(self, choice):
        largest = self.entities[..., 0].argmax(1)
        colour = self.entities[np.arange(self.teams), largest, 1]
        return colour[:, None] * choice, np.zeros(self.teams)


class LargestTeam(Largest):
    """The same for a team of two that sees one half each and is paid for the first one's choice."""

    members = 2

    def sensor_specs(self):
        return [sensor("member", 1), sensor("entities", sum(self.SIZES), 2)]

    def sensors(self):
        member = np.tile([[0.0], [1.0]], (self.teams, 1))
        seen = np.repeat(self.entities, 2, axis=0)
        return [member, seen]

    def earn(self, choice):
        colour = super().earn(np.ones((self.teams, 1)))[0][:, 0]
        return np.zeros((self.teams, 2)), colour * choice[:, 0]


class Goal(Probe):
    """Four signs are seen, and a goal: which of them the choice must follow."""

    def sensor_specs(self):
        return [sensor("signs", 4), sensor("goal", 4, goal=True)]

    def begin(self, teams):
        if not hasattr(self, "signs"):
            self.signs, self.goal = np.zeros((self.teams, 4)), np.zeros(self.teams, int)
        self.signs[teams] = self.rng.choice([-1.0, 1.0], (int(teams.sum()), 4))
        self.goal[teams] = self.rng.integers(0, 4, int(teams.sum()))

    def sensors(self):
        return [self.signs, np.eye(4)[self.goal]]

    def earn(self, choice):
        return self.signs[np.arange(self.teams), self.goal, None] * choice, np.zeros(self.teams)


class Everything(Probe):
    """A team of two with every kind of sensor, goals of every kind, and numbers that mean nothing."""

    members = 2

    def sensor_specs(self):
        return [
            sensor("entities", 4, 3),
            sensor("vector", 2),
            sensor("goal", 3, goal=True),
            sensor("grid", 2, 21, 24),
            sensor("goal grid", 1, 20, 20, goal=True),
            sensor("goal entities", 2, 5, goal=True),
        ]

    def sensors(self):
        out = [self.rng.random((self.count, *spec.shape)) for spec in self.spec.observation_specs]
        for rows in (out[0], out[-1]):
            rows[self.rng.random(rows.shape[:2]) < 0.5] = 0.0
        # of the first agent nobody is there at all
        out[0][0] = out[-1][0] = 0.0
        return out

    def earn(self, choice):
        return choice, np.zeros(self.teams)

    def get_state(self):
        return {"rng": self.rng.bit_generator.state, "obs": [obs.copy() for obs in self.result[0].obs]}

    def set_state(self, state):
        self.reset()
        self.rng.bit_generator.state = state["rng"]
        # every decision is the first of an episode: nothing else is under way
        for values, saved in zip(self.result[0].obs, state["obs"]):
            values[:] = saved


PROBES = {cls.__name__: cls for cls in (Largest, LargestTeam, Goal, Everything)}


def make(seed: int, probe: str = "Everything", **params: Any) -> BaseEnv:
    """Build a probe by name (for env.factory)."""
    return PROBES[probe](seed, **params)
