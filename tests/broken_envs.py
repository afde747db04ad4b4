"""A small environment that keeps the contract, and all the ways in which it can be made to break it.

`Crew(breaks)` plays; `WORDS` says for each name of a break what messages about it must say.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
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
from mlagents_envs.exception import UnityActionException

NAME, OTHER = "Crew?team=0", "Guest?team=0"
AGENTS, LENGTH = 4, 3  # agents; decisions of an episode
Steps = Any


class Crew(BaseEnv):
    """Two teams of two that all ask in every step; what `breaks` names goes wrong after `good` results."""

    def __init__(self, breaks: str = "", good: int = 2) -> None:
        self.spec = BehaviorSpec([vector_spec(3, "place"), vector_spec(2, "speed")], ActionSpec(1, (3, 2)))
        self.breaks, self.good = breaks, good
        self.results = 0
        self.clock = 0
        self.specs: Any = {NAME: self.spec}
        self.ids = np.arange(AGENTS, dtype=np.int32)
        self.groups = np.array([1, 1, 2, 2], np.int32)

    @property
    def is_broken(self) -> bool:
        return bool(self.breaks) and self.results > self.good

    @property
    def behavior_specs(self) -> Any:
        return SPECS[self.breaks](self) if self.is_broken and self.breaks in SPECS else self.specs

    def reset(self) -> None:
        if self.breaks == "reset raises":
            raise OSError("no scene")
        self.clock = 0
        self._make_result(False)

    def step(self) -> None:
        if self.breaks == "step raises" and self.is_broken:
            raise ZeroDivisionError("a pole")
        self.clock += 1
        over = self.clock == LENGTH
        self.clock %= LENGTH
        self._make_result(over)

    def _make_result(self, over: bool) -> None:
        self.results += 1
        count = AGENTS
        obs = [np.full((count, n), self.clock, np.float32) for n in (3, 2)]
        zeros = np.zeros(count, np.float32)
        masks = [np.zeros((count, n), bool) for n in (3, 2)]
        decision = DecisionSteps(obs, zeros, self.ids, masks, self.groups, zeros)
        terminal = TerminalSteps.empty(self.spec)
        if over or (self.is_broken and self.breaks in TERMINALS):
            terminal = TerminalSteps(obs, zeros, np.ones(count, bool), self.ids, self.groups, zeros)
        self.result: Any = decision, terminal

    def get_steps(self, behavior_name: str) -> Any:
        if behavior_name not in self.specs:
            raise UnityActionException(f"no behavior {behavior_name}")
        if not self.is_broken:
            return self.result
        decision, terminal = map(copy.copy, self.result)
        if self.breaks in DECISIONS:
            DECISIONS[self.breaks](decision)
        if self.breaks in TERMINALS:
            TERMINALS[self.breaks](terminal)
        return (
            RESULTS[self.breaks](self, decision, terminal) if self.breaks in RESULTS else (decision, terminal)
        )

    def set_actions(self, behavior_name: str, action: ActionTuple) -> None:
        if self.breaks == "set_actions raises":
            raise KeyError("motor")
        self.spec.action_spec._validate_action(action, AGENTS, behavior_name)

    def set_action_for_agent(self, behavior_name: str, agent_id: int, action: ActionTuple) -> None:
        if agent_id not in self.ids:
            raise UnityActionException(f"agent {agent_id} did not ask")

    def close(self) -> None:
        if self.breaks == "close raises":
            raise OSError("the door is stuck")


def make(seed: int, breaks: str = "", good: int = 2) -> BaseEnv:
    """Return the environment (for env.factory)."""
    return Crew(breaks, good)


def put(field: str, change: Callable[[Any], Any]) -> Callable[[Steps], None]:
    """Return what replaces a field of decision or terminal steps by a changed one."""

    def spoil(steps: Steps) -> None:
        value = getattr(steps, field)
        setattr(steps, field, change(copy.deepcopy(value)))

    return spoil


def at(place: Any, value: Any) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = (
            array.astype(np.result_type(array, np.float32), copy=True) if isinstance(value, float) else array
        )
        array[place] = value
        return array

    return change


def first(change: Callable[[Any], Any]) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [change(values[0]), *values[1:]]


PLACE = r"obs_0 \(place\) "
MUST = "it must be a NumPy array"

COMMON: dict[str, tuple[Callable[[Steps], None], str]] = {
    "wide observation": (put("obs", first(lambda o: o[:, :2])), PLACE + r"has shape \(4, 2\), not \(4, 3\)"),
    "few rows": (put("obs", first(lambda o: o[:3])), PLACE + r"has shape \(3, 3\), not \(4, 3\)"),
    "flat observation": (put("obs", first(np.ravel)), PLACE + r"has shape \(12,\), not \(4, 3\)"),
    "few sensors": (put("obs", lambda o: o[:1]), "obs is 1 arrays; it must be a list of 2"),
    "no sensors": (put("obs", lambda o: None), "obs is None; it must be a list of 2"),
    "listed observation": (put("obs", first(np.ndarray.tolist)), PLACE + r"is a list; .* NumPy array"),
    "text observation": (put("obs", first(lambda o: o.astype(str))), PLACE + r"has dtype <U32, not float32"),
    "nan": (put("obs", first(at((2, 1), np.nan))), r"agent 2: its sensor obs_0 \(place\) holds nan"),
    "inf reward": (put("reward", at(1, -np.inf)), "agent 1: its reward holds -inf"),
    "nan group reward": (put("group_reward", at(3, np.nan)), "agent 3: its group reward holds nan"),
    "huge reward": (put("reward", lambda r: np.full(4, 1e300)), "agent 0: its reward holds inf"),
    "few rewards": (put("reward", lambda r: r[:3]), r"reward has shape \(3,\), not \(4,\)"),
    "square rewards": (put("reward", lambda r: r[:, None]), r"reward has shape \(4, 1\), not \(4,\)"),
    "no reward": (put("reward", lambda r: None), f"reward is None; {MUST}"),
    "no group reward": (put("group_reward", lambda r: None), f"group_reward is None; {MUST}"),
    "few group rewards": (put("group_reward", lambda r: r[:2]), r"group_reward has shape \(2,\), not \(4,\)"),
    "few groups": (put("group_id", lambda g: g[:1]), r"group_id has shape \(1,\), not \(4,\)"),
    "no groups": (put("group_id", lambda g: None), f"group_id is None; {MUST}"),
    "fraction of a group": (put("group_id", lambda g: g + 0.5), "group_id has dtype float64, not int64"),
    "same id twice": (put("agent_id", at(3, 1)), "agent 1: twice in one "),
    "negative id": (put("agent_id", at(0, -7)), "agent -7: ids of agents must be >= 0"),
    "no ids": (put("agent_id", lambda i: None), f"agent_id is None; {MUST}"),
    "listed ids": (put("agent_id", np.ndarray.tolist), f"agent_id is a list; {MUST}"),
    "fraction of an id": (put("agent_id", lambda i: i * 1.0), "agent_id has dtype float64, not int64"),
    "fewer ids": (put("agent_id", lambda i: i[:2]), r"has shape \(4,\), not \(2,\)"),
    "rows of nobody": (put("agent_id", lambda i: i[:0]), r"has shape \(4,\), not \(0,\)"),
}  # fmt: skip

MASKS: dict[str, tuple[Callable[[Steps], None], str]] = {
    "few masks": (
        put("action_mask", lambda m: m[:1]),
        r"action_mask is 1 arrays; .* None, or a list of 2",
    ),
    "one mask": (
        put("action_mask", lambda m: m[0]),
        r"action_mask is a ndarray; .* None, or a list of 2",
    ),
    "narrow mask": (
        put("action_mask", first(lambda m: m[:, :1])),
        r"action_mask of branch 0 has shape \(4, 1\), not \(4, 3\)",
    ),
    "text mask": (
        put("action_mask", first(lambda m: m.astype(str))),
        "action_mask of branch 0 has dtype <U5",
    ),
    "full mask": (
        put("action_mask", first(at(2, True))),
        "agent 2: every action of discrete branch 0 is masked",
    ),
}

FLAGS: dict[str, tuple[Callable[[Steps], None], str]] = {
    "few flags": (put("interrupted", lambda f: f[:1]), r"interrupted has shape \(1,\), not \(4,\)"),
    "numbers as flags": (
        put("interrupted", lambda f: f.astype(float)),
        "interrupted has dtype float64, not bool",
    ),
    "no flags": (put("interrupted", lambda f: None), f"interrupted is None; {MUST}"),
}

DECISIONS = {f"decision: {name}": spoil for name, (spoil, _) in (COMMON | MASKS).items()}
TERMINALS = {f"terminal: {name}": spoil for name, (spoil, _) in (COMMON | FLAGS).items()}

RESULTS: dict[str, Callable[[Crew, Steps, Steps], Any]] = {
    "None": lambda env, decision, terminal: None,
    "decisions only": lambda env, decision, terminal: decision,
    "swapped": lambda env, decision, terminal: (terminal, decision),
    "silence": lambda env, decision, terminal: (DecisionSteps.empty(env.spec), TerminalSteps.empty(env.spec)),
    "get_steps raises": lambda env, decision, terminal: 1 / 0,
}

SPECS: dict[str, Callable[[Crew], Any]] = {
    "vanished": lambda env: {},
    "renamed": lambda env: {OTHER: env.spec},
    "late": lambda env: {NAME: env.spec, OTHER: env.spec},
    "other spec": lambda env: {NAME: env.spec._replace(action_spec=ActionSpec(1, (3, 4)))},
    "no mapping": lambda env: [NAME],
    "behavior_specs raises": lambda env: {}[NAME],
}

WORDS = {
    **{f"decision: {name}": words for name, (_, words) in (COMMON | MASKS).items()},
    **{f"terminal: {name}": words for name, (_, words) in (COMMON | FLAGS).items()},
    "None": "get_steps returned None; it must return the pair",
    "decisions only": "get_steps returned a DecisionSteps; it must return the pair",
    "swapped": r"get_steps returned \(TerminalSteps, DecisionSteps\); it must return the pair",
    "silence": r"no agent asked for a decision in 2000 environment|step\(\) returned without any record",
    "vanished": "'Crew.team=0' has vanished: behavior_specs has .. now, at the start .'Crew.team=0'",
    "renamed": "'Crew.team=0' has vanished: behavior_specs has .'Guest.team=0'. now",
    "late": "'Guest.team=0' appeared after the start, when there were .'Crew.team=0'",
    "other spec": "'Crew.team=0' has changed its spec",
    "no mapping": "behavior_specs is a list; it must be a mapping",
    "reset raises": "its reset raised OSError: no scene$",
    "step raises": "its step raised ZeroDivisionError: a pole$",
    "get_steps raises": "its get_steps raised ZeroDivisionError: division by zero$",
    "set_actions raises": "its set_actions raised KeyError: 'motor'$",
    "behavior_specs raises": "its behavior_specs raised KeyError: 'Crew.team=0'$",
}
RAISING = [name for name in WORDS if name.endswith("raises")]
