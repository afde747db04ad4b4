"""Environments as PettingZoo's and Gymnasium's: what a reset finds, and what may go wrong around it."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("pettingzoo", reason="needs the package pettingzoo (extra 'farama')")

from fakes import CONTINUOUS_1, Record, ScriptedEnv, vector_spec
from mlagents_envs.base_env import BehaviorSpec, TerminalSteps
from test_farama import GO, HYBRID, Hybrid

from mappo_unity import gym_env, parallel_env, vector_env
from mappo_unity.errors import ConfigError
from mappo_unity.farama import session
from mappo_unity.scenes.contract.rules import EnvironmentDataError


class Growing(Hybrid):
    """Shows the behavior J, too, from its second reset on."""

    resets = 0

    @property
    def behavior_specs(self) -> Any:
        return dict.fromkeys(["H", "J"] if self.resets > 1 else ["H"], HYBRID)

    def reset(self) -> None:
        self.resets += 1
        super().reset()


@pytest.mark.parametrize("make", [parallel_env, vector_env])
def test_a_behavior_that_shows_after_a_later_reset_is_told(make: Any) -> None:
    env = make(Growing())
    env.reset()
    with pytest.raises(EnvironmentDataError, match="behavior 'J' appeared after the start"):
        env.reset()


def spec_of(*names: str) -> BehaviorSpec:
    return BehaviorSpec([vector_spec(1, name) for name in names], CONTINUOUS_1)


@pytest.mark.parametrize(
    ("sides", "fit"),
    [
        ((["blue"], ["red"]), True),  # one sensor is a Box, whatever its name
        ((["a", "b"], ["a", "b"]), True),
        ((["a", "b"], ["b", "a"]), False),
        ((["a", "b"], ["a", "c"]), False),
    ],
)
def test_sides_with_equal_spaces_are_one_vector(sides: tuple[list[str], list[str]], fit: bool) -> None:
    specs = {f"T?team={side}": spec_of(*names) for side, names in enumerate(sides)}
    first = [Record(side, behavior=name) for side, name in enumerate(specs)]
    env = ScriptedEnv([first, first], specs)
    if not fit:
        with pytest.raises(ConfigError, match="have different spaces; use parallel_env"):
            vector_env(env)
        return

    rows = vector_env(env)
    seen, _ = rows.reset()
    assert rows.num_envs == 2 and rows.observation_space.contains(seen)
    rows.step(rows.action_space.sample())


class Alone(Hybrid):
    """One agent, whose episode is cut off with the first step."""

    def reset(self) -> None:
        self.t = 0
        self.result = self.ask([0]), TerminalSteps.empty(HYBRID)

    def step(self) -> None:
        self.result = self.ask([]), self.end(0, 9, True)


def test_a_step_without_an_episode_is_told() -> None:
    env = gym_env(Alone())
    with pytest.raises(ConfigError, match="Alone: no episode is running: call reset"):
        env.step(GO)
    env.reset()
    *_, truncated, _ = env.step(GO)
    assert truncated
    with pytest.raises(ConfigError, match="Alone: no episode is running: call reset"):
        env.step(GO)


class Reopened(Hybrid):
    """Shows J, whose agent 7 requests when it is opened for seed 0, and with other seeds after a step."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed = seed

    @property
    def behavior_specs(self) -> Any:
        return dict.fromkeys(["H", "J"] if self.seed == 0 or self.t else ["H"], HYBRID)

    def step(self) -> None:
        self.t += 1
        self.result = self.ask([0, 1]), TerminalSteps.empty(HYBRID)

    def get_steps(self, behavior_name: str) -> Any:
        if behavior_name == "H":
            return self.result
        asks = [7] if self.t or self.seed == 0 else []
        return self.ask(asks), TerminalSteps.empty(HYBRID)

    def set_actions(self, behavior_name: str, action: Any) -> None:
        assert behavior_name in self.behavior_specs, "a behavior that does not show has no actions"


def test_requests_of_an_episode_that_was_broken_off_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "make_env_function", lambda cfg: Reopened)
    env = parallel_env("3DBall", seed=0)
    env.reset()
    assert env.agents == ["H_0", "H_1", "J_0"]
    env.reset(seed=1)
    assert env.agents == ["H_0", "H_1"]
    env.step(dict.fromkeys(env.agents, GO))
    assert env.agents == ["H_0", "H_1", "J_0"]

    rows = vector_env("3DBall", seed=0)
    rows.reset(seed=0)
    rows.reset(seed=1)
    rows.step(rows.action_space.sample())
