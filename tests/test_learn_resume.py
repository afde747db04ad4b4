"""mappo-learn --resume: the file rules over what the run has, and the same file changes nothing."""

import pytest
from test_mlagents_files import settings_of

from mappo_unity.cli import learn
from mappo_unity.config.compose import compose_config, load_config
from mappo_unity.config.mlagents.flags import parse_flags
from mappo_unity.config.mlagents.read import read_settings
from mappo_unity.config.mlagents.resolved import resolved
from mappo_unity.config.mlagents.translate import translate
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.runs.folder import CONFIG, write_record
from mappo_unity.runs.options import compose_resumed
from mappo_unity.runs.results import write_configuration

TWO = """
behaviors:
  Goalie: {trainer_type: ppo, hyperparameters: {learning_rate: 0.0001}}
  Striker: {trainer_type: ppo, hyperparameters: {learning_rate: 0.0003}}
"""
ABOVE = """
default_settings: {trainer_type: ppo, hyperparameters: {beta: 0.001}}
behaviors:
  Goalie: {hyperparameters: {beta: 0.0001}, reward_signals: {curiosity: {strength: 0.02}}}
  My.Ball: {hyperparameters: {beta: 0.0001}}
  3DBall: {time_horizon: 5}
"""
PARAMETERS = """
environment_parameters:
  ball.mass: 1
  gravity:
    curriculum:
      - {name: a, value: 1, completion_criteria: {behavior: Goalie, measure: progress, threshold: 0.1}}
      - {name: b, value: 2}
"""


def resumed(tmp_path, before, after, own=(), now=(), env="--env=scene:StrikersVsGoalie"):
    """Return the options of a run of one file, and those of the run when it is resumed with another."""
    lines = [*translate(settings_of(tmp_path, before, env)).lines, *own]
    folder = tmp_path / "results" / "first"
    folder.mkdir(parents=True, exist_ok=True)
    write_record(folder, compose_config(lines).config, lines)
    write_configuration(folder, resolved(settings_of(tmp_path, before, env)))

    settings = settings_of(tmp_path, after, "--run-id=first", "--resume")
    lines = learn._run_lines(settings, translate(settings).lines, list(now), folder, resume=True)
    return load_config(folder / CONFIG), compose_resumed(lines[:-1], folder / CONFIG)


@pytest.mark.parametrize("text", [TWO, ABOVE, TWO + PARAMETERS])
def test_the_same_file_changes_nothing(tmp_path, capsys, text):
    saved, config = resumed(tmp_path, text, text)
    assert config == saved
    assert capsys.readouterr().err == ""


def test_with_the_same_file_what_the_command_line_gave_stays(tmp_path, capsys):
    own = ["env.params.gravity=3", "behaviors.Goalie.ppo.lr=0.5"]
    alike = TWO.replace("0.0001", "0.0003")
    saved, config = resumed(tmp_path, alike, alike, own=own)
    assert config == saved and capsys.readouterr().err == ""
    assert config.env.params["gravity"] == 3 and behavior_config(config, "Goalie").ppo.lr == 0.5

    # a parameter that no file ever named stays in any case
    _, config = resumed(tmp_path, TWO + PARAMETERS, TWO, own=["env.params.wind=3"])
    assert config.env.params["wind"] == 3 and "gravity" not in config.env.params


def test_what_a_behavior_no_longer_has_of_its_own_is_that_of_all(tmp_path):
    _, config = resumed(tmp_path, TWO, TWO.replace("0.0001", "0.0003"))
    assert [behavior_config(config, name).ppo.lr for name in ("Goalie", "Striker")] == [3e-4, 3e-4]

    _, config = resumed(tmp_path, ABOVE, ABOVE.replace("0.0001", "0.001").replace("curiosity", "extrinsic"))
    goalie, ball = (behavior_config(config, name) for name in ("Goalie", "My.Ball"))
    assert (goalie.ppo.entropy_coef, ball.ppo.entropy_coef) == (0.001, 0.001)
    assert goalie.rewards.curiosity.strength == 0

    # a behavior that the file no longer names has default_settings
    _, config = resumed(tmp_path, ABOVE, "default_settings: {trainer_type: ppo, time_horizon: 7}")
    assert {behavior_config(config, name).ppo.entropy_coef for name in config.behaviors} == {0.005}
    assert {behavior_config(config, name).ppo.time_horizon for name in config.behaviors} == {7}


def test_options_of_the_command_line_beat_the_file_still(tmp_path):
    now = ["behaviors.Goalie.ppo.lr=0.5", "behaviors.Striker.ppo.lr=0.25"]
    _, config = resumed(tmp_path, TWO, TWO.replace("0.0001", "0.0003"), now=now)
    assert [behavior_config(config, name).ppo.lr for name in ("Goalie", "Striker")] == [0.5, 0.25]


def test_parameters_that_the_file_no_longer_names_are_gone(tmp_path, capsys):
    saved, config = resumed(tmp_path, TWO + PARAMETERS, TWO)
    assert saved.env.params.keys() == {"ball_touch", "ball.mass", "gravity"}
    # those of the preset stay
    assert config.env.params == {"ball_touch": 0, "ball.mass": 1}
    told = capsys.readouterr().err
    assert (
        "env.params.gravity stands neither in the file nor among the options: the run goes on without" in told
    )
    assert "env.params.ball.mass stands neither" in told and "the run keeps it" in told
    assert "ball_touch" not in told

    saved, config = resumed(tmp_path, TWO + PARAMETERS, TWO, now=["env.params.gravity=3"])
    assert config.env.params["gravity"] == 3
    saved, config = resumed(tmp_path, TWO + PARAMETERS, TWO, now=["~env.params.gravity"])
    assert "gravity" not in config.env.params


def test_without_a_file_nothing_is_taken_from_the_run(tmp_path):
    resumed(tmp_path, TWO + PARAMETERS, TWO)
    settings = read_settings(parse_flags(["--run-id=first", "--resume"]))
    lines = learn._run_lines(settings, translate(settings).lines, [], tmp_path / "results/first", resume=True)
    assert not [line for line in lines if line.startswith(("~", "behaviors"))]
