"""One behavior's side of a round: records of a BaseEnv gathered into arrays of slots.

Arrays are ``[N, ...]`` with N = G * A slots. Records have passed `RecordCheck` before they come here. Flags
are tested with `np.count_nonzero`, which takes a fifth of the time of `any` and `all`.

A round begins when actions are handed over and ends with the first result in which an agent requests a
decision. What arrives in it for a slot is added up: the reward of a terminal step belongs to the row
that the round closes, the observation of a decision step opens the next row.

Death masking: an agent that ends for good while its team plays on *departs*. Its slot then stays
without acting, earns what its team earns, and is done when the team's episode is.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from mlagents_envs.base_env import ActionTuple, BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.envs.slots import SlotTable
from mappo_unity.scenes.contract.rules import EnvironmentDataError as EnvironmentDataError


class Episode(NamedTuple):
    """A finished episode of one agent, as the environment reported it."""

    agent_id: int
    individual_return: float
    group_return: float
    length: int  # decisions
    interrupted: bool
    group_id: int = 0  # 0 = alone


@dataclass
class BehaviorState:
    """Gather the records of one behavior, round by round."""

    name: str
    spec: BehaviorSpec
    slots: SlotTable
    death_masking: bool = True
    obs: list[np.ndarray] = field(init=False)  # float32 [N, *shape]: newest observation of a slot
    end_obs: list[np.ndarray] = field(init=False)  # the same, but the terminal one where the round ended
    mask: np.ndarray = field(init=False)  # bool [N, sum of branches], True = allowed

    def __post_init__(self) -> None:
        count = self.slots.num_teams * self.slots.team_size
        self.obs = [np.zeros((count, *o.shape), np.float32) for o in self.spec.observation_specs]
        self.mask = np.ones((count, sum(self.spec.action_spec.discrete_branches)), bool)

        self.acting = np.zeros(count, bool)
        self.first = np.zeros(count, bool)
        self.present = np.zeros(count, bool)
        self.departed = np.zeros(count, bool)
        self.order = np.zeros(0, np.int64)  # slots in the order of the last DecisionSteps

        self.individual_return = np.zeros(count)
        self.group_return = np.zeros(count)
        self.length = np.zeros(count, np.int64)
        self.finished: list[Episode] = []

        self.begin_round()

    def begin_round(self) -> None:
        """Forget the last round's rewards and ends."""
        count = len(self.acting)
        # new arrays, not zeroed ones: `next_entries` handed the old ones out without a copy
        self.reward = np.zeros(count, np.float32)
        self.group_reward = np.zeros(count, np.float32)
        self.terminated = np.zeros(count, bool)
        self.truncated = np.zeros(count, bool)
        self.acting = np.zeros(count, bool)
        self.first = np.zeros(count, bool)  # acting, and the first decision of its agent's episode
        self.crashed = np.zeros(count, bool)  # slots whose episode `mark_crashed` named in this round
        self.order = np.zeros(0, np.int64)
        self._terminal_obs: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def add(self, decision: DecisionSteps, terminal: TerminalSteps) -> None:
        """Take one result in: first the ends, then the new decisions."""
        # an agent that is in both has ended, and its decision is the first of its next episode
        if len(terminal):
            self._add_terminal(terminal)
        if len(decision):
            self._add_decision(decision)

    def mark_crashed(self, agent_ids: np.ndarray) -> None:
        """Mark agents whose player crashed, before `add` ends their episodes: these do not count.

        Members of their teams that departed earlier go with them.
        """
        slots = self.slots.lookup(agent_ids)
        self.crashed[slots[slots >= 0]] = True

        teams = self.crashed.reshape(-1, self.slots.team_size).any(1)
        self.crashed |= self.departed & np.repeat(teams, self.slots.team_size)

    def end_round(self) -> None:
        """Fix `end_obs`: the terminal observation where an episode ended, else the newest."""
        # copies: these are handed out, while `obs` is written into again
        self.end_obs = [o.copy() for o in self.obs]
        for rows, observations in self._terminal_obs:
            for own, new in zip(self.end_obs, observations):
                own[rows] = new

    def forget_agents(self) -> None:
        """Begin anew after a reset of the whole scene: episodes are cut, nobody acts yet."""
        self.slots.ended[:] = True
        self.present[:] = False
        self.departed[:] = False
        self.individual_return[:] = self.group_return[:] = self.length[:] = 0
        self.begin_round()

    def actions(self, action: np.ndarray, limit: float) -> ActionTuple:
        """Return the actions of the agents that requested a decision, in the order of their requests.

        Args:
            action: ``[N, C + K]``: continuous columns first, then branch indices.
            limit: continuous columns are clipped to +-limit and divided by it.
        """
        rows = action[self.order]
        size = self.spec.action_spec.continuous_size
        out = ActionTuple()

        if size:
            clipped = np.minimum(np.maximum(rows[:, :size], -limit), limit)
            out.add_continuous(clipped.astype(np.float32, copy=False) / np.float32(limit))

        if self.spec.action_spec.discrete_size:
            out.add_discrete(rows[:, size:].astype(np.int32))

        return out

    def _add_terminal(self, terminal: TerminalSteps) -> None:
        slots = self.slots.lookup(terminal.agent_id)
        own = slots >= 0
        # an end counts while its agent plays: not a second time, and not after it has departed
        if np.count_nonzero(own):
            own[own] = self.present[slots[own]] & ~self.departed[slots[own]]

        count = np.count_nonzero(own)
        if count < len(own):  # ends of agents that never requested a decision: nobody's row
            if not count:
                return
            rows = slots[own]
            observations = [o[own] for o in terminal.obs]
        else:
            rows, observations = slots, terminal.obs

        interrupted = terminal.interrupted[own]
        self.reward[rows] += terminal.reward[own]
        self.group_reward[rows] += terminal.group_reward[own]
        self._finish_episodes(rows, terminal.reward[own], terminal.group_reward[own], interrupted)
        self.slots.ended[rows] = True
        # before `_team_plays_on`, which counts who is present
        self.present[rows] = False

        # who ends while its team plays on departs: its slot stays, sees zeros and earns on
        leaves = np.zeros(len(rows), bool)
        if self.death_masking and self.slots.team_size > 1:
            leaves = self._team_plays_on(rows) & ~interrupted
            # before these depart too: they have received their group reward above
            self._settle_departed(rows[~leaves], rows, terminal.group_reward[own])
            self.departed[rows[leaves]] = True
            self.present[rows[leaves]] = True
            for o in self.obs:
                o[rows[leaves]] = 0

        over = ~leaves
        ends = rows[over]
        self.terminated[ends] = ~interrupted[over]
        self.truncated[ends] = interrupted[over]

        # copies: an environment may write its next observations into the same arrays
        self._terminal_obs.append((ends, [o[over] for o in observations]))

    def _add_decision(self, decision: DecisionSteps) -> None:
        slots = self.slots.assign(decision.agent_id, decision.group_id)

        # an episode's return counts every reward, a row only what its action earned
        self.individual_return[slots] += decision.reward
        self.group_return[slots] += decision.group_reward
        self.length[slots] += 1

        goes_on = self.present[slots] & ~self.departed[slots]
        if np.count_nonzero(goes_on) == len(goes_on):
            earners, reward, group_reward = slots, decision.reward, decision.group_reward
        else:  # what a first decision brings was earned by no action
            returns = slots[self.departed[slots]]
            self.terminated[returns] = True  # it is back before its team ended: its old episode is over
            self.departed[slots] = False
            self.present[slots] = True
            self.slots.ended[slots] = False
            earners = slots[goes_on]
            reward, group_reward = decision.reward[goes_on], decision.group_reward[goes_on]

        self.reward[earners] += reward
        self.group_reward[earners] += group_reward

        if np.count_nonzero(self.departed):
            self._share_group_reward(slots, decision.group_reward)

        for own, new in zip(self.obs, decision.obs):
            own[slots] = new
        if self.mask.shape[1]:
            # ML-Agents marks what is forbidden, we mark what is allowed
            masks = decision.action_mask
            self.mask[slots] = True if masks is None else ~np.concatenate(masks, axis=1)

        self.acting[slots] = True
        self.first[slots] = self.length[slots] == 1
        self.order = slots

    def _finish_episodes(
        self, rows: np.ndarray, reward: np.ndarray, group_reward: np.ndarray, interrupted: np.ndarray
    ) -> None:
        self.individual_return[rows] += reward
        self.group_return[rows] += group_reward

        for agent, slot, cut in zip(self.slots.agents_of(rows), rows.tolist(), interrupted.tolist()):
            # an episode that a crash cut off says nothing about the policy
            if self.crashed[slot]:
                continue
            returns = float(self.individual_return[slot]), float(self.group_return[slot])
            self.finished.append(Episode(agent, *returns, int(self.length[slot]), bool(cut)))

        self.individual_return[rows] = self.group_return[rows] = self.length[rows] = 0

    def _team_plays_on(self, rows: np.ndarray) -> np.ndarray:
        size = self.slots.team_size
        alive = (self.present & ~self.departed).reshape(-1, size).max(axis=1)
        return np.asarray(alive)[rows // size]

    def _settle_departed(self, ends: np.ndarray, rows: np.ndarray, group_reward: np.ndarray) -> None:
        """Members that departed earlier earn what this end brought, and end with their team."""
        if not np.count_nonzero(self.departed):
            return
        self._share_group_reward(rows, group_reward)

        team_ended = np.zeros(self.slots.num_teams, bool)
        team_ended[ends // self.slots.team_size] = True
        over = self.departed & np.repeat(team_ended, self.slots.team_size)

        self.terminated[over] = True
        self.departed[over] = False
        self.present[over] = False

    def _share_group_reward(self, rows: np.ndarray, group_reward: np.ndarray) -> None:
        """Give the departed what a team mate of theirs received as group reward just now."""
        # Unity adds a group reward to every member: the first that reports stands for its team
        teams, first = np.unique(rows // self.slots.team_size, return_index=True)

        share = np.zeros(self.slots.num_teams, np.float32)
        share[teams] = group_reward[first]

        departed = np.flatnonzero(self.departed)
        self.group_reward[departed] += share[departed // self.slots.team_size]

    _ARRAYS = (
        *("acting", "first", "present", "departed", "order", "mask"),
        *("individual_return", "group_return", "length"),
    )

    def get_state(self) -> dict:
        """Return everything that a round begun after `set_state` needs."""
        state = {name: getattr(self, name).copy() for name in self._ARRAYS}
        return state | {"slots": self.slots.get_state(), "obs": [o.copy() for o in self.obs]}

    def set_state(self, state: dict) -> None:
        """Go back to a state that `get_state` returned."""
        # older snapshots do not say whose decision is the first of an episode
        state = {"first": state["acting"] & (state["length"] == 1)} | state
        for name in self._ARRAYS:
            setattr(self, name, np.array(state[name], getattr(self, name).dtype))
        self.obs = [np.array(o, np.float32) for o in state["obs"]]
        self.slots.set_state(state["slots"])
