"""Environment parameters: what options may say, how samplers draw, what scenes and players make of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mappo_unity.config.compose import compose_config
from mappo_unity.config.parameters.curriculum import Completion, Lesson, read_curriculum
from mappo_unity.config.parameters.samplers import Sampler, read_value
from mappo_unity.config.parameters.values import params_at, show_parameter, values_at
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.protocol import side_channels
from mappo_unity.protocol.serve import Player
from mappo_unity.scenes import make_scene
from mappo_unity.scenes.core.parameters import Parameters, draw
from mappo_unity.scenes.core.specs import Parameter
from mappo_unity.training.plan import plan_jobs

UNIFORM = {"sampler": "uniform", "min": 0.5, "max": 10}
DONE = {"measure": "progress", "threshold": 0.1}
KNOWN = {"mass": Parameter(1.0, above=0.0), "gravity": Parameter(9.81, at_once=True), "x": Parameter(0.0)}


# ---- options


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        (2, 2.0),
        ({"sampler": "constant", "value": 3}, 3.0),
        (UNIFORM, Sampler("uniform", (0.5, 10.0))),
        ({"sampler": "uniform"}, Sampler("uniform", (0.0, 1.0))),
        ({"sampler": "gaussian", "mean": 2, "st_dev": 0.5, "seed": 7}, Sampler("gaussian", (2.0, 0.5), 7)),
        (
            {"sampler": "multirangeuniform", "intervals": [[1, 2], [5, 8]], "seed": -1},
            Sampler("multirangeuniform", (1.0, 2.0, 5.0, 8.0)),
        ),
        (  # ML-Agents' own words
            {"sampler_type": "uniform", "sampler_parameters": {"min_value": 0.5, "max_value": 10}},
            Sampler("uniform", (0.5, 10.0)),
        ),
        ({"sampler_type": "gaussian"}, Sampler("gaussian", (1.0, 1.0))),
    ],
)
def test_values_are_read(raw: Any, value: Any) -> None:
    assert read_value("x", raw) == value


def lessons(*items: Any) -> dict[str, Any]:
    return {"lessons": list(items)}


def completed(**completion: Any) -> dict[str, Any]:
    """Return a curriculum of two lessons."""
    return lessons({"value": 1, "completion": completion}, {"value": 2})


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ("two", "env.params.x=two must be a number"),
        (True, "env.params.x=true must be a number"),
        (float("nan"), "env.params.x=nan must be finite"),
        ({}, "env.params.x={} must be a number, a sampler {sampler: ...} or a curriculum {lessons: [...]}"),
        ({"samplr": "uniform"}, "must be a number, a sampler"),
        (
            {"sampler": "unifrom"},
            "x.sampler=unifrom does not exist (did you mean uniform?); choices: uniform,",
        ),
        ({"sampler": None}, "names no sampler: write {sampler: uniform, min: 0.5, max: 10}"),
        ({"sampler": ["uniform"]}, "env.params.x.sampler=[uniform] does not exist"),
        (UNIFORM | {"mx": 2}, "env.params.x.mx: there is no such key (did you mean max?)"),
        (UNIFORM | {"min": 11}, "env.params.x.min=11 must not be above max=10"),
        (UNIFORM | {"max": float("inf")}, "env.params.x.max=inf must be finite"),
        (UNIFORM | {"max": "ten"}, "env.params.x.max=ten must be a number"),
        (UNIFORM | {"seed": 1.5}, "env.params.x.seed=1.5 must be a whole number from 0 to 2147483647"),
        (UNIFORM | {"seed": -2}, "env.params.x.seed=-2 must be a whole number"),
        ({"sampler": "gaussian", "st_dev": -1}, "env.params.x.st_dev=-1 is out of range: it must be >= 0"),
        ({"sampler": "gaussian", "min": 0}, "env.params.x.min: there is no such key"),
        (
            {"sampler": "multirangeuniform", "intervals": [1, 2]},
            "intervals=[1,2] must be a list of intervals",
        ),
        ({"sampler": "multirangeuniform", "intervals": []}, "intervals=[] must be a list of intervals"),
        ({"sampler": "multirangeuniform", "intervals": [[1]]}, "must be a list of intervals [min, max]"),
        (
            {"sampler": "multirangeuniform", "intervals": [[1, 2], [4, 3]]},
            "in [4, 3] the first end must not be above the second",
        ),
        ({"sampler": "multirangeuniform", "intervals": [[1, 1]]}, "has no interval that is wider than 0"),
        ({"sampler_type": "uniform", "sampler_parameters": 3}, "sampler_parameters=3 must be named values"),
        (lessons(), "env.params.x.lessons=[] must be a list of at least one lesson"),
        ({"lessons": 3}, "env.params.x.lessons=3 must be a list of at least one lesson"),
        ({"lessons": [{"value": 1}], "loop": True}, "env.params.x.loop: there is no such key"),
        (lessons(3), "env.params.x.lessons[0]=3 must be a lesson"),
        (lessons({"name": "a"}), "env.params.x.lessons[0] has no value"),
        (lessons({"value": 1, "nme": "a"}), "env.params.x.lessons[0].nme: there is no such key"),
        (lessons({"value": 1, "name": [1]}), "env.params.x.lessons[0].name=[1] must be a text"),
        (
            lessons({"value": 1}, {"value": 2}),
            "lessons[0] has no completion, which every lesson but the last",
        ),
        (lessons({"value": {"sampler": "x"}}), "env.params.x.lessons[0].value.sampler=x does not exist"),
        (
            completed(measure="rewards"),
            "completion.measure=rewards does not exist; choices: progress, reward, group_reward",
        ),
        (completed(measure="progress", threshold=1.5), "completion.threshold=1.5 is out of range"),
        (completed(measure="progress", threshold=-0.1), "it must be from 0 to 1"),
        (completed(threshold=float("nan")), "completion.threshold=nan must be finite"),
        (completed(min_lesson_length=-1), "min_lesson_length=-1 must be a whole number >= 0"),
        (completed(min_lesson_length=1.5), "min_lesson_length=1.5 must be a whole number >= 0"),
        (completed(signal_smoothing="yes"), "completion.signal_smoothing=yes must be true or false"),
        (completed(require_reset=1), "completion.require_reset=1 must be true or false"),
        (completed(behaviour="a"), "completion.behaviour: there is no such key (did you mean"),
        (completed(behavior=[1]), "completion.behavior=[1] must be a behavior's name"),
        (lessons({"value": 1, "completion": 3}, {"value": 2}), "completion=3 must be named values"),
    ],
)
def test_mistakes_are_told(raw: Any, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        EnvConfig(backend=Backend.editor, params={"x": raw})
    assert words in str(error.value)


def test_a_curriculum_is_read_in_our_words_and_in_those_of_ml_agents() -> None:
    ours = lessons(
        {"name": "easy", "value": UNIFORM, "completion": {"behavior": "B", **DONE, "min_lesson_length": 5}},
        {"value": 8},
    )
    theirs = {
        "curriculum": [
            {
                "name": "easy",
                "value": {
                    "sampler_type": "uniform",
                    "sampler_parameters": {"min_value": 0.5, "max_value": 10},
                },
                "completion_criteria": {"behavior": "B", **DONE, "min_lesson_length": 5},
            },
            {"value": 8},
        ]
    }
    expected = (
        Lesson("easy", Sampler("uniform", (0.5, 10.0)), Completion("B", "progress", 0.1, 5, True, False)),
        Lesson("Lesson1", 8.0, None),
    )
    assert read_curriculum("x", ours).lessons == read_curriculum("x", theirs).lessons == expected


def test_samplers_stand_in_order_and_curricula_at_a_lesson() -> None:
    walls = lessons({"value": UNIFORM, "completion": DONE}, {"value": UNIFORM})
    cfg = EnvConfig(name="WallJump", params={"small_wall_height": UNIFORM, "big_wall_height": walls})
    first, last = values_at(cfg.parameters, {}), values_at(cfg.parameters, {"big_wall_height": 9})
    assert [first["small_wall_height"].order, first["big_wall_height"].order] == [0, 1]
    assert last["big_wall_height"].order == 2 and last == values_at(cfg.parameters, {}, missing=-1)
    assert first["big_wall_height"].seed_within(2**31 - 1) == 0

    walls["lessons"][1]["value"] = 8
    assert params_at(cfg.params, {})["big_wall_height"] == UNIFORM
    assert params_at(cfg.params, {"big_wall_height": 1}) == {
        "small_wall_height": UNIFORM,
        "big_wall_height": 8,
    }


def test_values_are_shown() -> None:
    assert show_parameter(2.0) == "2" and show_parameter(3) == "3"
    assert show_parameter(Sampler("uniform", (0.5, 10.0))) == "uniform 0.5 to 10"
    assert show_parameter(Sampler("gaussian", (2.0, 0.1))) == "gaussian, mean 2, st_dev 0.1"
    assert (
        show_parameter(Sampler("multirangeuniform", (1.0, 2.0, 5.0, 8.0)))
        == "multirangeuniform 1 to 2, 5 to 8"
    )


@pytest.mark.parametrize(
    ("lines", "mass"),
    [
        (["env.params.mass={sampler: uniform, min: 0.5, max: 10}"], UNIFORM),
        (["parameters=3DBall_randomize"], UNIFORM),
        (["parameters=3DBall_randomize", "env.params.mass.max=5"], UNIFORM | {"max": 5}),
        (["parameters=3DBall_randomize", "env.params.mass=3"], 3),
        (  # a sampler takes another's place: Hydra alone would mix their keys
            ["parameters=3DBall_randomize", "env.params.mass={sampler: gaussian, mean: 2}"],
            {"sampler": "gaussian", "mean": 2},
        ),
        (
            ["parameters=3DBall_randomize", "env.params={mass: {lessons: [{value: 2}]}}"],
            lessons({"value": 2}),
        ),
        (
            ["env.params.mass={sampler: gaussian}", "env.params.mass={sampler: uniform}"],
            {"sampler": "uniform"},
        ),
        (["env.params.mass={sampler: gaussian}", "env.params.mass=3"], 3),
        (["env.params={mass: {sampler: gaussian}}", "env.params={mass: 3}"], 3),
        (["env.params.mass={sampler: gaussian}", "~env.params.mass", "+env.params.mass=3"], 3),
        (["env.params.mass=3", "env.params.mass={lessons: [{value: 2}]}"], lessons({"value": 2})),
    ],
)
def test_the_command_line_takes_them(lines: list[str], mass: Any) -> None:
    assert compose_config(["env=3DBall", *lines]).config.env.params["mass"] == mass


def test_wall_jumps_curriculum_is_the_official_one() -> None:
    env = compose_config(["env=WallJump", "parameters=WallJump_curriculum"]).config.env
    big, small = (env.parameters[name].lessons for name in ("big_wall_height", "small_wall_height"))
    assert [show_parameter(lesson.value) for lesson in big] == [
        *("uniform 0 to 4", "uniform 4 to 7", "uniform 6 to 8", "8")
    ]
    assert [lesson.value for lesson in small] == [1.5, 2.0, 2.5, 4.0]
    assert [item.completion.threshold for item in big[:3]] == [0.1, 0.3, 0.5]
    assert {item.completion.min_lesson_length for item in (*big[:3], *small[:3])} == {100}


def test_a_factory_takes_numbers_lessons_with_numbers_and_its_own_arguments() -> None:
    def custom(value: Any) -> Any:
        cfg = EnvConfig(backend=Backend.custom, factory="a:b", params={"x": value})
        return values_at(cfg.parameters, {})["x"]

    assert custom({"width": 3}) == {"width": 3} and custom({"sampler": "latin"}) == {"sampler": "latin"}
    assert custom(completed(**DONE)) == 1.0
    for raw in (UNIFORM, lessons({"value": UNIFORM})):
        with pytest.raises(ConfigError, match="env.factory takes no sampler, it draws numbers of its own"):
            custom(raw)


# ---- drawing


def drawn(kind: str, *numbers: float, count: int = 20_000) -> np.ndarray:
    return draw(Sampler(kind, numbers), np.random.default_rng(5), count)


def test_samplers_draw_from_their_distributions() -> None:
    uniform = drawn("uniform", 0.5, 10)
    assert 0.5 <= uniform.min() < 0.51 and 9.99 < uniform.max() <= 10 and abs(uniform.mean() - 5.25) < 0.1

    gaussian = drawn("gaussian", 2, 0.5)
    assert abs(gaussian.mean() - 2) < 0.02 and abs(gaussian.std() - 0.5) < 0.02

    # by width: [1, 2] a quarter, [4, 4] nothing, [5, 8] three quarters
    ranges = drawn("multirangeuniform", 1, 2, 4, 4, 5, 8)
    low, high = ranges[ranges < 3], ranges[ranges > 3]
    assert 1 <= low.min() and low.max() <= 2 and 5 <= high.min() and high.max() <= 8
    assert abs(len(low) / len(ranges) - 0.25) < 0.02 and abs(high.mean() - 6.5) < 0.05


def test_seeds_decide() -> None:
    def numbers(sampler: Sampler, seed: int) -> list[float]:
        parameters = Parameters("S", KNOWN, seed)
        parameters.set("x", sampler)
        return parameters.draw("x", 3).tolist()

    free, fixed = Sampler("uniform", (0.0, 1.0)), Sampler("uniform", (0.0, 1.0), seed=9)
    assert numbers(free, 1) == numbers(free, 1) != numbers(free, 2)
    assert numbers(fixed, 1) == numbers(fixed, 2) == numbers(free, 9)
    assert numbers(Sampler("uniform", (0.0, 1.0), order=1), 1) == numbers(free, 2)


def test_every_reading_draws_and_a_snapshot_goes_on_where_it_was() -> None:
    parameters = Parameters("S", KNOWN, 0)
    assert dict(parameters) == {"mass": 1.0, "gravity": 9.81, "x": 0.0} and parameters["mass"] == 1.0
    assert parameters.draw("mass", 2).tolist() == [1.0, 1.0]

    parameters.set("mass", Sampler("multirangeuniform", (1.0, 2.0, 5.0, 8.0)))
    assert parameters["mass"] != parameters["mass"]
    state = parameters.get_state()
    following = parameters.draw("mass", 5)

    other = Parameters("S", KNOWN, 3)
    other.set_state(state)
    assert (other.draw("mass", 5) == following).all()
    other.set_state({"mass": 2.0})
    assert other["mass"] == 2.0


def test_a_gaussian_keeps_to_what_the_scene_can_take() -> None:
    parameters = Parameters("S", KNOWN, 0)
    parameters.set("mass", Sampler("gaussian", (0.1, 1.0)))
    assert (parameters.draw("mass", 1000) > 0).all()


@pytest.mark.parametrize(
    ("name", "sampler", "words"),
    [
        ("mas", Sampler("uniform", (1.0, 2.0)), "scene S has no parameter 'mas'; choices: gravity, mass, x"),
        ("mass", Sampler("uniform", (0.0, 2.0)), "what uniform 0 to 2 draws must be > 0"),
        ("mass", Sampler("gaussian", (-1.0, 2.0)), "what gaussian, mean -1, st_dev 2 draws must be > 0"),
        (
            "gravity",
            Sampler("uniform", (1.0, 2.0)),
            "acts at once and not at a reset, so it takes no sampler",
        ),
        ("mass", {"samplr": 1}, "must be a finite number (or, in options, a sampler {sampler: ...}"),
    ],
)
def test_samplers_that_a_scene_cannot_take(name: str, sampler: Any, words: str) -> None:
    with pytest.raises(ConfigError) as error:
        Parameters("S", KNOWN, 0).set(name, sampler)
    assert words in str(error.value)


# ---- scenes


def test_every_ball_has_a_mass_and_size_of_its_own() -> None:
    scene: Any = make_scene(
        "3DBall", num_areas=20, mass=Sampler("uniform", (0.5, 10.0)), scale=Sampler("uniform", (0.75, 3.0), 4)
    )
    scene.reset()
    assert len(set(scene.mass)) == len(set(scene.scale)) == 20
    assert 0.5 <= scene.mass.min() and scene.mass.max() <= 10 and scene.scale.min() >= 0.75

    before = scene.mass.copy()
    scene.end_episode(np.arange(3))
    assert (scene.mass[:3] != before[:3]).all() and (scene.mass[3:] == before[3:]).all()


@pytest.mark.parametrize(
    ("name", "parameter", "read"),
    [
        ("WallJump", "big_wall_height", lambda scene: scene.bodies.wall_height),
        ("SoccerTwos", "ball_touch", lambda scene: scene.touch_reward),
        ("GridFoodCollector", "agent_scale", lambda scene: scene.physics.agent_half.ravel()),
    ],
)
def test_other_scenes_draw_for_every_agent(name: str, parameter: str, read: Any) -> None:
    scene: Any = make_scene(name, num_areas=8, seed=1, **{parameter: Sampler("uniform", (1.0, 2.0))})
    for _ in range(3):
        scene.reset()
    values = read(scene)
    assert len(set(values[(values > 0) & (values != 4)].tolist())) > 3


def test_a_scene_goes_on_from_a_snapshot_with_the_same_draws() -> None:
    def make(seed: int) -> Any:
        scene: Any = make_scene("3DBall", num_areas=6, seed=seed, mass=Sampler("uniform", (0.5, 10.0)))
        scene.reset()
        return scene

    one, other = make(3), make(4)
    other.set_state(one.get_state())
    for scene in (one, other):
        scene.end_episode(np.arange(6))
    assert (one.mass == other.mass).all()


def test_a_later_lesson_is_checked_when_the_scene_is_opened() -> None:
    make = make_env_function(
        EnvConfig(params={"mass": lessons({"value": 1, "completion": DONE}, {"value": -1})})
    )
    with pytest.raises(ConfigError, match="parameter mass=-1.0 of scene 3DBall is out of range"):
        make(0)


# ---- players


@pytest.mark.parametrize(
    "value",
    [
        2.0,
        Sampler("uniform", (0.5, 8.0), 7),
        Sampler("gaussian", (2.0, 0.5), 7),
        Sampler("multirangeuniform", (1.0, 2.0, 5.0, 8.0), 7),
    ],
)
def test_what_is_sent_to_a_player_arrives(value: Any) -> None:
    channel = side_channels.ParametersChannel()
    channel.send("mass", value, seed=3)
    (message,) = channel.message_queue
    assert side_channels.read_parameter(side_channels.IncomingMessage(bytes(message))) == ("mass", value)


def test_the_players_seed_is_that_of_its_samplers() -> None:
    channel = side_channels.ParametersChannel()
    channel.send("mass", Sampler("uniform", (0.5, 8.0), order=2), seed=3)
    (message,) = channel.message_queue
    assert side_channels.read_parameter(side_channels.IncomingMessage(bytes(message)))[1].seed == 5


def test_our_player_draws_and_says_what_it_ignores() -> None:
    lines: list[str] = []
    player = Player(lambda seed, areas: make_scene("3DBall", num_areas=4), "3DBall", lines.append)
    player.env = make_scene("3DBall", num_areas=4)
    player._set_parameter("mass", Sampler("uniform", (0.5, 10.0), 7))
    player._set_parameter("gravity", Sampler("uniform", (1.0, 2.0), 7))
    player.env.reset()
    assert len(set(player.env.mass)) == 4
    assert lines[0] == "environment parameter mass = uniform 0.5 to 10"
    assert "environment parameter gravity = uniform 1 to 2 is ignored: " in lines[1]


def test_a_sampler_of_no_kind_is_refused() -> None:
    channel = side_channels.ParametersChannel()
    channel.set_uniform_sampler_parameters("mass", 3.0, 1.0, 0)
    (message,) = channel.message_queue
    with pytest.raises(ConfigError, match="environment parameter mass.min=3 must not be above max=1"):
        side_channels.read_parameter(side_channels.IncomingMessage(bytes(message)))


def test_a_sweep_takes_them() -> None:
    lines = ["env=3DBall", "parameters=3DBall_randomize", "env.params.mass={sampler: gaussian},3"]
    assert [c.env.params["mass"] for c in plan_jobs(lines).configs] == [{"sampler": "gaussian"}, 3]


def test_a_sampler_draws_other_numbers_than_the_scene_of_its_seed() -> None:
    parameters = Parameters("Probe", KNOWN, seed=5)
    parameters.set("x", Sampler("uniform", (0.0, 1.0)))
    own = parameters.draw("x", 4).tolist()
    assert own != np.random.default_rng(5).random(4).tolist()

    again = Parameters("Probe", KNOWN, seed=5)
    again.set("x", Sampler("uniform", (0.0, 1.0)))
    assert again.draw("x", 4).tolist() == own
