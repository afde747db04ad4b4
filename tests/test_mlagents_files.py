"""What mappo-learn reads beside plain files: anchors, values that follow from others, files of its own."""

import pytest
import yaml
from test_learn import translated

from mappo_unity.config.compose import compose_config
from mappo_unity.config.mlagents.flags import parse_flags
from mappo_unity.config.mlagents.read import read_settings
from mappo_unity.config.mlagents.resolved import resolved
from mappo_unity.config.mlagents.translate import translate
from mappo_unity.errors import ConfigError


def settings_of(tmp_path, text, *flags):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return read_settings(parse_flags([str(path), *flags]))


# --- anchors


def test_an_anchor_with_a_merge_key_may_be_used_again(tmp_path):
    text = "behaviors: {A: &a {max_steps: 5}, B: &b {<<: *a, max_steps: 6}, C: *b, D: {<<: *b, max_steps: 7}}"
    settings = settings_of(tmp_path, text)
    assert [section["max_steps"] for section in settings.behaviors.values()] == [5, 6, 6, 7]

    # the anchor's own place is within a merge
    text = "behaviors: {A: &a {max_steps: 5}, B: {<<: &b {<<: *a, max_steps: 6}}, C: *b}"
    settings = settings_of(tmp_path, text)
    assert [section["max_steps"] for section in settings.behaviors.values()] == [5, 6, 6]


def test_what_is_given_twice_below_an_anchor_is_told(tmp_path):
    text = "behaviors:\n  A: &a {max_steps: 5, max_steps: 6}\n  B: *a\n"
    with pytest.raises(ConfigError, match="line 2: max_steps is given twice, first in line 2"):
        settings_of(tmp_path, text)


# --- team_change


def test_team_change_follows_from_save_steps_where_self_play_is_first_given(tmp_path):
    def change(text):
        return compose_config(translated(tmp_path, text).lines).config.self_play.team_change

    above = "default_settings: {trainer_type: poca, self_play: {save_steps: 100}}\n"
    assert change(above + "behaviors: {A: {self_play: {save_steps: 300}}}") == 500
    assert change(above + "behaviors: {A: {self_play: {save_steps: 300, team_change: 7}}}") == 7
    assert change("behaviors: {A: {trainer_type: poca, self_play: {save_steps: 300}}}") == 1500
    off = "default_settings: {trainer_type: poca, self_play: null}\n"
    assert change(off + "behaviors: {A: {self_play: {save_steps: 300}}}") == 1500


@pytest.mark.parametrize("change", [None, 700])
def test_the_configuration_of_a_run_can_be_read_again(tmp_path, change):
    text = "behaviors: {A: {trainer_type: poca, self_play: {save_steps: 300}}}"
    settings = settings_of(tmp_path, text)
    lines = translate(settings).lines

    configuration = resolved(settings)
    own = configuration["behaviors"]["A"]["self_play"]
    assert own["team_change"] == 1500
    own["team_change"] = change  # earlier versions wrote null
    again = translate(settings_of(tmp_path, yaml.safe_dump(configuration)))
    expected = [line.replace("change=1500", f"change={change or 1500}") for line in lines]
    assert again.lines == expected and again.warnings == []


# --- lessons


@pytest.mark.parametrize("criteria, is_told", [("null", False), ("{behavior: A, threshold: 0.5}", True)])
def test_completion_criteria_of_the_last_lesson_are_told_where_there_are_any(tmp_path, criteria, is_told):
    text = f"""
behaviors: {{A: {{trainer_type: ppo}}}}
environment_parameters:
  mass:
    curriculum:
      - {{name: a, value: 1, completion_criteria: {{behavior: A, measure: progress, threshold: 0.1}}}}
      - {{name: b, value: 2, completion_criteria: {criteria}}}
"""
    said = "my.yaml, line 4: environment_parameters.mass: the completion_criteria of the last lesson have no"
    warnings = translated(tmp_path, text).warnings
    assert len(warnings) == is_told and all(said in text for text in warnings)


# --- mistakes that only the open environment knows


PARAMETERS = """
behaviors: {3DBall: {trainer_type: ppo}}
environment_parameters:
  mass:
    curriculum:
      - {name: a, value: 1, completion_criteria: {behavior: 3DBall, measure: progress, threshold: 0.1}}
      - name: b
        value: 2
  ball.size: 3
"""


@pytest.mark.parametrize(
    "said, place",
    [
        (
            "env.params.mass.lessons[1].value=2: no",
            "line 8: environment_parameters.mass.lessons[1].value=2: no",
        ),
        (
            "scene X has no parameter 'mass'; choices: none",
            "line 4: environment_parameters.mass: scene X has no",
        ),
        (
            "scene X has no parameter 'ball.size'; choices: none",
            "line 9: environment_parameters.ball.size: scene",
        ),
        (
            "parameter mass=2 of scene X is out of",
            "line 4: environment_parameters.mass: parameter mass=2 of scene",
        ),
        (
            "parameter mass of scene X acts at once",
            "line 4: environment_parameters.mass: parameter mass of scene",
        ),
        ("env.params.masses.lessons[1]: no", "env.params.masses.lessons[1]: no"),
    ],
)
def test_a_parameter_that_the_environment_does_not_take_is_told_with_its_line(tmp_path, said, place):
    told = str(translated(tmp_path, PARAMETERS, "--env=scene:3DBall").explain(ConfigError(said)))
    assert place in told and told.endswith(said.removeprefix("env.params.mass.lessons"))
    assert told.startswith(f"{tmp_path / 'my.yaml'}, line ") == place.startswith("line ")


def test_what_is_told_below_an_error_stays(tmp_path):
    error = ConfigError("ppo.lr=2 is too large")
    error.details = ("a traceback of the user's code",)
    told = translated(tmp_path, "behaviors:\n  A: {hyperparameters: {learning_rate: 2}}").explain(error)
    assert "line 2: behaviors.A.hyperparameters.learning_rate: ppo.lr=2 is too large" in str(told)
    assert told.details == error.details
