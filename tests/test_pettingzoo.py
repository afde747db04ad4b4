"""PettingZoo's parallel environments as a BaseEnv: numbers worked by hand, training, mistakes."""

from __future__ import annotations

import csv
import importlib.util
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pettingzoo", reason="needs the package pettingzoo (extra 'farama')")

import parallel_probe
from gymnasium import spaces
from mlagents_envs.base_env import ActionTuple

from mappo_unity.cli import eval_main, export_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.farama import parallel_env
from mappo_unity.scenes.contract.check import check_env
from mappo_unity.scenes.contract.images import ByteImage
from mappo_unity.scenes.pettingzoo.opening import open_copies
from mappo_unity.scenes.pettingzoo.spaces import Actions, read_sensors

LINES = ["env=pettingzoo", "env.name=Script"]


def make(count: int = 1, teams: str = "all", factory: Any = parallel_probe.make) -> Any:
    return open_copies(factory, "script", 0, {}, count, teams)


def choose(env: Any, **choices: list[int]) -> None:
    """Set the discrete choices of each behavior's agents, and step."""
    for name, rows in choices.items():
        env.set_actions(name, ActionTuple(discrete=np.array(rows, np.int32)[:, None]))
    env.step()


def test_a_scripted_episode_record_by_record() -> None:
    env = make(count=2)
    env.reset()
    decision, terminal = env.get_steps("runner")
    assert decision.agent_id.tolist() == [0, 1, 3, 4] and not len(terminal)
    assert decision.group_id.tolist() == [1, 1, 2, 2]
    np.testing.assert_array_equal(decision.obs[0], [[0, 0], [0, 1], [0, 0], [0, 1]])
    # allowed becomes forbidden
    np.testing.assert_array_equal(decision.action_mask[0][:2], [[False, True, False], [False, False, True]])
    assert not len(env.get_steps("helper")[0])

    choose(env, runner=[2, 1, 0, 0])  # t = 1: the helpers appear
    np.testing.assert_array_equal(env.get_steps("runner")[0].reward, [21, 11, 1, 1])
    helper, _ = env.get_steps("helper")
    assert helper.agent_id.tolist() == [2, 5] and helper.group_id.tolist() == [1, 2]
    np.testing.assert_array_equal(helper.obs[0], [[0, 1, 0, 0, 0]] * 2)
    np.testing.assert_array_equal(helper.action_mask[0], [[True, False]] * 2)

    choose(env, runner=[0, 1, 2, 0], helper=[1, 1])  # t = 2: each runner_1 ends for good
    decision, terminal = env.get_steps("runner")
    assert decision.agent_id.tolist() == [0, 3] and terminal.agent_id.tolist() == [1, 4]
    np.testing.assert_array_equal(decision.reward, [2, 22])
    np.testing.assert_array_equal(terminal.reward, [12, 2])
    assert terminal.interrupted.tolist() == [False, False]
    np.testing.assert_array_equal(terminal.obs[0], [[2, 1], [2, 1]])
    np.testing.assert_array_equal(env.get_steps("helper")[0].reward, [-2, -2])

    choose(env, runner=[0, 0], helper=[1, 1])
    choose(env, runner=[0, 0], helper=[1, 1])  # t = 4: all are cut off, both copies begin anew
    decision, terminal = env.get_steps("runner")
    assert terminal.agent_id.tolist() == [0, 3] and terminal.interrupted.all()
    assert decision.agent_id.tolist() == [0, 1, 3, 4] and not decision.reward.any()
    helper, ended = env.get_steps("helper")
    assert not len(helper) and ended.agent_id.tolist() == [2, 5] and ended.interrupted.all()
    np.testing.assert_array_equal(ended.reward, [-4, -4])


def test_the_environment_gets_its_own_actions() -> None:
    script = parallel_probe.Script()
    env = make(factory=lambda: script)
    env.reset()
    choose(env, runner=[2, 1])
    env.set_action_for_agent("helper", 2, ActionTuple(discrete=np.array([[1]], np.int32)))
    choose(env, runner=[0, 1])
    assert script.taken == [{"runner_0": 2, "runner_1": 1}, {"runner_0": 0, "runner_1": 1, "helper_0": 6}]


@pytest.mark.parametrize(
    ("teams", "groups"),
    [("all", [1, 1, 1]), ("none", [0, 0, 0]), ("parallel_probe:by_kind", [1, 0, 2])],
)
def test_teams(teams: str, groups: list[int]) -> None:
    env = make(teams=teams)
    env.reset()
    choose(env, runner=[0, 0])
    found = [*env.get_steps("runner")[0].group_id, *env.get_steps("helper")[0].group_id]
    assert found == groups


def test_it_keeps_the_contract() -> None:
    report = check_env(make(count=3), steps=60, remake=lambda: make(count=3))
    assert report.interrupted > 0 and "seed" in report.checks


def test_out_and_in_is_the_same_game() -> None:
    inner, outer = parallel_probe.make(), parallel_env(make())
    assert sorted(outer.possible_agents) == sorted(inner.possible_agents)
    for _ in range(2):
        seen, _ = inner.reset()
        shown, infos = outer.reset()
        rng = np.random.default_rng(3)
        while inner.agents:
            assert sorted(outer.agents) == sorted(inner.agents)
            for agent in inner.agents:
                plain = np.eye(5)[seen[agent]["observation"]] if agent == "helper_0" else seen[agent]
                np.testing.assert_array_equal(shown[agent], plain)
                mask = [0, 1] if agent == "helper_0" else parallel_probe.MASKS[agent]
                assert infos[agent]["action_mask"].tolist() == mask and infos[agent]["decision_requested"]

            actions = {agent: int(rng.integers(2)) for agent in inner.agents}
            # a branch counts from 0, this space from 5
            own = {agent: action + 5 * (agent == "helper_0") for agent, action in actions.items()}
            seen, *inner_rest, _ = inner.step(own)
            shown, *outer_rest, infos = outer.step(actions)
            rewards, ends, cuts = inner_rest
            rewards["helper_0"] *= inner.t > 1  # what comes with a first decision was earned by no action
            assert outer_rest == [rewards, ends, cuts]
        assert not outer.agents


@pytest.mark.parametrize(
    ("space", "shapes", "value", "numbers"),
    [
        (spaces.Box(0, 1, (2, 2)), [(4,)], [[1, 2], [3, 4]], [[1, 2, 3, 4]]),
        (spaces.Box(0, 255, (3,), np.uint8), [(3,)], [0, 51, 255], [[0, 0.2, 1]]),
        (spaces.Discrete(3, start=-1), [(3,)], 1, [[0, 0, 1]]),
        (spaces.MultiDiscrete([2, 3]), [(5,)], [1, 0], [[0, 1, 1, 0, 0]]),
        (spaces.MultiBinary(2), [(2,)], [1, 0], [[1, 0]]),
        (spaces.Tuple([spaces.Box(0, 1, ()), spaces.Discrete(2)]), [(1,), (2,)], (7, 0), [[7], [1, 0]]),
        (
            spaces.Dict(
                {"action_mask": spaces.MultiBinary(3), "far": spaces.Dict({"x": spaces.Box(0, 9, (1,))})}
            ),
            [(1,)],
            {"action_mask": [1, 1, 1], "far": {"x": [4]}},
            [[4]],
        ),
    ],
)
def test_observation_spaces(space: Any, shapes: Any, value: Any, numbers: Any) -> None:
    sensors = read_sensors(space, "x")
    assert [sensor.spec.shape for sensor in sensors] == shapes
    for sensor, wanted in zip(sensors, numbers):
        np.testing.assert_allclose(sensor.read(value), wanted, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "kept", "marks"),
    [((4, 5, 3), (4, 5, 3), [2, 2, 1]), ((3, 5, 4), (3, 5, 4), [1, 2, 2]), ((4, 5), (1, 4, 5), [1, 2, 2])],
)
def test_pictures(shape: Any, kept: Any, marks: Any) -> None:
    (sensor,) = read_sensors(spaces.Box(0, 255, shape, np.uint8), "x")
    assert isinstance(sensor.spec, ByteImage) and sensor.spec.shape == kept
    assert [flag.value for flag in sensor.spec.dimension_property] == marks
    assert sensor.read(np.full(shape, 255, np.uint8)).max() == 1


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (spaces.Box(0, 255, (4, 5, 3), np.uint8), np.full((4, 5, 3), 0.7)),
        (spaces.Box(0, 255, (4, 5, 3), np.uint8), np.full((4, 5, 3), 300)),
        (spaces.Discrete(4), -1),
        (spaces.Discrete(4, start=2), 6),
        (spaces.MultiDiscrete([2, 3]), [2, 0]),
    ],
)
def test_observations_outside_their_space_are_refused(space: Any, value: Any) -> None:
    (sensor,) = read_sensors(space, "x")
    with pytest.raises(ValueError, match="numbers"):
        sensor.read(value)


def test_agents_with_other_spaces_are_another_behavior() -> None:
    script = parallel_probe.Script()
    script.spaces["runner_1"] = spaces.Box(-5, 5, (2,), np.float32)  # the same sensor in ML-Agents' words
    env = make(factory=lambda: script)
    env.reset()
    assert set(env.behavior_specs) == {"runner", "runner_b", "helper"}
    env.close()


def test_hybrid_actions() -> None:
    space = spaces.Dict(
        {
            "aim": spaces.Box(np.array([0, -np.inf], np.float32), np.array([10, np.inf], np.float32)),
            "gear": spaces.MultiDiscrete([2, 3]),
            "horn": spaces.Discrete(2, start=1),
        }
    )
    actions = Actions(space, "x")
    assert actions.spec.continuous_size == 2 and actions.spec.discrete_branches == (2, 3, 2)
    action = actions.decode(np.array([0.5, 0.25], np.float32), np.array([1, 2, 0], np.int32))
    assert space.contains(action)
    np.testing.assert_allclose(action["aim"], [7.5, 0.25])
    assert action["gear"].tolist() == [1, 2] and action["horn"] == 1
    masks = actions.forbidden(([1, 0], [1, 1, 1], [0, 1]))
    assert [mask.tolist() for mask in masks] == [[False, True], [False] * 3, [True, False]]


def test_it_trains_resumes_and_is_evaluated(tmp_path: Any, capsys: Any) -> None:
    run = tmp_path / "run"
    lines = [
        *(*LINES, "env.factory=parallel_probe:make", "env.num_areas=4", "env.max_teams=4"),
        *("collect.rounds=8", "model.hidden=[8]", "ppo.epochs=1", "ppo.num_minibatches=2"),
        *("log.loggers=[]", f"hydra.run.dir={run}"),
    ]
    assert train_main([*lines, "max_steps=100"]) == 0
    assert train_main([f"resume={run}", "max_steps=200"]) == 0
    with open(run / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 and any("runner" in column for column in rows[0])
    capsys.readouterr()
    assert eval_main([f"run={run}", "episodes=4"]) == 0
    assert '"helper"' in capsys.readouterr().out
    assert export_main([f"run={run}", f"out={tmp_path / 'onnx'}"]) == 0
    assert {path.name for path in (tmp_path / "onnx").iterdir()} >= {"runner.onnx", "helper.onnx"}


@pytest.mark.parametrize(
    ("lines", "messages"),
    [
        (["env.factory=parallel_probe:no_env"], ["returned a dict", "must return a pettingzoo.ParallelEnv"]),
        (["env.factory=parallel_probe:text_observation"], ["'runner_0'", "news = Text(", "no sensor"]),
        (["env.factory=parallel_probe:text_action"], ["'runner_0'", "action space has Text("]),
        (["env.factory=parallel_probe:no_spaces"], ["raised AttributeError", "in observation_space"]),
        (["env.factory=parallel_probe:no_agents"], ["possible_agents is empty"]),
        (
            ["env.factory=parallel_probe:wrong_masks"],
            ["its action_mask is array([1, 1, 1, 1]", "each of the 3 "],
        ),
        (["env.factory=parallel_probe:raises"], ["raised ValueError: no licence"]),
        (["env.factory=parallel_probe:make", "env.params.size=3"], ["cannot be called with size"]),
        (["env.factory=parallel_probe:make", "env.params.seed=3"], ["env.params.seed=3", "use seed=N"]),
        (["env.factory=parallel_probe:make", "env.teams=blue"], ["env.teams='blue'", "all, none"]),
        (
            ["env.factory=parallel_probe:make", "env.teams=parallel_probe:team_list"],
            ["returned ['runner_0']"],
        ),
        (["env.factory=parallel_probe:make", "env.teams=parallel_probe:team_error"], ["raised KeyError"]),
        (
            ["env.factory=parallel_probe:make", "env.teams=parallel_probe:nobody"],
            ["has no function 'nobody'"],
        ),
        ([], ["env.factory is not given", "pettingzoo.ParallelEnv"]),
        (["env=3DBall", "env.teams=none"], ["env.teams=none has no effect", "env.backend=pettingzoo"]),
    ],
)
def test_mistakes(lines: list[str], messages: list[str], tmp_path: Any, capsys: Any) -> None:
    assert train_main([*LINES, *lines, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    err = capsys.readouterr().err
    assert all(message in err for message in messages), err
    assert "mappo_unity/" not in err


def test_an_agent_that_vanishes_is_named() -> None:
    script = parallel_probe.Script()
    env = make(factory=lambda: script)
    env.reset()
    script.step = lambda actions: (script.agents.remove("runner_1"), {}, {}, {}, {})  # type: ignore[method-assign]
    with pytest.raises(Exception, match="step did not return five dicts"):
        env.step()
    script.agents = ["runner_0"]
    seen = script.observe(["runner_0", "runner_1"])
    script.step = lambda actions: (seen, {}, {}, {}, {})  # type: ignore[method-assign]
    with pytest.raises(Exception, match="'runner_1' left its list agents without a termination"):
        env.step()


@pytest.mark.parametrize("package", ["pettingzoo", "gymnasium"])
def test_a_missing_package_is_named(package: str, monkeypatch: Any, capsys: Any) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *a: None if name == package else find(name, *a)
    )
    assert train_main([*LINES, "env.factory=parallel_probe:make"]) == 2
    err = capsys.readouterr().err
    assert f"needs the package {package}" in err and "farama" in err


def test_mpe_keeps_the_contract() -> None:
    pytest.importorskip("mpe2", reason="needs the package mpe2")
    lines = ["env=pettingzoo", "env.num_areas=2", "env.params.continuous_actions=true"]
    cfg = compose_config([*lines, "env.factory=mpe2.simple_speaker_listener_v4:parallel_env"]).config
    open_it = make_env_function(cfg.env)
    report = check_env(open_it(0), steps=60, remake=lambda: open_it(0))
    assert report.interrupted > 0 and "seed" in report.checks
    assert set(open_it(1).behavior_specs) == {"speaker", "listener"}
