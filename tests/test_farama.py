"""Environments of our backends as PettingZoo's and Gymnasium's: their own checkers, ends, rewards, masks."""

from __future__ import annotations

import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="needs the package pettingzoo (extra 'farama')")

from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from mlagents_envs.base_env import (
    ActionSpec,
    BaseEnv,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    ObservationSpec,
    ObservationType,
    TerminalSteps,
)
from pettingzoo.test import parallel_api_test, parallel_seed_test

from mappo_unity import gym_env, make_scene, parallel_env, vector_env
from mappo_unity.cli import player_main
from mappo_unity.errors import ConfigError
from mappo_unity.farama import parallel, session, vector
from mappo_unity.farama.session import Session
from mappo_unity.scenes.contract.rules import EnvironmentDataError

SCENES = ["3DBall", "Basic", "DungeonEscape", "PushBlock", "SoccerTwos", "WallJump"]


@pytest.mark.parametrize("scene", SCENES)
def test_pettingzoos_own_check(scene: str, capsys: Any) -> None:
    env = parallel_env(scene, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # one episode of WallJump has one of its two behaviors
        warnings.filterwarnings("ignore", "No agents present but not all possible_agents")
        parallel_api_test(env, num_cycles=120)
    env.close()
    assert "Passed" in capsys.readouterr().out


def test_a_player_passes_too(tmp_path: Path) -> None:
    assert player_main(["build", "Basic", str(tmp_path)]) == 0
    env = parallel_env("unity", f"env.file_name={tmp_path / 'Basic'}", f"env.player_logs={tmp_path}")
    parallel_api_test(env, num_cycles=30)
    env.close()


@pytest.mark.parametrize("scene", ["Basic", "SoccerTwos"])
def test_the_same_seed_is_the_same_episode(scene: str) -> None:
    parallel_seed_test(lambda: parallel_env(scene), num_cycles=20)


@pytest.mark.parametrize("scene", ["3DBall", "Basic", "PushBlock", "Hallway", "WallJump"])
def test_gymnasiums_own_check(scene: str) -> None:
    env = gym_env(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*A Box observation space m.*imum value is -?infinity")
        check_env(env, skip_render_check=True)
    env.close()


def test_agents_that_end_early_leave() -> None:
    env = parallel_env("DungeonEscape", seed=0)
    for episode in range(20):
        _, infos = env.reset(seed=episode)
        for agent in env.agents:
            env.action_space(agent).seed(episode)
        counts = [len(env.agents)]
        while env.agents:
            masks = {agent: infos[agent]["action_mask"] for agent in env.agents}
            *_, infos = env.step({agent: env.action_space(agent).sample(m) for agent, m in masks.items()})
            counts.append(len(env.agents))
        if set(counts) != {3, 0}:
            break
    assert counts[0] == 3 and sorted(counts, reverse=True) == counts and {1, 2} & set(counts)


def test_a_vector_is_the_scene_itself() -> None:
    env, scene = vector_env("3DBall", num_areas=3, seed=5), make_scene("3DBall", seed=5, num_areas=3)
    scene.reset()
    (behavior,) = scene.behavior_specs
    assert env.num_envs == 3 and env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.single_action_space == spaces.Box(-1, 1, (2,), np.float32)
    seen, _ = env.reset(seed=5)
    rng = np.random.default_rng(0)
    ends = 0
    for _ in range(120):
        decision, _ = scene.get_steps(behavior)
        np.testing.assert_array_equal(seen, decision.obs[0])
        action = rng.uniform(-1, 1, (3, 2)).astype(np.float32)
        spec = scene.behavior_specs[behavior].action_spec.empty_action(3)
        spec.add_continuous(action)
        scene.set_actions(behavior, spec)
        seen, reward, terminated, truncated, infos = env.step(action)

        wanted, over, cut = np.zeros(3), [], []
        decision = DecisionSteps.empty(scene.behavior_specs[behavior])
        while not len(decision):  # an agent ends between the decisions, too
            scene.step()
            decision, terminal = scene.get_steps(behavior)
            wanted[terminal.agent_id] = terminal.reward
            over += terminal.agent_id[~terminal.interrupted].tolist()
            cut += terminal.agent_id[terminal.interrupted].tolist()
            for row, agent in enumerate(terminal.agent_id):
                np.testing.assert_array_equal(infos["final_obs"][agent], terminal.obs[0][row])
        going = ~(terminated | truncated)
        wanted[going] = decision.reward[going]
        np.testing.assert_array_equal(reward, wanted)
        assert np.flatnonzero(terminated).tolist() == sorted(over)
        assert np.flatnonzero(truncated).tolist() == sorted(cut)
        ends += len(over) + len(cut)
    assert ends > 3
    env.close()


@pytest.mark.parametrize("scene", ["Basic", "WallJump"])
def test_vectors_stay_in_their_spaces(scene: str) -> None:
    env = vector_env(scene, num_areas=4, seed=2)
    env.action_space.seed(2)  # else few episodes end now and then
    seen, infos = env.reset(seed=2)
    ends = 0
    for _ in range(150):
        assert env.observation_space.contains(seen) and infos["decision_requested"].all()
        seen, _, terminated, truncated, infos = env.step(env.action_space.sample())
        ends += np.count_nonzero(terminated | truncated)
    assert ends > 4


SENSORS = [
    ObservationSpec((1,), (DimensionProperty.NONE,), ObservationType.DEFAULT, name)
    for name in ("x", "x", "y")
]
HYBRID = BehaviorSpec(SENSORS, ActionSpec(2, (2, 3)))


class Hybrid(BaseEnv):
    """Agents 0 and 1 of one team. Agent 1 requests in every second step, a third of them nobody does.

    At step t = 1, 2, 3 ...: agent 0 requests and earns t, its team 100; at t = 3 nobody requests; at t = 4
    agent 1 ends for good with the reward 7; at t = 5 agent 0 is cut off with the reward 9.
    """

    def __init__(self) -> None:
        self.t, self.sent = 0, []

    @property
    def behavior_specs(self) -> Any:
        return {"H": HYBRID}

    def reset(self) -> None:
        self.t = 0
        self.result = self.ask([0, 1]), TerminalSteps.empty(HYBRID)

    def ask(self, ids: list[int]) -> DecisionSteps:
        n = len(ids)
        if not n:
            return DecisionSteps.empty(HYBRID)
        obs = [np.full((n, 1), 10 * self.t + k, np.float32) for k in range(3)]
        masks = [np.zeros((n, 2), bool), np.tile([True, False, False], (n, 1))]
        reward, team = np.full(n, self.t, np.float32), np.full(n, 100, np.float32)
        return DecisionSteps(obs, reward, np.array(ids, np.int32), masks, np.ones(n, np.int32), team)

    def end(self, agent: int, reward: float, cut: bool) -> TerminalSteps:
        ids, obs = np.array([agent], np.int32), [np.full((1, 1), 50 + k, np.float32) for k in range(3)]
        zeros = np.zeros(1, np.float32)
        return TerminalSteps(obs, np.array([reward], np.float32), np.array([cut]), ids, ids * 0 + 1, zeros)

    def step(self) -> None:
        self.t += 1
        asks = {1: [0], 2: [0, 1], 3: [], 4: [0], 5: []}[self.t]
        ends = {4: self.end(1, 7, False), 5: self.end(0, 9, True)}
        self.result = self.ask(asks), ends.get(self.t, TerminalSteps.empty(HYBRID))

    def get_steps(self, behavior_name: str) -> Any:
        return self.result

    def set_actions(self, behavior_name: str, action: Any) -> None:
        self.sent.append((self.t, action.continuous.tolist(), action.discrete.tolist()))

    def set_action_for_agent(self, *arguments: Any) -> None: ...

    def close(self) -> None: ...


GO = {"continuous": np.array([0.5, 3]), "discrete": np.array([1, 2])}


def test_an_episode_worked_by_hand() -> None:
    inner = Hybrid()
    env = parallel_env(inner)
    assert env.possible_agents == ["H_0", "H_1"]
    assert list(env.observation_space("H_0").spaces) == ["x", "x_1", "y"]
    assert env.action_space("H_0") == spaces.Dict(
        {"continuous": spaces.Box(-1, 1, (2,), np.float32), "discrete": spaces.MultiDiscrete([2, 3])}
    )
    _, infos = env.reset()
    assert [mask.tolist() for mask in infos["H_1"]["action_mask"]] == [[1, 1], [0, 1, 1]]

    seen, rewards, terminated, truncated, infos = env.step({"H_0": GO})  # t = 1: agent 1 is idle, allowed
    assert inner.sent[-1] == (0, [[0.5, 1], [0, 0]], [[1, 2], [0, 1]])
    assert rewards == {"H_0": 1, "H_1": 0} and infos["H_0"]["group_reward"] == 100
    assert infos["H_0"]["decision_requested"] and not infos["H_1"]["decision_requested"]
    assert seen["H_0"]["x_1"].tolist() == [11] and seen["H_1"]["x_1"].tolist() == [1]

    _, rewards, *_ = env.step({"H_0": GO, "H_1": GO})  # what agent 1 did not request is ignored
    assert len(inner.sent[-1][1]) == 1 and rewards == {"H_0": 2, "H_1": 2}

    seen, rewards, terminated, truncated, _ = env.step({"H_0": GO, "H_1": GO})  # t = 3 and 4
    assert rewards == {"H_0": 4, "H_1": 7}
    assert terminated == {"H_0": False, "H_1": True} and not any(truncated.values())
    assert seen["H_1"]["y"].tolist() == [52] and env.agents == ["H_0"]

    _, rewards, terminated, truncated, _ = env.step({"H_0": GO})
    assert rewards == {"H_0": 9} and truncated == {"H_0": True} and terminated == {"H_0": False}
    assert env.agents == [] and env.step({}) == ({}, {}, {}, {}, {})


class Switching(Hybrid):
    """The one agent plays as H at t = 0, and from t = 1 on as J, without an end."""

    @property
    def behavior_specs(self) -> Any:
        return {"H": HYBRID, "J": HYBRID}

    def reset(self) -> None:
        self.t = 0
        self.result = self.ask([0]), TerminalSteps.empty(HYBRID)

    def step(self) -> None:
        self.t += 1
        self.result = self.ask([0]), TerminalSteps.empty(HYBRID)

    def get_steps(self, behavior_name: str) -> Any:
        if behavior_name == ("J" if self.t else "H"):
            return self.result
        return DecisionSteps.empty(HYBRID), TerminalSteps.empty(HYBRID)


def test_an_agent_that_changes_its_behavior_is_cut_off_under_its_old_name() -> None:
    env = parallel_env(Switching())
    env.reset()
    assert env.agents == ["H_0"] and env.possible_agents == ["H_0", "J_0"]
    seen, rewards, _, truncated, _ = env.step({"H_0": GO})
    assert env.agents == ["J_0"] and truncated == {"H_0": True, "J_0": False}
    assert rewards == {"H_0": 1, "J_0": 0} and seen["H_0"]["x"] == 0 and seen["J_0"]["x"] == 10
    _, rewards, *_ = env.step({"J_0": GO})
    assert rewards == {"J_0": 2}


def test_an_option_of_areas_counts() -> None:
    env = parallel_env("Basic", "env.num_areas=3")
    assert len(env.possible_agents) == 3
    env.close()


def test_a_preset_with_lessons_is_at_its_last() -> None:
    session = Session("CooperativePushBlock", [], seed=0, num_areas=1)
    scene: Any = session._env
    assert scene.parameters["gravity"] == 14.715, "the scene's own"
    session.close()


def test_group_rewards_are_added_when_asked_for() -> None:
    env = parallel_env(Hybrid(), add_group_rewards=True)
    env.reset()
    _, rewards, *_ = env.step({"H_0": GO})
    assert rewards == {"H_0": 101, "H_1": 0}


@pytest.mark.parametrize(
    "action",
    [
        3,
        {"continuous": [0, 0]},
        {"continuous": [0, np.nan], "discrete": [0, 1]},
        {"continuous": [0, 0], "discrete": [2, 1]},
        {"continuous": [0, 0], "discrete": [0.5, 1]},
    ],
)
def test_an_action_outside_its_space_is_refused(action: Any) -> None:
    env = parallel_env(Hybrid())
    env.reset()
    with pytest.raises(ConfigError, match="is not in the action space Dict"):
        env.step({"H_0": action})


def test_mistakes() -> None:
    with pytest.raises(ConfigError, match="gym_env plays one agent, but 2 begin: H_0, H_1"):
        gym_env(Hybrid()).reset()
    with pytest.raises(ConfigError, match="2 agents of H begin, .* names for 1; give max_agents=2"):
        parallel_env(Hybrid(), max_agents=1).reset()
    with pytest.raises(ConfigError, match="seed=3: Hybrid came open and keeps its own seed"):
        parallel_env(Hybrid()).reset(seed=3)
    with pytest.raises(ConfigError, match="options are for a preset's name"):
        parallel_env(Hybrid(), "env.num_areas=3")
    with pytest.raises(ConfigError, match="have different spaces; use parallel_env"):
        vector_env("SoccerTwos", num_areas=1)
    with pytest.raises(ConfigError, match="is not in the action space"):
        env = vector_env("3DBall", num_areas=2)
        env.reset()
        env.step(np.zeros((1, 2)))
    with pytest.raises(ConfigError, match="3DBal"):
        parallel_env("3DBal")


class Empty(Hybrid):
    """A game in which nobody asks again."""

    closed = False

    def step(self) -> None:
        self.result = self.ask([]), TerminalSteps.empty(HYBRID)

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("make", [parallel_env, vector_env])
def test_an_environment_in_which_nobody_asks_again_is_told(make: Any, monkeypatch: Any) -> None:
    for module in (parallel, vector):
        monkeypatch.setattr(module, "MAX_SILENT_STEPS", 20)
    env = make(Empty())
    env.reset()
    actions = dict.fromkeys(env.agents, GO) if make is parallel_env else env.action_space.sample()
    with pytest.raises(EnvironmentDataError, match="no agent asked for a decision in 20 environment steps"):
        env.step(actions)


def test_what_was_opened_here_is_closed_where_it_cannot_be_played(monkeypatch: Any) -> None:
    inner = Empty()
    monkeypatch.setattr(inner, "reset", lambda: inner.step())
    monkeypatch.setattr(session, "make_env_function", lambda cfg: lambda seed: inner)
    monkeypatch.setattr(session, "MAX_SILENT_STEPS", 20)
    with pytest.raises(EnvironmentDataError, match="nobody|no behavior with an agent"):
        parallel_env("3DBall")
    assert inner.closed


def test_options_are_read_as_typed_on_a_command_line(monkeypatch: Any) -> None:
    seen: list[Any] = []

    def make(cfg: Any) -> Any:
        seen.append(cfg)
        return lambda seed: Hybrid()

    monkeypatch.setattr(session, "make_env_function", make)
    parallel_env("unity", "env.file_name=builds/Game (1), new")
    assert [cfg.file_name for cfg in seen] == ["builds/Game (1), new"]


def test_the_package_needs_neither() -> None:
    code = """
import sys
sys.modules.update(pettingzoo=None, gymnasium=None)
import importlib.util as util
find = util.find_spec
util.find_spec = lambda name, *rest: None if name in ("pettingzoo", "gymnasium") else find(name, *rest)
import mappo_unity
try:
    mappo_unity.parallel_env("Basic")
except mappo_unity.errors.ConfigError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "this needs the package pettingzoo" in done.stdout and "farama" in done.stdout, done.stderr
