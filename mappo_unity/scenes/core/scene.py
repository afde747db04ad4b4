"""The stepping loop that every embedded scene stands on: Unity ML-Agents' framework rules, vectorised.

A scene adds declarations and hooks (../README.md); `tick` says in what order the hooks are called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np
from mlagents_envs.base_env import ActionTuple, BaseEnv, BehaviorMapping, DecisionSteps, TerminalSteps
from mlagents_envs.exception import UnityEnvironmentException

from mappo_unity.config.parameters.samplers import Value
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.agents import Agents, as_slots
from mappo_unity.scenes.core.exchange import Exchange
from mappo_unity.scenes.core.parameters import Parameters
from mappo_unity.scenes.core.records import Records, steps_from_state, steps_state
from mappo_unity.scenes.core.specs import Behavior, Parameter, at_least_one, checked_seed
from mappo_unity.scenes.core.tick import finish_tick, run_to_exchange, start


class Scene(BaseEnv):
    """Run N areas of a Unity example scene under ML-Agents' rules, without Unity.

    Arguments of every scene: `num_areas` copies of the playing area (None: as many as Unity's scene),
    `num_threads` for physics, `seed` of the one random generator `self.rng`, and environment parameters.
    """

    NAME: ClassVar[str]
    """Name of the scene."""
    DEFAULT_NUM_AREAS: ClassVar[int] = 1
    """Areas of the Unity scene."""
    BEHAVIORS: ClassVar[tuple[Behavior, ...]]
    """Behaviors, in the order in which Unity lists them."""
    AREA_BEHAVIORS: ClassVar[tuple[int, ...]] = (0,)
    """First behavior (index) of each agent of an area; the order gives the agent ids."""
    AREA_GROUPS: ClassVar[tuple[int, ...]] = (-1,)
    """Group of each agent of an area, from 0 in creation order; -1: none (group id 0)."""
    DECISION_PERIOD: ClassVar[int] = 5
    """Ticks between two decisions."""
    TAKE_ACTIONS_BETWEEN_DECISIONS: ClassVar[bool] = True
    """Whether `act` runs every tick, or only in ticks of a decision."""
    MAX_STEP: ClassVar[int] = 0
    """Ticks after which an agent's episode is interrupted; 0: never."""
    PARAMETERS: ClassVar[Mapping[str, Parameter]] = {}
    """Environment parameters that the scene reads, as `self.parameters[name]` or `self.parameters.draw`."""

    counter: int
    """Ticks of the academy since the start or the last env.reset()."""
    is_staggered = False
    """Whether the first reset lets a random part of each area's time limit be over (`pass_time`)."""

    def __init__(
        self, *, num_areas: int | None = None, num_threads: int = 1, seed: int = 0, **parameters: Value
    ) -> None:
        self.num_areas = at_least_one("num_areas", num_areas or self.DEFAULT_NUM_AREAS, num_areas)
        self.num_threads = at_least_one("num_threads", num_threads, num_threads)
        self.rng = np.random.default_rng(checked_seed(seed))
        self.parameters = Parameters(self.NAME, self.PARAMETERS, seed)
        for name, value in parameters.items():
            self.parameters.set(name, value)

        self.agents_per_area = len(self.AREA_BEHAVIORS)
        self.num_slots = self.num_areas * self.agents_per_area
        self.agents = Agents(
            np.tile(np.array(self.AREA_BEHAVIORS), self.num_areas),
            self.home_groups(),
            len(self.BEHAVIORS),
            max(behavior.continuous for behavior in self.BEHAVIORS),
            max(len(behavior.branches) for behavior in self.BEHAVIORS),
        )
        self.records = Records(self.BEHAVIORS, self.agents)
        self.exchange = Exchange(self.NAME, self.BEHAVIORS, self.agents)

        self.counter = 0
        self.after_tick: Callable[[], None] | None = None  # called at the end of every tick, to show it
        self._closed = False

    # ---- hooks: what a scene is written with -------------------------------------------------------------

    def begin_episode(self, slots: np.ndarray) -> None:
        """Begin new episodes of `slots` (OnEpisodeBegin); draw from `self.rng` here."""
        raise NotImplementedError

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return a new list: for each sensor a new array float32 ``[len(slots), *shape]``, not stacked."""
        raise NotImplementedError

    def observe_all(self, slots: list[np.ndarray]) -> list[list[np.ndarray]]:
        """Return what `observe` does for `slots` of every behavior; override to save work in common."""
        if len(slots) == 1:
            return [self.observe(0, slots[0])]
        return [self.observe(behavior, rows) if rows.size else [] for behavior, rows in enumerate(slots)]

    def act(self, slots: np.ndarray) -> None:
        """Execute the stored actions of `slots`; give rewards, end episodes (OnActionReceived)."""
        raise NotImplementedError

    def simulate(self) -> None:
        """Advance physics by one tick, then handle contacts; those may end episodes too."""

    def fixed_update(self) -> None:
        """Run the agents' own FixedUpdate, before the academy's step of this tick."""

    def controllers(self) -> None:
        """Run scripts that follow the academy's step (area timers), before physics."""

    def decides(self) -> bool | np.ndarray:
        """Return who requests a decision this tick: all, none, or a mask bool over slots."""
        return self.counter % self.DECISION_PERIOD == 0

    def action_mask(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        """Return one bool ``[len(slots), branch size]`` a discrete branch, True = forbidden."""
        return [np.zeros((len(slots), size), bool) for size in self.BEHAVIORS[behavior].branches]

    def pass_time(self, share: np.ndarray) -> None:
        """Let a share [N] of the areas' time limits be over; override it where areas have own clocks."""
        self.agents.step_count[:] = np.repeat(share * self.MAX_STEP, self.agents_per_area)

    def parameter_changed(self, name: str) -> None:
        """Apply a parameter that acts at once (gravity); others are read at the next reset."""

    def scene_state(self) -> dict[str, Any]:
        """Return everything of the scene that a snapshot needs, as numpy arrays and plain values."""
        return {}

    def load_scene_state(self, state: dict[str, Any]) -> None:
        """Restore what `scene_state` returned."""

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
        slots = self.agents.enabled_slots(slots)
        if slots.size:
            self._send_terminals(slots, interrupted)
            self.agents.clear_actions(slots)
            self.agents.step_count[slots] = 0
            self.begin_episode(slots)

    def disable(self, slots: np.ndarray) -> None:
        """Disable agents: terminal records (not interrupted), then they leave their groups."""
        slots = self.agents.enabled_slots(slots)
        self._send_terminals(slots, False)
        self.agents.disable(slots)

    def enable(self, slots: np.ndarray, group_ids: np.ndarray | int = 0) -> None:
        """Enable disabled agents of `slots` under new ids, in their order, and begin their episodes.

        `group_ids`: a group id a slot (`home_groups()[slots]`: as at the start) or one for all.
        """
        slots = as_slots(slots)
        keep = ~self.agents.enabled[slots]
        slots = slots[keep]
        if slots.size:
            self.agents.enable(slots, group_ids[keep] if isinstance(group_ids, np.ndarray) else group_ids)
            self.records.clear_stacks(slots)
            if self.started:
                self.begin_episode(slots)

    def switch_behavior(self, slots: np.ndarray, behavior: np.ndarray | int) -> None:
        """Move agents to another behavior (SetModel), whether it differs or not.

        An agent that has not ended since its last decision sends a terminal record under its old
        behavior, not interrupted; no episode begins. `behavior`: an index, or one a slot.
        """
        slots = as_slots(slots)
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
        return bool(self.exchange.results)

    # ---- BaseEnv ----------------------------------------------------------------------------------------

    @property
    def behavior_specs(self) -> BehaviorMapping:
        """Return the specs of all behaviors, complete from the start."""
        return self.exchange.specs

    def reset(self) -> None:
        """Reset as Unity's academy does: the first time tick 0, later at the exchange of a running tick.

        A later reset sends no terminal records and clears neither stacks nor rewards; the running tick
        ends with zero actions, so the first records after it are one tick old.
        """
        self._check_open()
        if not self.started:
            return start(self)
        self.counter = 0
        self.agents.step_count[:] = 0
        slots = self.agents.order
        self.agents.clear_actions(slots)
        self.begin_episode(slots)
        finish_tick(self)
        run_to_exchange(self)

    def step(self) -> None:
        """Run ticks until some agent reports: requests a decision, or has ended."""
        self._check_open()
        if not self.started:
            return self.reset()
        finish_tick(self)
        run_to_exchange(self)

    def close(self) -> None:
        """Release the scene; further steps are an error."""
        self._closed = True

    def get_steps(self, behavior_name: str) -> tuple[DecisionSteps, TerminalSteps]:
        """Return the decision and terminal steps of the last exchange."""
        return self.exchange.get_steps(behavior_name)

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        """Set the actions of all agents in the last decision steps, in their order."""
        self.exchange.set_actions(behavior_name, action)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        """Set the action of one agent in the last decision steps; those never set act with zeros."""
        self.exchange.set_action_for_agent(behavior_name, agent_id, action)

    def set_parameter(self, name: str, value: Value) -> None:
        """Set an environment parameter; the scene's sheet says when it takes effect."""
        self.parameters.set(name, value)
        self.parameter_changed(name)

    # ---- snapshots --------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return an exact snapshot between two calls of `step`, made of dicts, lists, arrays and values."""
        return {
            "scene": self.NAME,
            "num_areas": self.num_areas,
            "counter": self.counter,
            "rng": self.rng.bit_generator.state,
            "parameters": self.parameters.get_state(),
            "agents": self.agents.get_state(),
            "stacks": self.records.get_state(),
            "asked": self.exchange.asked.copy(),
            "results": [[steps_state(d), steps_state(t)] for d, t in self.exchange.results],
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
        self.parameters.set_state(state["parameters"])
        self.agents.set_state(state["agents"])
        self.records.set_state(state["stacks"])
        self.exchange.results = [(steps_from_state(d), steps_from_state(t)) for d, t in state["results"]]
        # After the agents: it parts them by the behaviors that they have now.
        self.exchange.ask(state["asked"].copy())
        self.load_scene_state(state["state"])

    def _send_terminals(self, slots: np.ndarray, interrupted: bool) -> None:
        slots = slots[~self.agents.done[slots]]
        for behavior in range(len(self.BEHAVIORS)):
            rows = slots if len(self.BEHAVIORS) == 1 else slots[self.agents.behavior[slots] == behavior]
            if rows.size:
                self.records.end(behavior, rows, self.observe(behavior, rows), interrupted)

    def _check_open(self) -> None:
        if self._closed:
            raise UnityEnvironmentException(f"scene {self.NAME} is closed")
