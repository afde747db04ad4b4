"""Lessons: when the next one is due, worked out by hand; in training, checkpoints, evaluation and players."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import probes
import pytest
from test_train import AREAS, BATCH, ROUNDS, assert_same, rows, without_times

from mappo_unity.cli import eval_main
from mappo_unity.config.parameters.samplers import Sampler
from mappo_unity.config.schema import (
    Backend,
    CollectConfig,
    Config,
    EnvConfig,
    LogConfig,
    ModelConfig,
    PPOConfig,
)
from mappo_unity.envs.returns import Episode
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.restarting_player import RestartingPlayer
from mappo_unity.runs import checkpoint
from mappo_unity.runs.progress import describe
from mappo_unity.training.lessons.curriculum import Lessons
from mappo_unity.training.trainer import train, why_over


def parameters(*lessons: Any, name: str = "level", **more: Any) -> dict[str, Any]:
    params = {name: {"lessons": list(lessons)}, **more}
    return EnvConfig(backend=Backend.editor, params=params).parameters


def two(**completion: Any) -> list[dict[str, Any]]:
    return [{"value": 1, "completion": completion}, {"value": 2}]


def episodes(*returns: float, behavior: str = "A?team=0", group: float = 0.0) -> dict[str, list[Episode]]:
    return {behavior: [Episode(0, own, group, 3, False) for own in returns]}


# ---- when a lesson is complete


def test_progress_must_be_above_the_threshold() -> None:
    lessons = Lessons(parameters(*two(measure="progress", threshold=0.5)), {"A": 1})
    assert lessons.advance({}, 0.5) == [] and lessons.values == {"level": 1.0}

    (change,) = lessons.advance({}, 0.51)
    assert (change.name, change.number, change.require_reset) == ("level", 1, False)
    assert str(change) == "env.params.level: lesson 1 of 0-1 (Lesson1): 2"
    assert lessons.values == {"level": 2.0} and lessons.metrics() == {"lesson/level": 1.0}
    assert lessons.are_last and lessons.advance({}, 1.0) == []


def test_a_return_is_smoothed_once_for_new_episodes() -> None:
    lessons = Lessons(parameters(*two(threshold=7.4, min_lesson_length=2)), {"A": 1})
    # the window holds two: 0.75 * 8 = 6; no news, no smoothing; 0.25 * 6 + 0.75 * 8 = 7.5
    assert lessons.advance(episodes(4, 6, 10), 0.0) == []
    assert lessons.state_dict()["smoothed"] == {"level": 6.0}
    assert lessons.advance({}, 0.1) == [] and lessons.advance(episodes(), 0.1) == []
    assert lessons.state_dict()["smoothed"] == {"level": 6.0}
    assert len(lessons.advance(episodes(8, 8), 0.2)) == 1
    assert lessons.state_dict()["smoothed"] == {"level": 7.5}


def test_without_smoothing_the_mean_itself_counts_and_group_rewards_do_not() -> None:
    raw = two(threshold=5, signal_smoothing=False, min_lesson_length=2)
    lessons = Lessons(parameters(*raw), {"A": 2})
    assert lessons.notes == [
        "note: env.params.level.lessons[0].completion measures the individual rewards of A, as ML-Agents "
        "does; what its agents earn as a group does not count (measure: group_reward)"
    ]
    assert lessons.advance(episodes(4, 6, group=100), 0.0) == []
    assert len(lessons.advance(episodes(7), 0.0)) == 1


def test_a_group_can_be_measured_by_what_it_earns_together() -> None:
    raw = two(measure="group_reward", threshold=5, signal_smoothing=False, min_lesson_length=2)
    lessons, resumed = (Lessons(parameters(*raw), {"A": 2}) for _ in range(2))
    assert lessons.notes == []
    assert Lessons(parameters(*raw), {"A": 1}).notes == [
        "note: env.params.level.lessons[0].completion measures what A earns as a group, but its agents are "
        "alone"
    ]
    assert lessons.advance(episodes(100, 100, group=4), 0.0) == []

    resumed.load_state_dict(lessons.state_dict())
    assert resumed.state_dict() == lessons.state_dict()
    for going in (lessons, resumed):  # of 4 and 4 the newer one stays beside 6.5: 5.25
        assert len(going.advance(episodes(-100, group=6.5), 0.0)) == 1
        assert going.state_dict()["group_returns"] == {"A": []}


@pytest.mark.parametrize("measure", ["progress", "reward", "group_reward"])
def test_so_many_episodes_must_have_ended_first(measure: str) -> None:
    lessons = Lessons(parameters(*two(measure=measure, threshold=0.1, min_lesson_length=3)), {"A": 1})
    nobody = {"A?team=0": [Episode(0, 9.0, 0.0, 0, False)]}  # ended without a decision
    assert lessons.advance(episodes(9, 9, group=9), 0.9) == [] and lessons.advance(nobody, 0.9) == []
    assert len(lessons.advance(episodes(9, group=9), 0.9)) == 1


def test_a_change_empties_the_windows_of_all_and_the_smoothed_value_stays() -> None:
    criteria = {"threshold": 1, "min_lesson_length": 2}
    three = [{"value": v, "completion": criteria | {"behavior": "A"}} for v in (1, 2)] + [{"value": 3}]
    other = {"lessons": two(behavior="B", **criteria)}
    lessons = Lessons(parameters(*three, other=other), {"A": 1, "B": 1})
    both = episodes(4, 4) | episodes(9, behavior="B?team=1")
    assert [change.name for change in lessons.advance(both, 0.0)] == ["level"]
    assert lessons.state_dict()["returns"] == {"A": [], "B": []}

    # 0.25 * 3 + 0.75 * 0.5 = 1.125
    assert [str(c) for c in lessons.advance(episodes(0, 1), 0.0)] == [
        "env.params.level: lesson 2 of 0-2 (Lesson2): 3"
    ]


def test_state_goes_on() -> None:
    raw = parameters(*two(threshold=7.4, min_lesson_length=2))
    one, other = Lessons(raw, {"A": 1}), Lessons(raw, {"A": 1})
    one.advance(episodes(6, 10), 0.0)
    assert other.load_state_dict(one.state_dict()) == {}
    assert len(one.advance(episodes(8), 0.0)) == len(other.advance(episodes(8), 0.0)) == 1
    assert one.state_dict() == other.state_dict()

    fewer = Lessons(parameters({"value": 5}), {"A": 1})
    assert fewer.load_state_dict(one.state_dict()) == {"level": 5.0} and fewer.numbers == {"level": 0}
    sampler = Lessons(parameters(*two(measure="progress"), name="x", y={"sampler": "uniform"}), {"A": 1})
    assert sampler.load_state_dict({}) == {"x": 1.0, "y": Sampler("uniform", (0.0, 1.0))}


@pytest.mark.parametrize(
    ("completion", "words"),
    [
        (
            {"behavior": "C"},
            "lessons[0].completion.behavior=C: the environment has no such behavior; it has A, B",
        ),
        ({}, "lessons[0].completion names no behavior, but there are several: give behavior: one of A, B"),
    ],
)
def test_lessons_that_do_not_fit_the_environment(completion: Any, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        Lessons(parameters(*two(**completion)), {"A": 1, "B": 1})
    assert words in str(error.value)


def test_a_last_completion_is_noted() -> None:
    raw = {"value": 1, "completion": {"measure": "progress"}}
    notes = Lessons(parameters(raw), {"A": 1}).notes
    assert notes == ["note: env.params.level: the completion of its last lesson has no effect"]


def test_the_progress_line_tells_the_lessons() -> None:
    row = {"agent_steps": 5, "lesson/a": 1.0, "lesson/b": 0.0}
    assert describe(row, 10, 1.0).endswith("length -  lesson 1, 0  0:05 left")
    assert "lesson" not in describe({"agent_steps": 5}, 10, 1.0)


# ---- in training


def probe(level: Any, **changes: Any) -> Config:
    params = {"probe": "Level", "level": level}
    return Config(
        env=EnvConfig(name="Probe", backend=Backend.custom, factory="probes:make", params=params),
        model=ModelConfig(hidden=[8]),
        ppo=PPOConfig(lr=1e-2, minibatch_size=64),
        collect=CollectConfig(rounds=16),
        log=LogConfig(loggers=[], progress=False, return_window=32),
        max_steps=256 * 30,
        export_onnx=False,
        **changes,
    )


def test_a_probe_learns_its_way_through_the_lessons(tmp_path: Path, capsys: Any) -> None:
    level = {
        "lessons": [
            {"value": 1, "completion": {"threshold": 0.7, "min_lesson_length": 200}},
            {"name": "more", "value": 3, "completion": {"threshold": 2, "require_reset": True}},
            {"value": 5},
        ]
    }
    outcome = train(probe(level, stop_at_return=4.5), tmp_path)
    numbers = [float(row["lesson/level"]) for row in rows(tmp_path)]
    assert numbers[0] == 0 and numbers[-1] == 2 and numbers == sorted(numbers)
    # not before the last lesson, whose returns alone are in the window
    assert outcome.status == "solved" and 4.5 <= outcome.return_mean <= 5
    assert " steps: env.params.level: lesson 1 of 0-2 (more): 3\n" in capsys.readouterr().out


def test_the_goal_waits_for_the_last_lesson(tmp_path: Path) -> None:
    level = {"lessons": two(measure="progress", threshold=0.9)}
    cfg = probe(level, stop_at_return=-5.0)
    outcome = train(cfg, tmp_path, after_iteration=lambda s: "interrupted" if s.iteration == 3 else None)
    assert outcome.status == "interrupted" and why_over(cfg, outcome.last_checkpoint) is None


def test_an_environment_must_take_parameters_while_it_plays(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.delattr(probes.Level, "set_parameter")
    with pytest.raises(ConfigError, match="env.params.level has lessons, but the environment's param"):
        train(probe({"lessons": two(measure="progress")}), tmp_path)


def ball(require_reset: bool, **changes: Any) -> Config:
    first = {"sampler": "uniform", "min": 0.5, "max": 2}
    done = {"measure": "progress", "threshold": 0.3, "require_reset": require_reset}
    mass = {"lessons": [{"value": first, "completion": done}, {"value": {**first, "max": 9}}]}
    return Config(
        env=EnvConfig(
            num_areas=AREAS, params={"mass": mass, "scale": {"sampler": "gaussian", "st_dev": 0.1}}
        ),
        model=ModelConfig(hidden=[16]),
        ppo=PPOConfig(minibatch_size=60),
        collect=CollectConfig(rounds=ROUNDS),
        log=LogConfig(loggers=[], progress=False),
        max_steps=4 * BATCH,
        checkpoint_interval=BATCH,
        **changes,
    )


@pytest.mark.parametrize("require_reset", [False, True])
@pytest.mark.parametrize("cut", [1, 2])
def test_a_run_with_lessons_and_samplers_resumes_to_the_bit(
    tmp_path: Path, require_reset: bool, cut: int
) -> None:
    cfg = ball(require_reset)
    whole = train(cfg, tmp_path / "whole")
    train(cfg, tmp_path / "parts", after_iteration=lambda s: "interrupted" if s.iteration == cut else None)
    path, _ = checkpoint.newest_good(tmp_path / "parts")
    resumed = train(cfg, tmp_path / "parts", path)

    # the first lesson is complete after two of four iterations
    assert [row["lesson/mass"] for row in rows(tmp_path / "whole")] == ["0.0", "0.0", "1.0", "1.0"]
    assert rows(tmp_path / "whole") == rows(tmp_path / "parts")
    first, second = (checkpoint.load(o.last_checkpoint) for o in (whole, resumed))
    assert_same(without_times(first), without_times(second))
    saved = second["env"]["scene"]["parameters"]["mass"]
    assert saved["numbers"] == [0.5, 9.0] and second["lessons"]["numbers"] == {"mass": 1}


def test_a_reset_ends_all_episodes(tmp_path: Path) -> None:
    seen: list[Any] = []

    def look(state: Any) -> None:
        seen.append(state.setup.env.base_env.agents.step_count.max())

    train(ball(True), tmp_path, after_iteration=look)
    assert seen[0] > 50 and seen[1] <= 1 and seen[2] > 50


def test_options_that_change_with_resume_take_effect(tmp_path: Path) -> None:
    cfg = ball(False)
    train(cfg, tmp_path, after_iteration=lambda s: "interrupted")
    path, _ = checkpoint.newest_good(tmp_path)
    cfg.env.params = {"mass": 3.0, "scale": {"sampler": "uniform", "min": 1, "max": 2}}
    scenes: list[Any] = []
    train(cfg, tmp_path, path, lambda s: scenes.append(s.setup.env.base_env) or "interrupted")
    state = scenes[0].parameters.get_state()
    assert state["mass"] == 3.0 and state["scale"]["numbers"] == [1.0, 2.0]


def test_an_evaluation_plays_the_checkpoints_lesson_or_what_it_is_told(tmp_path: Path, capsys: Any) -> None:
    from mappo_unity.cli import train_main

    lines = ["env=3DBall", f"env.num_areas={AREAS}", f"collect.rounds={ROUNDS}", "model.hidden=[8]"]
    lines += ["log.loggers=[]", "export_onnx=false", f"max_steps={2 * BATCH}", f"hydra.run.dir={tmp_path}"]
    done = "{measure: progress, threshold: 0.4}"
    last = "{value: {sampler: uniform, max: 3, min: 2}}"
    mass = f"env.params.mass={{lessons: [{{value: 1, completion: {done}}}, {last}]}}"
    assert train_main([*lines, f"checkpoint_interval={BATCH}", mass]) == 0

    def shown(*options: str) -> Any:
        capsys.readouterr()
        assert eval_main(["episodes=2", *options]) == 0
        return json.loads(capsys.readouterr().out.splitlines()[-1])["env.params"]

    assert shown(f"run={tmp_path / f'checkpoints/step_{2 * BATCH:012d}.pt'}") == {"mass": "uniform 2 to 3"}
    assert shown(f"run={tmp_path}", "env.params.mass=10", "env.params.scale=2") == {"mass": 10, "scale": 2}
    gaussian = "env.params.mass={sampler: gaussian, mean: 4, st_dev: 0.5}"
    assert shown(f"run={tmp_path}", gaussian) == {"mass": "gaussian, mean 4, st_dev 0.5"}

    for bad, words in (
        ("env.params.mas=1", "scene 3DBall has no parameter 'mas'"),
        ("env.params.mass=1,2", "env.params.mass=1,2: env.params.mass takes one value here"),
        ("env.params.mass={sampler: x}", "env.params.mass.sampler=x does not exist"),
    ):
        assert eval_main([f"run={tmp_path}", bad]) == 2
        assert words in capsys.readouterr().err


def test_checkpoints_say_which_lessons_were_reached(tmp_path: Path) -> None:
    from mappo_unity.policies.policy_files import at_its_lessons

    cfg = ball(False)
    train(cfg, tmp_path, after_iteration=lambda s: "interrupted" if s.iteration == 1 else None)
    assert at_its_lessons(cfg.env, str(tmp_path)).parameters["mass"].numbers == (0.5, 2.0)
    assert at_its_lessons(cfg.env, "random").parameters["mass"].numbers == (0.5, 9.0)


def test_a_restarted_player_gets_the_lesson_in_force() -> None:
    made: list[Any] = []

    class FakePlayer:
        behavior_specs: dict[str, Any] = {}

        def __init__(self, seed: int) -> None:
            self.log: list[Any] = []
            made.append(self)

        def set_parameter(self, name: str, value: Any) -> None:
            self.log.append((name, value))

        def connect(self) -> None:
            pass

        def reset(self) -> None:
            self.log.append("reset")

    player = RestartingPlayer(FakePlayer, 0, max_restarts=1)  # type: ignore[arg-type]
    sampler = Sampler("uniform", (0.0, 1.0))
    player.set_parameter("wall", 1.0)
    player.set_parameter("wall", sampler)
    logging.disable(logging.WARNING)
    try:
        player._start_another(RuntimeError("gone"))  # type: ignore[arg-type]
    finally:
        logging.disable(logging.NOTSET)
    assert made[0].log == [("wall", 1.0), ("wall", sampler)] and made[1].log == [("wall", sampler), "reset"]
