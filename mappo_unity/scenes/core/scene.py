"""The stepping loop that every embedded scene stands on: Unity ML-Agents' framework rules, vectorised.

In: a scene's declarations and hooks (`hooks.py` says how to write a scene). Out: a
`mlagents_envs.base_env.BaseEnv`. Knows no scene.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from mlagents_envs.base_env import (
    ActionTuple,
    BaseEnv,
    BehaviorMapping,
    DecisionSteps,
    TerminalSteps,
)
from mlagents_envs.exception import UnityActionException, UnityEnvironmentException

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.action_check import ActionCheck
from mappo_unity.scenes.core.agents import Agents
from mappo_unity.scenes.core.hooks import SceneHooks
from mappo_unity.scenes.core.records import Records, steps_from_state, steps_state
from mappo_unity.scenes.core.specs import at_least_one, checked_parameter, checked_seed


class Scene(SceneHooks, BaseEnv):
    """Run N areas of a Unity example scene under ML-Agents' rules, without Unity.

    Arguments of every scene: `num_areas` copies of the playing area (None: as many as Unity's scene),
    `num_threads` for physics, `seed` of the one random generator `self.rng`, and environment parameters.
    """

    def __init__(
        self, *, num_areas: int | None = None, num_threads: int = 1, seed: int = 0, **parameters: float
    ) -> None:
        self.num_areas = at_least_one("num_areas", num_areas or self.DEFAULT_NUM_AREAS, num_areas)
        self.num_threads = at_least_one("num_threads", num_threads, num_threads)
        self.rng = np.random.default_rng(checked_seed(seed))
        self.agents_per_area = len(self.AREA_BEHAVIORS)
        self.num_slots = self.num_areas * self.agents_per_area
        self.parameters = {name: known.default for name, known in self.PARAMETERS.items()}
        for name, value in parameters.items():
            self.parameters[name] = checked_parameter(self.NAME, self.PARAMETERS, name, value)
        self._specs = BehaviorMapping({behavior.name: behavior.spec() for behavior in self.BEHAVIORS})
        self._checks = [ActionCheck(behavior) for behavior in self.BEHAVIORS]
        self._index = {behavior.name: i for i, behavior in enumerate(self.BEHAVIORS)}
        self.agents = Agents(
            np.tile(np.array(self.AREA_BEHAVIORS), self.num_areas),
            self.home_groups(),
            len(self.BEHAVIORS),
            max(behavior.continuous for behavior in self.BEHAVIORS),
            max(len(behavior.branches) for behavior in self.BEHAVIORS),
        )
        self._records = Records(self.BEHAVIORS, self.agents)
        self._results: list[tuple[DecisionSteps, TerminalSteps]] = []
        self._asked = np.zeros(0, np.int64)
        self._asked_rows: list[np.ndarray] = [self._asked for _ in self.BEHAVIORS]
        self.counter = 0  # the academy's step count: ticks since the start or the last env.reset()
        self.after_tick: Callable[[], None] | None = None  # called at the end of every tick, to show it
        self._closed = False

    # ---- what hooks call --------------------------------------------------------------------------------

    def set_reward(self, slots: np.ndarray, value: np.ndarray | float) -> None:
        """Replace the reward since the last decision record (SetReward)."""
        self.agents.reward[slots] = value

    def add_reward(self, slots: np.ndarray, value: np.ndarray | float) -> None:
        """Add to the reward since the last decision record (AddReward); no slot twice in one call."""
        self.agents.reward[slots] += value

    def add_group_reward(self, slots: np.ndarray, value: np.ndarray | float) -> None:
        """Add a group's reward; pass all slots of the group, those that have left it get none."""
        self.agents.group_reward[slots] += np.where(self.agents.group_id[slots] > 0, value, 0)

    def end_episode(self, slots: np.ndarray, interrupted: bool = False) -> None:
        """End episodes of enabled `slots`: terminal records now, then `begin_episode`.

        Serves EndEpisode, EndGroupEpisode (pass all slots of the group) and, with `interrupted`, their
        time limits. An agent that already ended since its last decision sends no second record.
        """
        slots = self._enabled_slots(slots)
        if slots.size:
            self._send_terminals(slots, interrupted)
            self.agents.clear_actions(slots)
            self.agents.step_count[slots] = 0
            self.begin_episode(slots)

    def disable(self, slots: np.ndarray) -> None:
        """Disable agents: terminal records (not interrupted), then they leave their groups."""
        slots = self._enabled_slots(slots)
        self._send_terminals(slots, False)
        self.agents.disable(slots)

    def enable(self, slots: np.ndarray, group_ids: np.ndarray | int = 0) -> None:
        """Enable disabled agents of `slots` under new ids, in their order, and begin their episodes.

        `group_ids`: a group id a slot (`home_groups()[slots]`: as at the start) or one for all.
        """
        slots = _as_slots(slots)
        keep = ~self.agents.enabled[slots]
        slots = slots[keep]
        if slots.size:
            self.agents.enable(slots, group_ids[keep] if isinstance(group_ids, np.ndarray) else group_ids)
            self._records.clear_stacks(slots)
            if self.started:
                self.begin_episode(slots)

    def switch_behavior(self, slots: np.ndarray, behavior: np.ndarray | int) -> None:
        """Move agents to another behavior (SetModel), whether it differs or not.

        An agent that has not ended since its last decision sends a terminal record under its old
        behavior, not interrupted; no episode begins. `behavior`: an index, or one a slot.
        """
        slots = _as_slots(slots)
        behavior = np.broadcast_to(behavior, slots.shape)
        keep = self.agents.enabled[slots]
        self._send_terminals(slots[keep], False)
        self.agents.move(slots, behavior)

    def home_groups(self) -> np.ndarray:
        """Return the group id of every slot at the start, int32 [S]: numbered from 1, area by area."""
        per_area = np.array(self.AREA_GROUPS)
        first = np.arange(self.num_areas)[:, None] * (per_area.max() + 1) + 1
        return np.where(per_area >= 0, first + per_area, 0).astype(np.int32).ravel()

    @property
    def started(self) -> bool:
        """Whether the first env.reset() has happened."""
        return bool(self._results)

    # ---- BaseEnv ----------------------------------------------------------------------------------------

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """Return the specs of all behaviors, complete from the start."""
        return self._specs

    def reset(self) -> None:
        """Reset as Unity's academy does: the first time tick 0, later at the exchange of a running tick.

        A later reset sends no terminal records and clears neither stacks nor rewards; the running tick
        ends with zero actions, so the first records after it are one tick old.
        """
        self._check_open()
        if self.started:
            self.counter = 0
            self.agents.step_count[:] = 0
            slots = self.agents.order
            self.agents.clear_actions(slots)
            self.begin_episode(slots)
            self._finish_tick()
        self._run_to_exchange()

    def step(self) -> None:
        """Go on until some agent reports: asks for a decision, or has ended."""
        self._check_open()
        if not self.started:
            return self.reset()
        self._finish_tick()
        self._run_to_exchange()

    def close(self) -> None:
        """Release the scene; further steps are an error."""
        self._closed = True

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of the last exchange."""
        behavior = self._behavior(behavior_name)
        if not self.started:
            raise UnityActionException(f"behavior {behavior_name} has no steps yet: call reset() first")
        return self._results[behavior]

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents in the last decision steps, in their order."""
        behavior = self._behavior(behavior_name)
        slots = self._asked_rows[behavior]
        self._checks[behavior](action, self.agents.agent_id[slots])
        self.agents.store_actions(slots, action.continuous, action.discrete)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent in the last decision steps; those never set act with zeros."""
        behavior = self._behavior(behavior_name)
        slots = self._asked_rows[behavior]
        slot = slots[self.agents.agent_id[slots] == agent_id]
        if not slot.size:
            raise IndexError(f"agent {agent_id} of {behavior_name} did not request a decision")
        self._checks[behavior](action, self.agents.agent_id[slot])
        self.agents.store_actions(slot, action.continuous, action.discrete)

    def set_parameter(self, name: str, value: float) -> None:
        """Set an environment parameter; the scene's sheet says when it takes effect."""
        self.parameters[name] = checked_parameter(self.NAME, self.PARAMETERS, name, value)
        self.parameter_changed(name)

    # ---- snapshots --------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return an exact snapshot between two calls of `step`, made of dicts, lists, arrays and values."""
        return {
            "scene": self.NAME,
            "num_areas": self.num_areas,
            "counter": self.counter,
            "rng": self.rng.bit_generator.state,
            "parameters": dict(self.parameters),
            "agents": self.agents.get_state(),
            "stacks": self._records.get_state(),
            "asked": self._asked.copy(),
            "results": [[steps_state(d), steps_state(t)] for d, t in self._results],
            "state": self.scene_state(),
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a snapshot of a scene of the same name and number of areas.

        Raises ConfigError: the snapshot belongs to another scene or another number of areas.
        """
        for key, mine in (("scene", self.NAME), ("num_areas", self.num_areas)):
            if state.get(key) != mine:
                raise ConfigError(f"the snapshot has {key}={state.get(key)!r}, this scene {key}={mine!r}")
        self.counter = state["counter"]
        self.rng.bit_generator.state = state["rng"]
        self.parameters = dict(state["parameters"])
        self.agents.set_state(state["agents"])
        self._records.set_state(state["stacks"])
        self._results = [(steps_from_state(d), steps_from_state(t)) for d, t in state["results"]]
        self._set_asked(state["asked"].copy())
        self.load_scene_state(state["state"])

    # ---- the tick ---------------------------------------------------------------------------------------

    def _run_to_exchange(self) -> None:
        while not self._begin_tick():
            self._finish_tick()

    def _begin_tick(self) -> bool:
        """Run a tick up to the exchange with Python; return whether there is one."""
        agents = self.agents
        self.fixed_update()
        if not self.started:
            self.begin_episode(agents.order)
        decides = self.decides()
        if decides is True:
            self._set_asked(agents.order)
        else:
            self._set_asked(agents.order[:0] if decides is False else agents.order[decides[agents.order]])
        self.counter += 1
        agents.count_tick()
        if not self._asked.size and not len(self._records) and self.started:
            return False
        frames = self.observe_all(self._asked_rows) if self._asked.size else [[] for _ in self.BEHAVIORS]
        self._results = list(map(self._result, range(len(frames)), frames))
        agents.clear_actions(self._asked)
        return True

    def _finish_tick(self) -> None:
        """Run a tick from the exchange with Python to its end."""
        slots = self.agents.order if self.TAKE_ACTIONS_BETWEEN_DECISIONS else self._asked
        if slots.size:
            self.act(slots)
        if self.MAX_STEP:
            late = self.agents.step_count >= self.MAX_STEP
            if np.count_nonzero(late):
                self.end_episode(late, interrupted=True)
        self.controllers()
        self.simulate()
        if self.after_tick is not None:
            self.after_tick()

    def _result(self, behavior: int, frames: list[np.ndarray]) -> tuple[DecisionSteps, TerminalSteps]:
        slots = self._asked_rows[behavior]
        discrete = self.BEHAVIORS[behavior].branches and slots.size
        mask = self.action_mask(behavior, slots) if discrete else None
        decisions = self._records.decisions(behavior, slots, frames, mask)
        return decisions, self._records.take_terminals(behavior)

    def _send_terminals(self, slots: np.ndarray, interrupted: bool) -> None:
        agents = self.agents
        slots = slots[~agents.done[slots]]
        for behavior in range(len(self.BEHAVIORS)):
            rows = slots if len(self.BEHAVIORS) == 1 else slots[agents.behavior[slots] == behavior]
            if rows.size:
                self._records.end(behavior, rows, self.observe(behavior, rows), interrupted)

    def _set_asked(self, slots: np.ndarray) -> None:
        self._asked = slots
        if slots is self.agents.order:
            self._asked_rows = self.agents.members
        elif not slots.size:
            self._asked_rows = [slots] * len(self.BEHAVIORS)
        else:
            self._asked_rows = [slots[self.agents.behavior[slots] == i] for i in range(len(self.BEHAVIORS))]

    # ---- checks -----------------------------------------------------------------------------------------

    def _enabled_slots(self, slots: np.ndarray) -> np.ndarray:
        slots = _as_slots(slots)
        return slots[self.agents.enabled[slots]]

    def _behavior(self, name: str) -> int:
        try:
            return self._index[name]
        except KeyError:
            known = list(self._index)
            raise UnityActionException(
                f"scene {self.NAME} has no behavior {name!r}; it has {known}"
            ) from None

    def _check_open(self) -> None:
        if self._closed:
            raise UnityEnvironmentException(f"scene {self.NAME} is closed")


def _as_slots(slots: np.ndarray) -> np.ndarray:
    slots = np.asarray(slots)
    return np.flatnonzero(slots) if slots.dtype == bool else slots.reshape(-1)
