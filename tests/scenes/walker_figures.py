"""Walkers posed by hand, for the tests of the scene. The tables are retyped from the sheet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from mlagents_envs.base_env import ActionTuple

from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.scene import Walker

NAME = "Walker?team=0"
PARTS = (
    "hips chest spine head thighL shinL footL thighR shinR footR armL forearmL handL armR forearmR handR"
).split()
FIRST = dict(
    zip(PARTS, (18, 28, 43, 58, 73, 88, 103, 118, 133, 148, 163, 178, 193, 203, 218, 233), strict=True)
)
"""Index of every part's first observation, from the sheet."""
REST = {
    "hips": (0, 0.953, 0), "spine": (0, 1.17839, 0), "chest": (0, 1.44404, 0), "head": (0, 1.8935, 0),
    "armL": (-0.4125, 1.44404, 0), "forearmL": (-0.7425, 1.44404, 0), "handL": (-0.9735, 1.44404, 0),
    "armR": (0.4125, 1.44404, 0), "forearmR": (0.7425, 1.44404, 0), "handR": (0.9735, 1.44404, 0),
    "thighL": (-0.132, 0.689, 0), "shinL": (-0.132, 0.359, 0), "footL": (-0.132, 0.161, 0),
    "thighR": (0.132, 0.689, 0), "shinR": (0.132, 0.359, 0), "footR": (0.132, 0.161, 0),
}  # fmt: skip
STRENGTHS = (
    "chest spine head thighL shinL footL thighR shinR footR armL forearmL armR forearmR".split()
)  # of actions 26 to 38
ROOT_HALF = np.sqrt(0.5)


class Posed(Walker):
    """Walker without physics: figures stay as they are put; `hits` maps a tick to (slot, parts)."""

    def __init__(self, hits: dict[int, tuple[int, list[str]]] | None = None, **options: Any) -> None:
        super().__init__(**options)
        self.hits = hits or {}
        self.tick = 0
        self.physics.step = self.hit  # type: ignore[method-assign]

    def hit(self) -> None:
        self.tick += 1
        self.physics.find_poses()
        if self.tick in self.hits:
            slot, parts = self.hits[self.tick]
            for part in parts:
                self.physics.position[slot, PARTS.index(part), 1] = 0.1


def posed(angles: Mapping[tuple[str, str], float] | None = None, yaw: float = 0.0, **options: Any) -> Posed:
    """Return one figure in the start pose at `yaw` degrees with the given joint angles (degrees)."""
    env = Posed(num_areas=1, **options)
    env.reset()
    env.physics.stand(np.array([0]), np.radians([yaw]))
    for hinge, degrees in (angles or {}).items():
        env.physics.angle[0, body.HINGES.index(hinge)] = np.radians(degrees)
    env.physics.find_poses()
    aim_at(env, (0.0, 1.0, 5.0))
    env.grounded[:] = False
    return env


def aim_at(env: Walker, target: tuple[float, float, float]) -> None:
    env.physics.target_position[:] = target
    env.fixed_update()
    env.agents.reward[:] = 0


def observed(env: Walker) -> np.ndarray:
    return env.observe(0, np.array([0]))[0][0]


def position_of(obs: np.ndarray, part: str) -> list[float]:
    """Return a part's position from the hips, in the cube's frame."""
    return obs[FIRST[part] + 7 : FIRST[part] + 10].tolist()


def rotation_of(obs: np.ndarray, part: str) -> list[float]:
    return obs[FIRST[part] + 10 : FIRST[part] + 14].tolist()


def play(env: Walker, steps: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(steps):
        decisions, terminals = env.get_steps(NAME)
        if len(decisions):
            action = rng.uniform(-1, 1, (len(decisions), 39)).astype(np.float32)
            env.set_actions(NAME, ActionTuple(continuous=action))
        for part in (decisions, terminals):
            rows += [part.agent_id, part.reward, part.obs[0].ravel()]
        env.step()
    return np.concatenate(rows)
