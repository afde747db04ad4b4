"""`UnityEnv`: a BaseEnv as a TorchRL environment of batched slots.

Its TensorDicts hold one entry a behavior, ``[G, A, ...]`` (see `keys`).

One ``step`` is one round: hand actions to the agents that requested a decision, then step the BaseEnv until
an agent requests one again. Agents that end begin their next episode by themselves (auto-reset in the scene),
so a partial reset only hands out the first observation of the next episode; the scene itself is reset by a
full ``reset()`` alone, and a full reset right after another does nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from mlagents_envs.base_env import BaseEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from mappo_unity import keys
from mappo_unity.config.parameters.samplers import Value
from mappo_unity.envs.actions import action_tuple
from mappo_unity.envs.opening import first_results, team_sizes
from mappo_unity.envs.rounds import BehaviorState, Episode
from mappo_unity.envs.slots import SlotTable
from mappo_unity.envs.specs import make_specs
from mappo_unity.envs.tensordicts import next_entries, root_entries, slot_shape, unchecked
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.rules import (
    MAX_SILENT_STEPS,
    check_plain,
    check_same_specs,
    has_snapshots,
    note_silence,
    silence_error,
)
from mappo_unity.scenes.contract.statistics import Statistics, pop_statistics


class CrashedEpisodes(NamedTuple):
    """Episodes of one behavior that ended because their player crashed."""

    round: int  # the round in which they ended, see `UnityEnv.rounds`
    behavior: str
    slots: np.ndarray  # bool [G, A]


class UnityEnv(EnvBase):
    """Play a BaseEnv in rounds of batched slots.

    Args:
        make_env: called with a seed, returns the BaseEnv. `set_seed` closes it and calls again.
        seed: its first seed.
        action_limit: continuous actions are clipped to +-limit and divided by it (ML-Agents
            policies use 3), so that the environment always gets [-1, 1].
        max_team_size, max_teams: slots to keep ready; None = what is seen at the start.
        death_masking: members that end while their team plays on keep earning its reward.
    """

    _has_dynamic_specs = False

    def __init__(
        self,
        make_env: Callable[[int], BaseEnv],
        seed: int = 0,
        *,
        action_limit: float = 1.0,
        max_team_size: int | None = None,
        max_teams: int | None = None,
        death_masking: bool = True,
    ) -> None:
        super().__init__(device=None, batch_size=torch.Size([]), run_type_checks=False)
        self.is_closed = False  # EnvBase says True of environments that wrap nothing
        self._make_env = make_env
        self._limits = (max_teams, max_team_size)
        self.action_limit = float(action_limit)
        self.death_masking = death_masking

        self._open(seed)
        specs = make_specs(self._behaviors, self.entry_of, self.action_limit)
        self.observation_spec, self.action_spec, self.reward_spec, self.done_spec = specs

    # --- what a trainer needs beyond EnvBase

    sides: dict[str, list[str]]  # behaviors of every policy name
    entry_of: dict[str, str]  # behavior -> TensorDict entry: the policy name where it has one side only

    @property
    def behaviors(self) -> dict[str, BehaviorState]:
        """The behaviors by name; their specs, slots and arrays."""
        return self._behaviors

    def pop_episodes(self) -> dict[str, list[Episode]]:
        """Return the episodes that finished since the last call, a list for each behavior."""
        return {name: behavior.returns.pop() for name, behavior in self._behaviors.items()}

    def pop_statistics(self) -> Statistics:
        """Return what the environment reported of itself since the last call; raises EnvironmentDataError."""
        return pop_statistics(self.base_env)

    _crashed: list[CrashedEpisodes]
    rounds: int = 0  # rounds played since the environment was opened

    @property
    def restarts(self) -> int | None:
        """How often players were started again; None for a BaseEnv that is no player."""
        return getattr(self.base_env, "restarts", None)

    def pop_crashed_episodes(self) -> list[CrashedEpisodes]:
        """Return the episodes that crashed players ended since the last call."""
        out: list[CrashedEpisodes] = self._crashed
        self._crashed = []
        return out

    @property
    def takes_parameters(self) -> bool:
        """Whether the BaseEnv's environment parameters can be set while it plays."""
        return hasattr(self.base_env, "set_parameter")

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter; the environment decides when it takes effect."""
        self.base_env.set_parameter(name, value)

    def restart(self) -> None:
        """Reset the scene, also right after another reset; all episodes are cut."""
        self._untouched = False
        self._full_reset()

    def get_state(self) -> dict[str, Any] | None:
        """Return a snapshot between two rounds, or None if the BaseEnv cannot give one."""
        if not has_snapshots(self.base_env):
            return None

        return {
            "scene": self.base_env.get_state(),
            "behaviors": {name: behavior.get_state() for name, behavior in self._behaviors.items()},
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Go back to a snapshot; the next full reset hands out its observations unchanged.

        Raises:
            ConfigError: it is of an environment with other behaviors, or more or fewer slots for agents.
        """
        self.base_env.set_state(state["scene"])

        saved = {name: len(entries["acting"]) for name, entries in state["behaviors"].items()}
        slots = {name: len(behavior.acting) for name, behavior in self._behaviors.items()}

        # `BehaviorState.set_state` replaces arrays whole and would not notice other sizes
        if saved != slots:
            raise ConfigError(f"the snapshot has agent slots {saved}, this environment {slots}")

        for name, behavior in self._behaviors.items():
            behavior.set_state(state["behaviors"][name])

        self._untouched = True
        self.pop_statistics()  # what opening it reported is no part of the state

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the BaseEnv."""
        if not self.is_closed:
            self.base_env.close()
        super().close(raise_if_closed=raise_if_closed)

    # --- EnvBase

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # of two sides, Stack asks for ("SoccerTwos", "_reset"), which is not one of `reset_keys`
        if tensordict is None or not any("_reset" in key for key in tensordict.keys(True)):
            self._full_reset()
        return self.root()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for name, behavior in self._behaviors.items():
            if len(behavior.order):
                action = tensordict.get((self.entry_of[name], keys.ACTION)).reshape(len(behavior.acting), -1)
                asked = action.numpy()[behavior.order]
                self.base_env.set_actions(
                    name, action_tuple(behavior.spec.action_spec, asked, self.action_limit)
                )
            # only now, as it forgets the order of the requests
            behavior.begin_round()
            behavior.returns.round = self.rounds

        self._untouched = False
        self._play_until_asked()
        self._note_crashed()

        # only after `_note_crashed`, which names this round by its number
        self.rounds += 1

        following = {self.entry_of[name]: next_entries(b) for name, b in self._behaviors.items()}
        return unchecked(following, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.base_env.close()
        self._open(seed or 0)

    def _open(self, seed: int) -> None:
        self.base_env = self._make_env(int(seed))
        self._behaviors: dict[str, BehaviorState] = {}
        self._crashed = []

        # a player that is not closed here would go on running without an owner
        try:
            self.base_env.reset()
            self._first_results()
            state = self.get_state()
            if state is not None:  # what a checkpoint could not give back is seen before anything is learnt
                check_plain(state["scene"], "get_state()")
        except BaseException:
            self.base_env.close()
            raise

        self._untouched = True

    def _full_reset(self) -> None:
        # after opening, another reset or `set_state`: what stands there is handed out as it is
        if self._untouched:
            return

        self.base_env.reset()
        for behavior in self._behaviors.values():
            behavior.forget_agents()

        # the reset has already brought the first records: stepping now would lose them
        self._play_until_asked(step_first=False)
        self._untouched = True

    def _play_until_asked(self, step_first: bool = True) -> None:
        for attempt in range(MAX_SILENT_STEPS):
            if step_first or attempt:
                self.base_env.step()
            if not attempt:
                check_same_specs(self.base_env.behavior_specs, self._specs)
            if self._take_results():
                break
            note_silence(attempt, MAX_SILENT_STEPS)
        else:
            raise silence_error(MAX_SILENT_STEPS)

        for behavior in self._behaviors.values():
            behavior.end_round()

    def _take_results(self) -> bool:
        """Take in what the behaviors' agents report; return whether one requests a decision."""
        crashed = getattr(self.base_env, "crashed_agents", None)  # only players have it, see RestartingPlayer
        asked = False

        for name, behavior in self._behaviors.items():
            decision, terminal = self._checks[name](self.base_env.get_steps(name))
            if crashed and name in crashed:
                behavior.mark_crashed(crashed[name])
            behavior.add(decision, terminal)
            asked = asked or len(decision) > 0
        return asked

    def _note_crashed(self) -> None:
        for name, behavior in self._behaviors.items():
            if np.count_nonzero(behavior.crashed):
                slots = behavior.crashed.reshape(slot_shape(behavior)).copy()
                self._crashed.append(CrashedEpisodes(self.rounds, name, slots))

    def _first_results(self) -> None:
        """Read the behaviors and how many teams and agents they have from the first records."""
        first = first_results(self.base_env, MAX_SILENT_STEPS)
        self._specs = {name: seen.spec for name, seen in first.items()}
        self._checks = {name: seen.check for name, seen in first.items()}

        for name, sizes in team_sizes(first).items():
            # in the order of `_limits`; a limit of the options wins over what is seen
            teams, members = (limit or seen for limit, seen in zip(self._limits, sizes))
            table = SlotTable(name, teams, members)
            behavior = BehaviorState(name, self._specs[name], table, self.death_masking)
            behavior.add(first[name].decision, first[name].terminal)
            behavior.end_round()
            self._behaviors[name] = behavior

        self.sides = {keys.policy_name(n): [] for n in first}
        for name in first:
            self.sides[keys.policy_name(name)].append(name)
        self.entry_of = {n: p if len(sides) == 1 else n for p, sides in self.sides.items() for n in sides}

    @property
    def round_ended(self) -> bool:
        """Whether an episode ended in the last round."""
        for behavior in self._behaviors.values():
            if np.count_nonzero(behavior.terminated) or np.count_nonzero(behavior.truncated):
                return True

        return False

    def root(self) -> TensorDict:
        """Return what the agents are to act on now: entries as `reset` gives them, ends all False."""
        entries = {self.entry_of[name]: root_entries(b) for name, b in self._behaviors.items()}
        return unchecked(entries, self.batch_size)
