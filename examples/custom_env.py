"""An environment of one's own: points that walk to their targets.

Several agents, each a point in a square, each with a target. An agent sees where its target lies from here,
chooses a velocity, and earns what it comes closer, plus 1 when it arrives.

In the folder of this file:

    python -m mappo_unity.scenes.check custom_env:make
    mappo-train env=custom env.name=Points env.factory=custom_env:make env.params.num_agents=32

An environment is a class with the methods of `mlagents_envs.base_env.BaseEnv`. The trainer calls them in this
order (docs/your-own-environment.md has the rules):

    reset()                     begin
    get_steps(behavior)         who asks for an action now, and whose episode has ended
    set_actions(behavior, ...)  an action for every agent that asked, in the same order
    step()                      go on until somebody asks or ends; then get_steps again, and so on
    close()
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mlagents_envs.base_env import (
    ActionSpec,
    ActionTuple,
    BaseEnv,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
    TerminalSteps,
)
from mlagents_envs.exception import UnityActionException

BEHAVIOR = "Point?team=0"  # policy "Point"; a second side that plays against it would be "Point?team=1"
SPEED = 0.1  # largest way in one step, in each direction; the square reaches from -1 to 1


def make(seed: int, num_agents: int = 16, max_decisions: int = 50, reach: float = 0.15) -> BaseEnv:
    """Return the environment: the function that env.factory names.

    `seed` comes from the run, the other arguments from env.params. The same seed must give the same episodes.
    """
    if num_agents < 1:
        raise ValueError(f"num_agents={num_agents} must be at least 1")
    return PointEnv(seed, num_agents, max_decisions, reach)


class PointEnv(BaseEnv):
    """Points that walk to their targets; everything is an array with one row for each agent."""

    def __init__(self, seed: int, num_agents: int, max_decisions: int, reach: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.num_agents, self.max_decisions, self.reach = num_agents, max_decisions, reach

        # What an agent sees (a vector of 2 numbers) and what it chooses (2 numbers from -1 to 1).
        target = ObservationSpec((2,), (DimensionProperty.NONE,), ObservationType.DEFAULT, "way to target")
        self.spec = BehaviorSpec([target], ActionSpec(continuous_size=2, discrete_branches=()))

        # Ids are whole numbers, one for each agent. Group 0 means alone; agents with another number in common
        # are a team: they share `group_reward`, and the central critic sees all of them.
        self.ids = np.arange(num_agents, dtype=np.int32)
        self.groups = np.zeros(num_agents, np.int32)
        self.no_group_reward = np.zeros(num_agents, np.float32)

        self.position = np.zeros((num_agents, 2))
        self.target = np.zeros((num_agents, 2))
        self.decisions = np.zeros(num_agents, int)  # of the episode that is being played
        self.action = np.zeros((num_agents, 2))
        self.result = self.ask(self.no_group_reward, TerminalSteps.empty(self.spec))

    # --- what every BaseEnv has

    @property
    def behavior_specs(self) -> dict[str, BehaviorSpec]:  # type: ignore[override]
        """All behaviors, by name: complete from the first reset on, and always the same."""
        return {BEHAVIOR: self.spec}

    def reset(self) -> None:
        """Begin new episodes everywhere. Called at the start, not at the end of an episode."""
        self.begin(np.ones(self.num_agents, bool))
        self.result = self.ask(np.zeros(self.num_agents, np.float32), TerminalSteps.empty(self.spec))

    def step(self) -> None:
        """Move everybody, pay, and begin new episodes where one has ended."""
        before = self.distance()
        self.position += SPEED * self.action
        self.decisions += 1

        arrived = self.distance() < self.reach
        reward = (before - self.distance() + arrived).astype(np.float32)

        # An end is real (interrupted False: nothing comes after it) or a time limit (interrupted True: the
        # value of what would have come still counts). What was earned last goes with the end.
        ended = arrived | (self.decisions >= self.max_decisions)
        terminal = TerminalSteps(
            [self.observe()[ended]],
            reward[ended],
            ~arrived[ended],
            self.ids[ended],
            self.groups[ended],
            self.no_group_reward[ended],
        )

        # Those that ended begin again by themselves; their first decision comes in the same result.
        self.begin(ended)
        self.result = self.ask(np.where(ended, np.float32(0), reward), terminal)

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return who asks now, and who has ended since the last step."""
        self.check(behavior_name)
        return self.result

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Take an action for every agent that asked, in the order in which they did."""
        self.check(behavior_name, action, self.num_agents)
        self.action = np.clip(action.continuous, -1, 1)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Take the action of one agent."""
        self.check(behavior_name, action, 1)
        if agent_id not in self.ids:
            raise UnityActionException(f"agent {agent_id} did not ask for a decision")
        self.action[agent_id] = np.clip(action.continuous[0], -1, 1)

    def close(self) -> None:
        """Release what is held open: nothing here."""

    # --- optional: a resumed run then goes on exactly where it was

    def get_state(self) -> dict[str, Any]:
        """Return all that changes, as dicts, lists, arrays and plain values."""
        decision, _ = self.result
        return {
            "rng": self.rng.bit_generator.state,
            "position": self.position.copy(),
            "target": self.target.copy(),
            "decisions": self.decisions.copy(),
            "reward": decision.reward.copy(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go back to what `get_state` returned."""
        self.rng.bit_generator.state = state["rng"]
        self.position, self.target = state["position"].copy(), state["target"].copy()
        self.decisions = state["decisions"].copy()
        self.result = self.ask(state["reward"].copy(), TerminalSteps.empty(self.spec))

    # --- the points

    def begin(self, who: np.ndarray) -> None:
        """Begin episodes of these agents (bool, one flag each): a new place, a new target."""
        self.position[who] = self.rng.uniform(-1, 1, (who.sum(), 2))
        self.target[who] = self.rng.uniform(-1, 1, (who.sum(), 2))
        self.decisions[who] = 0

    def observe(self) -> np.ndarray:
        """Return what the agents see: float32, a new array (a result must not change later on)."""
        return (self.target - self.position).astype(np.float32)

    def distance(self) -> np.ndarray:
        """Return how far everybody is from its target."""
        return np.linalg.norm(self.target - self.position, axis=1)

    def ask(self, reward: np.ndarray, terminal: TerminalSteps) -> tuple[DecisionSteps, TerminalSteps]:
        """Return a result in which all agents ask. `None`: there are no discrete actions to forbid."""
        self.action = np.zeros((self.num_agents, 2))  # whoever gets no action stands still
        decision = DecisionSteps([self.observe()], reward, self.ids, None, self.groups, self.no_group_reward)
        return decision, terminal

    def check(self, behavior_name: str, action: ActionTuple | None = None, count: int = 0) -> None:
        """Refuse behaviors that are not there, and actions for more or fewer agents than asked."""
        if behavior_name != BEHAVIOR:
            raise UnityActionException(f"there is no behavior {behavior_name!r}; there is {BEHAVIOR!r}")
        if action is not None and action.continuous.shape != (count, 2):
            raise UnityActionException(f"actions of shape {action.continuous.shape}, not {(count, 2)}")
