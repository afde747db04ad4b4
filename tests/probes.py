"""Probe environments: tiny BaseEnvs with a known right answer that a run of seconds must reach.

`probe(...)` builds one for `Config.env.factory = "probes:make"`; each `Probe` subclass says what its
agents see, earn and when they end. Vectorised over teams; every agent decides every round unless the
probe says otherwise.
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

NAME = "Probe?team=0"
ACTIONS = {
    "continuous": ActionSpec(1, ()),
    "discrete": ActionSpec(0, (2,)),
    "mixed": ActionSpec(1, (2,)),
}


class Probe(BaseEnv):
    """Teams of ``members`` agents; subclasses override `observe`, `earn` and `ends`."""

    obs_size = 1
    members = 1

    def __init__(self, seed: int, teams: int = 16, actions: str = "discrete") -> None:
        self.rng = np.random.default_rng(seed)
        self.teams, self.actions = teams, actions
        self.spec = BehaviorSpec([vector_spec(self.obs_size)], ACTIONS[actions])
        self.count = teams * self.members
        self.ids = np.arange(self.count)
        self.clock = np.zeros(teams, int)  # decisions since the team's episode began
        self.choice = np.zeros(self.count)
        self.behavior_specs_ = {NAME: self.spec}

    # --- what a probe says

    def begin(self, teams: np.ndarray) -> None:
        """Draw what the episodes of these teams (bool [G]) need."""

    def observe(self) -> np.ndarray:
        """Return observations [G, A, O]."""
        return np.zeros((self.teams, self.members, self.obs_size))

    def earn(self, choice: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return individual rewards [G, A] and group rewards [G] for choices [G, A] in [-1, 1]."""
        raise NotImplementedError

    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Return which teams end now and which of those are interrupted, bool [G] each."""
        return np.ones(self.teams, bool), np.zeros(self.teams, bool)

    def asked(self) -> np.ndarray:
        """Return which agents are asked now, bool [G, A]."""
        return np.ones((self.teams, self.members), bool)

    # --- BaseEnv

    @property
    def behavior_specs(self) -> Any:
        return self.behavior_specs_

    def reset(self) -> None:
        self.clock[:] = 0
        self.begin(np.ones(self.teams, bool))
        self.reward = np.zeros((self.teams, self.members))
        self.group_reward = np.zeros((self.teams, self.members))
        self.result = self._decisions(self.asked()), TerminalSteps.empty(self.spec)

    def step(self) -> None:
        individual, group = self.earn(self.choice.reshape(self.teams, self.members))
        self.reward += individual
        self.group_reward += group[:, None]
        self.clock += 1
        over, cut = self.ends()
        terminal = self._terminals(over, cut)
        if over.any():
            self.reward[over] = self.group_reward[over] = 0
            self.clock[over] = 0
            self.begin(over)
            self.renew(over)
        self.result = self._decisions(self.asked()), terminal

    def renew(self, over: np.ndarray) -> None:
        """Give new ids, if the probe does."""

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        decision = self.result[0]
        rows = self.rows_of(decision.agent_id)
        value = np.zeros(len(rows))
        parts = 0
        if self.spec.action_spec.continuous_size:
            value, parts = value + action.continuous[:, 0], parts + 1
        if self.spec.action_spec.discrete_size:
            value, parts = value + action.discrete[:, 0] * 2.0 - 1.0, parts + 1
        self.choice[rows] = value / parts

    def rows_of(self, agent_ids: np.ndarray) -> np.ndarray:
        return np.searchsorted(self.ids, agent_ids)

    def set_action_for_agent(self, behavior_name: Any, agent_id: Any, action: Any) -> None:
        raise NotImplementedError

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        return self.result

    def close(self) -> None:
        pass

    def groups(self) -> np.ndarray:
        alone = np.zeros(self.count, np.int32)
        return (
            alone
            if self.members == 1
            else np.repeat(np.arange(1, self.teams + 1), self.members).astype(np.int32)
        )

    def _decisions(self, asked: np.ndarray) -> DecisionSteps:
        rows = np.flatnonzero(asked.reshape(-1))
        n = self.spec.action_spec.discrete_branches
        mask = [np.zeros((len(rows), size), bool) for size in n] if n else None
        out = DecisionSteps(
            [self.observe().reshape(self.count, -1)[rows].astype(np.float32)],
            self.reward.reshape(-1)[rows].astype(np.float32),
            self.ids[rows].astype(np.int32),
            mask,
            self.groups()[rows],
            self.group_reward.reshape(-1)[rows].astype(np.float32),
        )
        self.reward.reshape(-1)[rows] = 0
        self.group_reward.reshape(-1)[rows] = 0
        return out

    def _terminals(self, over: np.ndarray, cut: np.ndarray) -> TerminalSteps:
        rows = np.flatnonzero(np.repeat(over, self.members))
        return TerminalSteps(
            [self.observe().reshape(self.count, -1)[rows].astype(np.float32)],
            self.reward.reshape(-1)[rows].astype(np.float32),
            np.repeat(cut, self.members)[rows],
            self.ids[rows].astype(np.int32),
            self.groups()[rows],
            self.group_reward.reshape(-1)[rows].astype(np.float32),
        )


class Constant(Probe):
    """Reward 1 whatever happens; value 1."""

    def earn(self, choice):
        return np.ones((self.teams, 1)), np.zeros(self.teams)


class ObsReward(Probe):
    """The reward is the observation, +1 or -1; so is the value."""

    def begin(self, teams):
        self.sign = np.where(teams, self.rng.choice([-1.0, 1.0], self.teams), getattr(self, "sign", 1.0))

    def observe(self):
        return self.sign.reshape(-1, 1, 1)

    def earn(self, choice):
        return self.sign[:, None], np.zeros(self.teams)


class Delayed(Probe):
    """Two decisions, reward 1 after the second; values gamma and 1."""

    def observe(self):
        return self.clock.reshape(-1, 1, 1).astype(float)

    def earn(self, choice):
        return (self.clock == 1).astype(float)[:, None], np.zeros(self.teams)

    def ends(self):
        return self.clock >= 2, np.zeros(self.teams, bool)


class ActionReward(Probe):
    """The reward is the choice: high is right."""

    def earn(self, choice):
        return choice, np.zeros(self.teams)


class ObsActionReward(ObsReward):
    """The reward is observation times choice: follow the sign."""

    def earn(self, choice):
        return self.sign[:, None] * choice, np.zeros(self.teams)


class Credit(Probe):
    """A team of two; only the first member's choice earns, for both. The index is not observed but obs is."""

    members, obs_size = 2, 2

    def observe(self):
        return np.tile(np.eye(2), (self.teams, 1, 1))

    def earn(self, choice):
        return np.zeros((self.teams, 2)), choice[:, 0]


class MateKnows(Probe):
    """A team of two: the first sees a sign, the second sees nothing and earns the sign.

    A central critic can know the second's value (the sign); a local one can only say 0, and is wrong
    by 1 each time.
    """

    members = 2

    def begin(self, teams):
        self.sign = np.where(teams, self.rng.choice([-1.0, 1.0], self.teams), getattr(self, "sign", 1.0))

    def observe(self):
        out = np.zeros((self.teams, 2, 1))
        out[:, 0, 0] = self.sign
        return out

    def earn(self, choice):
        reward = np.zeros((self.teams, 2))
        reward[:, 1] = self.sign
        return reward, np.zeros(self.teams)


class EarlyDeath(Probe):
    """The first member chooses once and ends; two rounds later the team earns its choice."""

    members, obs_size = 2, 2

    def begin(self, teams):
        self.memory = np.where(teams, 0.0, getattr(self, "memory", np.zeros(self.teams)))

    def observe(self):
        return np.tile(np.eye(2), (self.teams, 1, 1))

    def asked(self):
        return np.stack([self.clock == 0, np.ones(self.teams, bool)], 1)

    def earn(self, choice):
        self.memory = np.where(self.clock == 0, choice[:, 0], self.memory)
        return np.zeros((self.teams, 2)), np.where(self.clock == 2, self.memory, 0.0)

    def ends(self):
        return self.clock >= 3, np.zeros(self.teams, bool)

    def _terminals(self, over, cut):
        first_over = self.clock == 1
        member = np.zeros((self.teams, 2), bool)
        member[first_over, 0] = True
        member[over, 1] = True
        rows = np.flatnonzero(member.reshape(-1))
        group = np.where(member, np.where(over[:, None], self.memory[:, None], 0.0), 0.0).reshape(-1)
        obs = self.observe().reshape(self.count, -1)[rows].astype(np.float32)
        zeros = np.zeros(len(rows), np.float32)
        interrupted = np.zeros(len(rows), bool)
        return TerminalSteps(
            [obs],
            zeros,
            interrupted,
            self.ids[rows].astype(np.int32),
            self.groups()[rows],
            group[rows].astype(np.float32),
        )


class Staggered(Probe):
    """A team of two of which the second is asked every other round; both must choose high."""

    members, obs_size = 2, 2

    def observe(self):
        return np.tile(np.eye(2), (self.teams, 1, 1))

    def asked(self):
        return np.stack([np.ones(self.teams, bool), self.clock % 2 == 0], 1)

    def earn(self, choice):
        return choice.copy(), np.zeros(self.teams)

    def ends(self):
        return self.clock >= 4, np.zeros(self.teams, bool)


class Chain(Probe):
    """24 cells; the right choice, which alternates, leads on, a wrong one back to the first. Reward 1 at
    the last: by chance it takes eight million tries."""

    obs_size = 24

    def begin(self, teams):
        self.cell = np.where(teams, 0, getattr(self, "cell", np.zeros(self.teams, int)))

    def observe(self):
        return np.eye(self.obs_size)[self.cell][:, None]

    def earn(self, choice):
        right = (choice[:, 0] > 0) == (self.cell % 2 == 0)
        self.cell = np.where(right, np.minimum(self.cell + 1, self.obs_size - 1), 0)
        return (self.cell == self.obs_size - 1).astype(float)[:, None], np.zeros(self.teams)

    def ends(self):
        late = self.clock >= 48
        return (self.cell == self.obs_size - 1) | late, late


class NewIds(ObsActionReward):
    """As `ObsActionReward`, but every episode comes under a new id."""

    def renew(self, over):
        self.ids = self.ids.copy()
        rows = np.repeat(over, self.members)
        top = getattr(self, "top", self.count)
        self.ids[rows] = top + np.arange(rows.sum())
        self.top = top + int(rows.sum())

    def rows_of(self, agent_ids):
        place = {int(agent): row for row, agent in enumerate(self.ids)}
        return np.array([place[int(agent)] for agent in agent_ids])


class TimeLimit(Probe):
    """Reward 1 each decision for ever, cut after 5: value 1 / (1 - gamma). As `RealEnd` it is less."""

    interrupted = True

    def earn(self, choice):
        return np.ones((self.teams, 1)), np.zeros(self.teams)

    def ends(self):
        over = self.clock >= 5
        return over, over & self.interrupted


class RealEnd(TimeLimit):
    """The same with real ends at an unobserved fifth decision: the mean of the five returns."""

    interrupted = False


class Recall(Probe):
    """A sign is seen at first and chosen at the end, `length` decisions later: only a memory knows it.

    Observations: the sign (0 but at first), and whether the answer is due.
    """

    obs_size, length, every = 2, 10, 1

    def begin(self, teams):
        self.sign = np.where(teams, self.rng.choice([-1.0, 1.0], self.teams), getattr(self, "sign", 1.0))

    def observe(self):
        out = np.zeros((self.teams, self.members, 2))
        out[:, :, 0] = np.where(self.clock < self.every, self.sign, 0.0)[:, None]
        out[:, :, 1] = (self.clock >= self.length * self.every)[:, None]
        return out

    def asked(self):
        return np.repeat((self.clock % self.every == 0)[:, None], self.members, 1)

    def earn(self, choice):
        due = self.clock == self.length * self.every
        return np.where(due[:, None], choice * self.sign[:, None], 0.0), np.zeros(self.teams)

    def ends(self):
        return self.clock > self.length * self.every, np.zeros(self.teams, bool)


class LongRecall(Recall):
    """The same over sixty decisions."""

    length = 60


class StaggeredRecall(Recall):
    """The same for an agent that is asked every third round."""

    every = 3


class TeamRecall(Recall):
    """A team of two: the first sees the sign, both remember what they see, the first answers for both."""

    members = 2

    def observe(self):
        out = super().observe()
        out[:, 1, 0] = 0.0
        return out

    def earn(self, choice):
        due = self.clock == self.length * self.every
        return np.zeros((self.teams, 2)), np.where(due, choice[:, 0] * self.sign, 0.0)


PROBES = {
    cls.__name__: cls
    for cls in (
        *(Constant, ObsReward, Delayed, ActionReward, ObsActionReward),
        *(Credit, MateKnows, EarlyDeath, Staggered, NewIds, TimeLimit, RealEnd),
        *(Recall, LongRecall, StaggeredRecall, TeamRecall),
        Chain,
    )
}


def make(seed: int, probe: str, **params: Any) -> BaseEnv:
    """Build a probe by name (for env.factory)."""
    return PROBES[probe](seed, **params)
