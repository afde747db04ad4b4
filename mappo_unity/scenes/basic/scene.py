"""Basic: walk along a line of 21 places; a small goal lies near, a large one farther away.

Facts: docs/scenes/Basic.md. One agent an area, no physics. Unity reloads its scene at the end of an
episode, so every episode is played by a new agent: the old one is disabled, the next id appears.
Legend: N areas = slots (one agent an area).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mappo_unity.scenes.core.scene import Scene
from mappo_unity.scenes.core.specs import Behavior, Sensor

SIZE = 20  # places that the observation can show; the line has one more, which cannot be reached
START = 10
SMALL_GOAL, LARGE_GOAL = 7, 17
SMALL_REWARD, LARGE_REWARD = 0.1, 1.0
STEP_REWARD = -0.01
# Tables, one look-up instead of arithmetic: with one agent an area the calls are what a tick costs.
MOVES = np.array([1, 0, 2])  # of the actions stay, left, right: the place in PLACES, seen from the agent's
PLACES = np.clip(np.arange(-1, SIZE + 2), 0, SIZE)  # where the places -1 to 21 are: nobody leaves the line
IS_GOAL = np.isin(np.arange(SIZE + 1), (SMALL_GOAL, LARGE_GOAL))
REWARDS = np.full(SIZE + 1, STEP_REWARD, np.float32)  # of arriving at a place
REWARDS[SMALL_GOAL] += np.float32(SMALL_REWARD)
REWARDS[LARGE_GOAL] += np.float32(LARGE_REWARD)


class Basic(Scene):
    """Run Basic; it has no environment parameters."""

    NAME = "Basic"
    BEHAVIORS = (Behavior("Basic?team=0", (Sensor("Basic", (SIZE,)),), branches=(3,)),)
    DECISION_PERIOD = 1

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.position = np.full(self.num_areas, START)
        self._one_hot = np.eye(SIZE, dtype=np.float32)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Do nothing: only a new agent stands at the start, env.reset() moves nobody."""

    def decides(self) -> bool:
        """Let everybody decide at every tick."""
        return True

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return the position as a one-hot vector."""
        return [self._one_hot.take(self.position[slots], axis=0)]

    def act(self, slots: np.ndarray) -> None:
        """Move along the line; at a goal the agent leaves and a new one takes its place at the start."""
        agents = self.agents
        self.position = position = PLACES.take(self.position + MOVES.take(agents.discrete.ravel()))
        agents.reward = agents.reward + REWARDS.take(position)
        ended = IS_GOAL.take(position).nonzero()[0]
        if ended.size:
            self.disable(ended)
            self.position[ended] = START
            self.enable(ended)

    def scene_state(self) -> dict[str, Any]:
        """Return the positions."""
        return {"position": self.position.copy()}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore the positions."""
        self.position[:] = state["position"]
