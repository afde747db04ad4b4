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

import numpy as np
from mlagents_envs.base_env import BehaviorSpec, DecisionSteps, TerminalSteps

from mappo_unity.envs.ends import RoundEnds
from mappo_unity.envs.group_rewards import GroupRewards
from mappo_unity.envs.images import as_stored, stored_types
from mappo_unity.envs.returns import Episode as Episode
from mappo_unity.envs.returns import Returns
from mappo_unity.envs.slots import SlotTable
from mappo_unity.scenes.contract.rules import EnvironmentDataError as EnvironmentDataError


@dataclass
class BehaviorState:
    """Gather the records of one behavior, round by round."""

    name: str
    spec: BehaviorSpec
    slots: SlotTable
    death_masking: bool = True
    obs: list[np.ndarray] = field(init=False)  # [N, *shape], newest of a slot: float32, `ByteImage`s uint8
    end_obs: list[np.ndarray] = field(init=False)  # the same, but the terminal one where an episode ended
    end_present: np.ndarray = field(init=False)  # bool [N]: `present`, as of its end where one ended
    end_departed: np.ndarray = field(init=False)  # likewise
    mask: np.ndarray = field(init=False)  # bool [N, sum of branches], True = allowed

    def __post_init__(self) -> None:
        count = self.slots.num_teams * self.slots.team_size
        self._shapes = [tuple(o.shape) for o in self.spec.observation_specs]
        shapes = zip(self._shapes, stored_types(self.spec))
        self.obs = [np.zeros((count, *shape), kind) for shape, kind in shapes]
        self.mask = np.ones((count, sum(self.spec.action_spec.discrete_branches)), bool)

        self.acting = np.zeros(count, bool)
        self.first = np.zeros(count, bool)
        self.present = np.zeros(count, bool)
        self.departed = np.zeros(count, bool)
        self.order = np.zeros(0, np.int64)  # slots in the order of the last DecisionSteps

        self.returns = Returns(count)
        self.group_rewards: GroupRewards | None = None  # of teams whose members depart
        if self.death_masking and self.slots.team_size > 1:
            self.group_rewards = GroupRewards(self.slots.num_teams, self.slots.team_size)

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
        self._ends = RoundEnds()

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
        """Fix `end_obs` and its flags: as of the terminal observation where an episode ended, else now."""
        # copies: these are handed out, while `obs` is written into again
        self.end_obs = [o.copy() for o in self.obs]
        self.end_present, self.end_departed = self.present.copy(), self.departed.copy()

        self._ends.write(self.end_obs, self.end_present, self.end_departed)

    def forget_agents(self) -> None:
        """Begin anew after a reset of the whole scene: episodes are cut, nobody acts yet."""
        self.slots.ended[:] = True
        self.present[:] = False
        self.departed[:] = False
        self.returns.forget()
        if self.group_rewards is not None:
            self.group_rewards.forget()
        self.begin_round()

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
            observations = self._stored([o[own] for o in terminal.obs])
        else:
            rows, observations = slots, self._stored(terminal.obs)

        interrupted = terminal.interrupted[own]
        self.reward[rows] += terminal.reward[own]
        self.group_reward[rows] += terminal.group_reward[own]
        self.returns.add(rows, terminal.reward[own], terminal.group_reward[own])
        # an episode that a crash cut off says nothing about the policy
        self.returns.finish(rows, self.slots.agents_of(rows), interrupted, drop=self.crashed)
        self.slots.ended[rows] = True
        # before `_team_plays_on`, which counts who is present
        self.present[rows] = False

        plays_on = self._team_plays_on(rows)
        # who ends while its team plays on departs: its slot stays, sees zeros and earns on
        leaves = plays_on & ~interrupted if self.death_masking else np.zeros(len(rows), bool)
        # before these depart too: they have received their group reward above
        self._share_group_reward(rows, terminal.group_reward[own], np.ones(len(rows), bool))
        if np.count_nonzero(leaves):
            self._depart(rows[leaves], [o[leaves] for o in observations])

        over = ~leaves
        ends = rows[over]
        self.terminated[ends] = ~interrupted[over]
        self.truncated[ends] = interrupted[over]

        # copies: an environment may write its next observations into the same arrays
        self._ends.playing(ends, [o[over] for o in observations])

        if self.slots.team_size > 1 and np.count_nonzero(plays_on) < len(rows):
            self._end_teams(rows[~plays_on], interrupted[~plays_on])

    def _add_decision(self, decision: DecisionSteps) -> None:
        slots = self.slots.assign(decision.agent_id, decision.group_id)
        observations = self._stored(decision.obs)
        group_rewards = decision.group_reward
        if moved := len(self.slots.movers):
            self._move(slots, decision, observations)
            # what movers bring was earned in the teams that they left
            group_rewards = group_rewards.copy()
            group_rewards[self.slots.movers] = 0

        self.returns.add(slots, decision.reward, decision.group_reward)
        self.returns.length[slots] += 1

        goes_on = self.present[slots] & ~self.departed[slots]
        self._share_group_reward(slots, group_rewards, goes_on)
        if np.count_nonzero(goes_on) == len(goes_on):
            earners, reward, group_reward = slots, decision.reward, decision.group_reward
        else:  # what a first decision brings was earned by no action
            self._end_departed(slots[self.departed[slots]])
            self.departed[slots] = False
            self.present[slots] = True
            self.slots.ended[slots] = False
            earners = slots[goes_on]
            reward, group_reward = decision.reward[goes_on], decision.group_reward[goes_on]

        self.reward[earners] += reward
        self.group_reward[earners] += group_reward

        for own, new in zip(self.obs, observations):
            own[slots] = new
        if self.mask.shape[1]:
            # ML-Agents marks what is forbidden, we mark what is allowed
            masks = decision.action_mask
            self.mask[slots] = True if masks is None else ~np.concatenate(masks, axis=1)

        self.acting[slots] = True
        self.first[slots] = self.returns.length[slots] == 1
        if moved:
            self.first[slots[self.slots.movers]] = True
        self.order = slots

    def _move(self, slots: np.ndarray, decision: DecisionSteps, observations: list[np.ndarray]) -> None:
        """Cut off the rows of agents that changed their group; their episodes go on in new slots."""
        movers, left = self.slots.movers, self.slots.left
        group_reward = decision.group_reward[movers]
        self.reward[left] += decision.reward[movers]
        self.group_reward[left] += group_reward
        self.returns.move(left, slots[movers])

        self.truncated[left] = True
        self._ends.playing(left, [o[movers] for o in observations])
        self.present[left] = False

        alone = ~self._team_plays_on(left)
        if self.slots.team_size > 1 and np.count_nonzero(alone):
            everyone = np.ones(np.count_nonzero(alone), bool)
            # nobody else is left to tell the departed what they earned
            self._share_group_reward(left[alone], group_reward[alone], everyone)
            self._end_teams(left[alone], interrupted=everyone)

    def _stored(self, observations: list[np.ndarray]) -> list[np.ndarray]:
        return as_stored(self.name, self.spec, observations)

    def _team_plays_on(self, rows: np.ndarray) -> np.ndarray:
        size = self.slots.team_size
        alive = (self.present & ~self.departed).reshape(-1, size).max(axis=1)
        return np.asarray(alive)[rows // size]

    def _depart(self, rows: np.ndarray, observations: list[np.ndarray]) -> None:
        self.departed[rows] = True
        self.present[rows] = True
        self._ends.departing(rows, observations)
        for o in self.obs:
            o[rows] = 0

    def _end_departed(self, rows: np.ndarray) -> None:
        """End the old episodes of departed slots that begin anew before their team has ended.

        Their team earns on, and the value of that goes on with it: who departed earlier is cut off.
        """
        if len(rows):
            just_left = self._ends.returning(rows, self._shapes)
            self.terminated[rows[just_left]] = True
            self.truncated[rows[~just_left]] = True

    def _end_teams(self, rows: np.ndarray, interrupted: np.ndarray) -> None:
        """Members that departed earlier end with their team's last members `rows`, and as these do."""
        size = self.slots.team_size
        over, cut = np.zeros((2, self.slots.num_teams), bool)
        over[rows // size] = True
        cut[rows[interrupted] // size] = True

        departed = np.flatnonzero(self.departed & np.repeat(over, size))
        if len(departed):
            self.truncated[departed] = cut[departed // size]
            self.terminated[departed] = ~cut[departed // size]
            self.departed[departed] = False
            self.present[departed] = False
            self._ends.departed(departed, self._shapes)
        if self.group_rewards is not None:
            self.group_rewards.end(over)

    def _share_group_reward(self, slots: np.ndarray, reward: np.ndarray, known: np.ndarray) -> None:
        """Give the departed what members of their team, `known` and new ones, report now."""
        rewards = self.group_rewards
        if rewards is None:
            return
        if np.count_nonzero(known) < len(known):
            rewards.join(slots[~known])
        if rewards.changes_nothing(reward):
            return

        earned = rewards.report(slots, reward, known, self.present & ~self.departed)
        departed = np.flatnonzero(self.departed)
        self.group_reward[departed] += earned[departed // self.slots.team_size]

    _ARRAYS = ("acting", "first", "present", "departed", "order", "mask")

    def get_state(self) -> dict:
        """Return everything that a round begun after `set_state` needs."""
        state = {name: getattr(self, name).copy() for name in self._ARRAYS}
        state |= self.returns.get_state()
        if self.group_rewards is not None:
            state |= self.group_rewards.get_state()
        return state | {"slots": self.slots.get_state(), "obs": [o.copy() for o in self.obs]}

    def set_state(self, state: dict) -> None:
        """Go back to a state that `get_state` returned."""
        # older snapshots do not say whose decision is the first of an episode
        state = {"first": state["acting"] & (state["length"] == 1)} | state
        for name in self._ARRAYS:
            setattr(self, name, np.array(state[name], getattr(self, name).dtype))
        self.obs = [o.copy() for o in self._stored(state["obs"])]  # older snapshots hold all as float32
        self.returns.set_state(state)
        if self.group_rewards is not None:
            self.group_rewards.set_state(state)
        self.slots.set_state(state["slots"])
