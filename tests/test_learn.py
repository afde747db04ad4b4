"""mappo-learn: what ML-Agents' files and flags become, mistakes in them, and a run from end to end."""

import json
import os
import re
from pathlib import Path

import pytest
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mappo_unity.cli import learn, learn_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.mlagents.flags import flag_of, parse_flags
from mappo_unity.config.mlagents.keys import RUN
from mappo_unity.config.mlagents.read import read_settings
from mappo_unity.config.mlagents.translate import translate
from mappo_unity.config.per_behavior import behavior_config, init_source
from mappo_unity.errors import ConfigError
from mappo_unity.runs import results
from mappo_unity.runs.behavior_events import mlagents_tags
from mappo_unity.runs.metrics_csv import read_metrics

BALL = """
behaviors:
  3DBall:
    trainer_type: ppo
    hyperparameters:
      batch_size: 64
      buffer_size: 12000
      learning_rate: 0.0003
      beta: 0.001
      epsilon: 0.2
      lambd: 0.99
      num_epoch: 3
      learning_rate_schedule: linear
    network_settings:
      normalize: true
      hidden_units: 128
      num_layers: 2
      vis_encode_type: simple
    reward_signals:
      extrinsic:
        gamma: 0.99
        strength: 1.0
    keep_checkpoints: 5
    max_steps: 500000
    time_horizon: 1000
    summary_freq: 12000
"""


def test_help_says_what_each_flag_does(capsys):
    assert learn_main(["--help"]) == 0
    text = capsys.readouterr().out
    flags = [flag_of(key) for key in RUN if flag_of(key) in text]
    assert len(flags) > 20
    for flag in flags:  # its explanation stands behind it, or in the next line
        assert re.search(rf"^  {flag}( VALUE| \.\.\.)?( {{2,}}|\n {{20,}})\w", text, re.M), flag


@pytest.mark.parametrize("short", ["--hel", "-hh"])
def test_help_may_be_shortened_as_other_flags(capsys, short):
    assert learn_main([short]) == 0
    assert capsys.readouterr().out.startswith("usage: mappo-learn")


def test_presets_of_ones_own_environment_are_no_scenes(tmp_path):
    with pytest.raises(
        ConfigError, match="there is no embedded scene 'pettingzoo'; scenes: 3DBall, Basic"
    ) as caught:
        translated(tmp_path, BALL, "--env=scene:pettingzoo")
    assert "custom" not in str(caught.value) and "unity" not in str(caught.value)


def translated(tmp_path, text, *flags):
    path = tmp_path / "my.yaml"
    path.write_text(text)
    return translate(read_settings(parse_flags([str(path), *flags])))


def composed(tmp_path, text, *flags):
    """Return the options that a file becomes, and the warnings."""
    translation = translated(tmp_path, text, *flags)
    return compose_config(translation.lines).config, translation.warnings


def of_behavior(text):
    return f"behaviors:\n  Ball:\n    trainer_type: ppo\n{text}"


# --- translation


def test_an_official_file_becomes_our_options(tmp_path):
    config, warnings = composed(tmp_path, BALL, "--env=scene:3DBall", "--seed=7")
    assert warnings == []
    assert (config.env.name, config.seed, config.max_steps) == ("3DBall", 7, 500_000)
    assert (config.collect.batch_size, config.ppo.minibatch_size, config.ppo.epochs) == (12_000, 64, 3)
    assert (config.ppo.lr, config.ppo.lr_final, config.ppo.gae_lambda) == (3e-4, 1e-10, 0.99)
    assert (config.ppo.entropy_coef, config.ppo.entropy_coef_final) == (0.001, 1e-5)
    assert (config.ppo.clip_epsilon, config.ppo.clip_schedule.name) == (0.2, "linear")
    assert (config.ppo.time_horizon, config.ppo.ratio.name) == (1000, "component")
    assert (config.model.hidden, config.model.normalize_obs) == ([128, 128], True)
    assert (config.model.critic.name, config.model.activation.name) == ("local", "silu")
    assert config.log.summary_freq == 12_000


def test_what_a_file_leaves_out_is_mlagents_default_not_our_preset(tmp_path):
    config, _ = composed(tmp_path, "behaviors: {Pyramids: {trainer_type: ppo}}", "--env=scene:Pyramids")
    # the preset has RND and other sizes, the official file curiosity and [512, 512]
    assert config.rewards.rnd.strength == config.rewards.curiosity.strength == 0
    assert (config.model.hidden, config.ppo.minibatch_size) == ([128, 128], 1024)
    assert (config.collect.batch_size, config.max_steps, config.ppo.time_horizon) == (10_240, 500_000, 64)


def test_schedules_follow_the_learning_rate_s_where_it_is_given(tmp_path):
    text = of_behavior("    hyperparameters: {learning_rate_schedule: constant, epsilon_schedule: linear}\n")
    config, _ = composed(tmp_path, text, "--env=scene:3DBall")
    names = [s.name for s in (config.ppo.lr_schedule, config.ppo.entropy_schedule, config.ppo.clip_schedule)]
    assert names == ["constant", "constant", "linear"]


def test_numbers_may_be_texts_as_yaml_reads_them(tmp_path):
    text = of_behavior("    max_steps: 5e5\n    hyperparameters: {learning_rate: 1e-4}\n")
    config, _ = composed(tmp_path, text)
    assert (config.max_steps, config.ppo.lr) == (500_000, 1e-4)

    text += """environment_parameters:
  mass: {sampler_type: gaussian, sampler_parameters: {mean: 1e0, st_dev: 1e-3}}
  level:
    curriculum:
      - name: 1e0
        completion_criteria: {measure: progress, behavior: Ball, threshold: 1e-1, min_lesson_length: 1e2}
        value: 1e1
      - {name: last, value: 2}
"""
    config, _ = composed(tmp_path, text)
    mass, level = (config.env.parameters[name] for name in ("mass", "level"))
    assert mass.numbers == (1.0, 1e-3) and level.lessons[0].value == 10.0
    completion = level.lessons[0].completion
    assert (completion.threshold, completion.min_lesson_length) == (0.1, 100)


def test_names_with_dots_are_names(tmp_path):
    text = of_behavior("    max_steps: 5\n").replace("Ball", "My.Ball")
    text += "environment_parameters: {ball.mass: 3, 'a=b': {sampler_type: uniform}, scale: 2}\n"
    config, _ = composed(tmp_path, text)
    assert {"ball.mass": 3, "scale": 2}.items() <= config.env.params.items()
    assert config.env.parameters["a=b"].kind == "uniform"
    assert list(config.behaviors) == ["My.Ball"]


def test_a_behavior_may_begin_with_nothing(tmp_path):
    text = "default_settings: {trainer_type: ppo, init_path: base.onnx}\n"
    text += "behaviors: {A: {init_path: null}, B: {max_steps: 5}}\n"
    config, _ = composed(tmp_path, text)
    assert config.init_from == "base.onnx"
    assert init_source(config, "A") == ("behaviors.A.init_from", None)
    assert init_source(config, "B") == ("init_from", "base.onnx")


def test_signals_replace_the_default_and_those_of_default_settings_stay(tmp_path):
    alone = of_behavior(
        "    reward_signals: {curiosity: {strength: 0.02, network_settings: {num_layers: 1}}}\n"
    )
    config, _ = composed(tmp_path, alone)
    assert (config.rewards.extrinsic.strength, config.rewards.curiosity.strength) == (0, 0.02)
    assert (config.rewards.curiosity.hidden, config.rewards.curiosity.normalize) == ([128], False)

    config, _ = composed(tmp_path, "default_settings: {max_steps: 7}\n" + alone)
    rewards = behavior_config(config, "Ball").rewards
    assert (rewards.extrinsic.strength, rewards.curiosity.strength) == (1, 0.02)


def test_default_settings_lie_below_each_behavior(tmp_path):
    config, warnings = composed(
        tmp_path,
        """
default_settings:
  trainer_type: poca
  hyperparameters: {learning_rate: 0.001, batch_size: 100, learning_rate_schedule: constant}
  network_settings: {memory: {memory_size: 64}, hidden_units: 32}
behaviors:
  A:
    hyperparameters: {batch_size: 200, learning_rate_schedule: linear}
    network_settings: {memory: null}
  B.c: {max_steps: 100}
""",
    )
    a, b, other = (behavior_config(config, name) for name in ("A", "B.c", "Other"))
    assert (a.ppo.lr, a.ppo.minibatch_size, a.model.hidden) == (0.001, 200, [32, 32])
    assert (a.model.memory.name, b.model.memory.name, b.model.memory_size) == ("none", "lstm", 64)
    assert {x.model.critic.name for x in (a, b, other)} == {"poca"}
    # a behavior's schedule spreads no more once default_settings has been expanded
    assert (a.ppo.lr_schedule.name, a.ppo.entropy_schedule.name) == ("linear", "constant")
    assert (other.ppo.minibatch_size, config.only_named_behaviors) == (100, False)
    assert config.max_steps == 500_000 + 100
    assert any("added up" in text for text in warnings)


def test_lengths_of_several_behaviors_are_added_up(tmp_path):
    text = """
behaviors:
  Goalie: {trainer_type: poca, max_steps: 30, self_play: {save_steps: 50, swap_steps: 1}}
  Striker: {trainer_type: poca, max_steps: 40, self_play: {save_steps: 50, swap_steps: 4, team_change: 9}}
"""
    config, _ = composed(tmp_path, text, "--env=scene:StrikersVsGoalie")
    own = config.self_play
    assert (config.max_steps, config.collect.batch_size) == (70, 20_480)
    assert (own.save_steps, own.swap_steps, own.team_change, own.num_opponents) == (100, 5, 259, 1)
    assert config.only_named_behaviors


def test_demonstrations_and_memory(tmp_path):
    text = of_behavior(
        "    network_settings: {memory: {sequence_length: 32, memory_size: 256}}\n"
        "    behavioral_cloning: {demo_path: e.demo, steps: 150, strength: 0.5}\n"
        "    reward_signals: {gail: {demo_path: g.demo, strength: 0.01, encoding_size: 16}}\n"
    )
    config, warnings = composed(tmp_path, text)
    assert (config.model.memory.name, config.model.memory_size, config.ppo.sequence_length) == (
        "lstm",
        256,
        32,
    )
    assert (config.bc.demos, config.bc.steps, config.bc.strength) == (["e.demo"], 150, 0.5)
    gail = config.rewards.gail
    assert (gail.demos, gail.strength, gail.hidden) == (["g.demo"], 0.01, [16, 16])
    assert any("encoding_size is an old spelling" in text for text in warnings)


def test_environment_parameters_keep_their_samplers_and_lessons(tmp_path):
    text = (
        BALL
        + """
environment_parameters:
  gravity: 9.81
  mass: {sampler_type: uniform, sampler_parameters: {min_value: 0.5, max_value: 10}}
  scale:
    curriculum:
      - name: big
        completion_criteria: {behavior: 3DBall, measure: progress, threshold: 0.1, min_lesson_length: 100}
        value: 1.5
      - name: small
        value: 0.75
"""
    )
    config, _ = composed(tmp_path, text, "--env=scene:3DBall")
    parameters = config.env.parameters
    assert (parameters["gravity"], parameters["mass"].numbers) == (9.81, (0.5, 10.0))
    first, last = parameters["scale"].lessons
    assert (first.name, first.value, first.completion.threshold, last.value) == ("big", 1.5, 0.1, 0.75)


def test_flags_beat_the_file_and_go_to_the_player(tmp_path):
    text = BALL + "env_settings: {num_envs: 2, seed: 3}\nengine_settings: {time_scale: 5, width: 100}\n"
    flags = (
        "--env=Build/Game",
        "--num-envs=4",
        "--time-scale",
        "10",
        "--no-graphics",
        "--env-args",
        "--x",
        "1",
    )
    config, warnings = composed(tmp_path, text, *flags)
    env = config.env
    assert (env.backend.name, env.file_name, env.num_players) == ("player", "Build/Game", 4)
    assert (env.time_scale, env.screen_width, env.screen_height, env.quality_level) == (10, 100, 84, 5)
    assert (env.no_graphics, env.player_args, config.seed) == (True, ["--x", "1"], 3)
    assert warnings == []


def test_without_env_the_editor_is_waited_for(tmp_path):
    config, _ = composed(tmp_path, BALL)
    assert (config.env.backend.name, config.env.port) == ("editor", None)


@pytest.mark.parametrize(
    "text, flag, said",
    [
        ("    threaded: true\n", "", "line 4: behaviors.Ball.threaded has no effect"),
        ("    hyperparameters: {shared_critic: true}\n", "", "shared_critic has no effect"),
        ("    network_settings: {deterministic: true}\n", "", "deterministic has no effect"),
        ("    framework: pytorch\n", "", "framework has no effect"),
        ("", "--base-port=6000", "--base-port has no effect"),
        ("", "--load", "--load is an old flag without effect"),
        ("", "--debug", "--debug has no effect"),
    ],
)
def test_what_is_not_fulfilled_is_said(tmp_path, text, flag, said):
    flags = [flag] if flag else []
    warnings = translated(tmp_path, of_behavior(text), *flags).warnings
    assert len(warnings) == 1 and said in warnings[0]


def test_every_value_off_its_default_has_an_option_or_a_warning():
    """No key is passed over: each changes the options or is named in a warning."""
    from mappo_unity.config.mlagents.keys import BEHAVIOR, OPTIONAL, RUN
    from mappo_unity.config.mlagents.settings import Given, Section, Settings

    def outcome(behavior, run):
        base = {"trainer_type": Given("ppo", "")}
        for name in ("extrinsic", "curiosity", "rnd", "gail"):
            base[f"reward_signals.{name}"] = Given({}, "")
        base["reward_signals.gail.demo_path"] = Given("a", "")
        base |= {"behavioral_cloning.demo_path": Given("a", ""), "self_play": Given({}, "")}
        base |= {"network_settings.memory": Given({}, "")}
        env = {"env_settings.env_path": Given("Game", "")}
        sections = {"A": Section(BEHAVIOR, base | behavior)}
        settings = Settings(sections, None, Section(RUN, env | run), {}, lambda name, rest: "", [])
        try:
            translation = translate(settings)
        except ConfigError as error:
            return str(error)
        return translation.lines, translation.warnings

    plain = outcome({}, {})
    silent = []
    for key, about in [*BEHAVIOR.items(), *RUN.items()]:
        choices = [choice for choice in about.choices if choice not in (about.default, "sac")]
        value = choices[0] if choices else {bool: True, float: 0.25}.get(type(about.default), "7")
        value = 96 if about.kind == "a whole number" else value
        own = {key: Given(value, key)}
        if outcome(own if key in BEHAVIOR else {}, own if key in RUN else {}) == plain:
            silent.append(key)
    # widths of no network: the extrinsic signal has none; what the run's folder is called is no option
    allowed = ("reward_signals.extrinsic.network_settings.hidden_units",)
    allowed += ("reward_signals.extrinsic.network_settings.num_layers",)
    assert [key for key in silent if not key.startswith("checkpoint_settings.") and key not in allowed] == []
    assert OPTIONAL[0] == "self_play"


# --- mistakes


MISTAKES = {
    "old format": ("default:\n  trainer: ppo\n", "line 1: default: this is the format before"),
    "old key": (
        of_behavior("    trainer: ppo\n"),
        "line 4: behaviors.Ball.trainer is an old spelling: trainer_type",
    ),
    "old memory": (
        of_behavior("    network_settings:\n      use_recurrent: true\n"),
        "line 5: behaviors.Ball.network_settings.use_recurrent is an old spelling: network_settings.memory",
    ),
    "a tab": (of_behavior("\tmax_steps: 5\n"), "line 4: max_steps: a tab stands before it"),
    "unknown": (
        of_behavior("    network_settings:\n      hiden_units: 5\n"),
        "line 5: behaviors.Ball.network_settings.hiden_units is no key of ML-Agents (did you mean",
    ),
    "misplaced": (
        of_behavior("    batch_size: 5\n"),
        "line 4: behaviors.Ball.batch_size does not stand there",
    ),
    "a text": (
        of_behavior("    time_horizon: many\n"),
        "line 4: behaviors.Ball.time_horizon must be a whole number, and is 'many'",
    ),
    "a text for a flag": (
        of_behavior('    threaded: "false"\n'),
        "threaded must be true or false, and is 'false'",
    ),
    "a bad choice": (
        of_behavior("    hyperparameters:\n      learning_rate_schedule: cosine\n"),
        "line 5: behaviors.Ball.hyperparameters.learning_rate_schedule: cosine does not exist",
    ),
    "sac": (
        "behaviors:\n  Ball:\n    trainer_type: sac\n    hyperparameters: {tau: 0.005}\n",
        "line 3: behaviors.Ball.trainer_type: sac is not supported",
    ),
    "twice": (
        of_behavior("    max_steps: 5\n    max_steps: 6\n"),
        "line 5: max_steps is given twice, first in",
    ),
    "empty": (of_behavior("    hyperparameters:\n"), "line 4: behaviors.Ball.hyperparameters is empty"),
    "no demo": (of_behavior("    reward_signals: {gail: {strength: 1}}\n"), "needs demo_path"),
    "out of range": (
        of_behavior("    hyperparameters:\n      epsilon: 2\n"),
        "line 5: behaviors.Ball.hyperparameters.epsilon: ppo.clip_epsilon=2.0 is out of range",
    ),
    "out of range in one of two": (
        "behaviors:\n  A: {trainer_type: ppo}\n  B:\n    hyperparameters:\n      lambd: 2\n",
        "line 5: behaviors.B.hyperparameters.lambd: behaviors.B.ppo: ppo.gae_lambda=2.0 is out of range",
    ),
    "out of range behind a dot": (
        "behaviors:\n  A: {trainer_type: ppo}\n  B.c:\n    hyperparameters:\n      lambd: 2\n",
        "line 5: behaviors.B.c.hyperparameters.lambd: behaviors.B.c.ppo: ppo.gae_lambda=2.0 is out of",
    ),
    "a sampler's key": (
        of_behavior("environment_parameters:\n  mass:\n    sampler_type: uniform\n    sampler_parameters:\n")
        + "      minvalue: 1\n",
        "line 8: environment_parameters.mass.minvalue: there is no such key",
    ),
    "an unknown section": (
        of_behavior("enviroment_parameters: {}\n"),
        "line 4: enviroment_parameters is no section",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_with_file_line_and_key(tmp_path, monkeypatch, capsys, name):
    monkeypatch.chdir(tmp_path)
    text, said = MISTAKES[name]
    Path("my.yaml").write_text(text)
    assert learn_main(["my.yaml", "--env=scene:3DBall", "--seed=1"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("mappo-learn: my.yaml, line ") and error.count("\n") == 1
    assert said in error and os.listdir() == ["my.yaml"]


@pytest.mark.parametrize(
    "flags, said",
    [
        (["none.yaml"], "none.yaml: there is no such file"),
        (["--bogus"], "unrecognized arguments: --bogus"),
        (["--num-envs=two"], "--num-envs: invalid int value"),
        (["--num-envs=2"], "--num-envs: more than one needs --env=PATH"),
        (["--env=scene:4DBall"], "--env: there is no embedded scene '4DBall'"),
        (["--torch-device=tpu"], "--torch-device: tpu is not supported"),
        (["--env=scene:3DBall", "ppo.epochs=0"], "mappo-learn: ppo.epochs=0 is out of range"),
        (["--run-id=a/b"], "--run-id=a/b must be the name of a folder"),
        (["--resume", "--run-id=none"], "no run to resume in results/none"),
        (["--env=scene:3DBall", "hydra.run.dir=x"], "hydra.run.dir does not go with mappo-learn, whose flag"),
        (["--env=scene:3DBall", "output_dir=x"], "output_dir does not go with mappo-learn"),
        (["--run-id=none", "resume=x"], "resume does not go with mappo-learn, whose flag is --resume"),
        (["--run-id=a", "--initialize-from=a/b"], "--initialize-from=a/b must be the name of a folder"),
        (["--run-id=a/b", "--env-args", "--help", "-h", "--version"], "--run-id=a/b must be the name"),
        (["--env-args=foo"], "--env-args is written --env-args WORD ..."),
        (["--run-id=none", "--inference"], "no run to play in results/none: give the --run-id of one"),
    ],
)
def test_mistakes_of_the_command_line(tmp_path, monkeypatch, capsys, flags, said):
    monkeypatch.chdir(tmp_path)
    assert learn_main(flags) == 2
    assert said in capsys.readouterr().err and os.listdir() == []


# --- a run


SMALL = [
    *("--env=scene:3DBall", "collect.batch_size=240", "max_steps=480", "env.num_areas=4"),
    *("model.hidden=[8]", "log.summary_freq=240"),
]


def points(folder):
    events = EventAccumulator(str(folder)).Reload()
    return {tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with my.yaml and a trained run, results/first; tests that write take a copy."""
    folder = tmp_path_factory.mktemp("learn")
    (folder / "my.yaml").write_text(BALL)
    before = os.getcwd()
    os.chdir(folder)
    try:
        assert learn_main(["my.yaml", "--run-id=first", "--seed=5", *SMALL]) == 0
    finally:
        os.chdir(before)
    return folder


def test_the_results_lie_where_mlagents_has_them(trained):
    run = trained / "results" / "first"
    assert (run / "3DBall.onnx").read_bytes() == (run / "checkpoints" / "final.onnx").read_bytes()
    assert (run / "3DBall" / "3DBall-480.onnx").is_file()
    configuration = yaml.safe_load((run / "configuration.yaml").read_text())
    ball = configuration["behaviors"]["3DBall"]
    assert ball["hyperparameters"]["beta_schedule"] == "linear" and ball["self_play"] is None
    assert ball["reward_signals"]["extrinsic"]["gamma"] == 0.99 and "rnd" not in ball["reward_signals"]
    assert configuration["env_settings"]["seed"] == 5
    assert configuration["checkpoint_settings"]["run_id"] == "first"
    status = yaml.safe_load((run / "run_logs" / "training_status.json").read_text())
    assert status["3DBall"]["final_checkpoint"]["steps"] == 480


def test_curves_have_mlagents_tags_and_steps(trained):
    run = trained / "results" / "first"
    found = points(run / "3DBall")
    rows = read_metrics(run / "metrics.csv")
    assert [step for step, _ in found["Policy/Entropy"]] == [240, 480]
    for tag, name in (
        ("Policy/Entropy", "entropy"),
        ("Policy/Learning Rate", "lr"),
        ("Losses/Value Loss", "value_loss"),
    ):
        assert [value for _, value in found[tag]] == pytest.approx([row[name] for row in rows])
    returns = [row["return_mean"] for row in rows]
    assert [value for _, value in found["Environment/Cumulative Reward"]] == pytest.approx(returns)
    lengths = [row["episode_length_mean"] - 1 for row in rows]
    assert [value for _, value in found["Environment/Episode Length"]] == pytest.approx(lengths)
    assert not (run / "tensorboard").exists()


def test_a_run_is_not_overwritten_but_resumed_and_replaced(trained, tmp_path, monkeypatch, capsys):
    import shutil

    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    run = Path("results/first")
    config = (run / "config.yaml").read_bytes()

    assert learn_main(["my.yaml", "--run-id=first", *SMALL]) == 2
    assert "holds a previous run" in capsys.readouterr().err

    # a mistake that shows only when the environment is open leaves the old run
    Path("other.yaml").write_text(BALL.replace("3DBall:", "Other:"))
    assert learn_main(["other.yaml", "--run-id=first", "--force", *SMALL]) == 2
    error = capsys.readouterr().err
    assert "other.yaml, line 3: behaviors.Other: the environment has no behavior 'Other'" in error
    assert (run / "config.yaml").read_bytes() == config

    # what a new run would begin with is no matter to one that goes on; nor is its environment named again
    Path("my.yaml").write_text(BALL + "    init_path: results/first/3DBall.onnx\n")
    assert learn_main(["my.yaml", "--run-id=first", "--resume", *SMALL[1:], "max_steps=720"]) == 0
    assert [row["agent_steps"] for row in read_metrics(run / "metrics.csv")] == [240, 480, 720]
    assert [step for step, _ in points(run / "3DBall")["Policy/Entropy"]] == [240, 480, 720]
    assert (run / "3DBall" / "3DBall-720.onnx").is_file()

    Path("my.yaml").write_text(BALL)
    assert learn_main(["my.yaml", "--run-id=first", "--force", "--seed=6", *SMALL, "max_steps=240"]) == 0
    assert [row["agent_steps"] for row in read_metrics(run / "metrics.csv")] == [240]
    assert os.listdir("results") == ["first"]


def test_a_run_that_was_broken_off_at_its_very_end_is_published_by_resuming_it(
    trained, tmp_path, monkeypatch, capsys
):
    import shutil

    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    run, resume = Path("results/first"), ["my.yaml", "--run-id=first", "--resume", *SMALL[1:]]
    final = run / "checkpoints" / "final.onnx"
    played = final.read_bytes()

    assert learn_main(resume) == 0
    out = capsys.readouterr().out
    assert "nothing to train, and nothing was changed" in out and "policy:" not in out

    # killed between the last checkpoint and the files
    final.unlink()
    (run / "3DBall.onnx").write_bytes(b"an older one")
    (run / "run_logs" / "training_status.json").unlink()
    assert learn_main(resume) == 0
    out = capsys.readouterr().out
    assert "nothing to train, and its last ONNX files, which were missing, were written" in out
    assert f"policy: {run / '3DBall.onnx'}" in out
    assert final.read_bytes() == played == (run / "3DBall.onnx").read_bytes()
    status = yaml.safe_load((run / "run_logs" / "training_status.json").read_text())
    assert status["3DBall"]["final_checkpoint"]["steps"] == 480

    # killed between the checkpoints' files and those of ML-Agents
    (run / "3DBall.onnx").unlink()
    assert learn_main(resume) == 0
    out = capsys.readouterr().out
    assert "nothing was changed" in out and f"policy: {run / '3DBall.onnx'}" in out
    assert (run / "3DBall.onnx").read_bytes() == played


def test_what_a_resumed_run_keeps_is_told(trained, tmp_path, monkeypatch, capsys):
    import shutil

    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    resume = ["my.yaml", "--run-id=first", "--resume"]
    for place in ("scene:Basic", "builds/Game"):
        assert learn_main([*resume, f"--env={place}"]) == 2
        error = capsys.readouterr().err
        assert "--env: the run in results/first was trained in the embedded scene 3DBall and goes on" in error
        assert "there: --env=scene:3DBall, or start a run" in error

    # more players than the Editor has are of no account where the run is in no Editor
    Path("my.yaml").write_text(BALL + "env_settings: {num_envs: 4}\n")
    options = [*SMALL[1:3], "model.hidden=[8]", "max_steps=720"]
    assert learn_main([*resume, "--seed=7", "--num-envs=2", "seed=8", *options]) == 0
    assert (
        "--seed, --num-envs, seed=8: without effect, a resumed run keeps its own" in capsys.readouterr().err
    )
    assert learn_main(["my.yaml", "--run-id=first", "--inference", "env.params.mass=2"]) == 0
    assert "env.params.mass=2: without effect, --inference plays what" in capsys.readouterr().err


def test_a_run_of_the_editor_goes_on_in_a_build(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path("results/first")
    folder.mkdir(parents=True)
    Path("my.yaml").write_text(BALL)

    for place, moves in (("env.backend=editor", True), ("env.file_name=builds/Old", False)):
        saved = compose_config(["env=unity", place]).config
        monkeypatch.setattr("mappo_unity.config.compose.load_config", lambda path, saved=saved: saved)
        settings = read_settings(parse_flags(["my.yaml", "--run-id=first", "--resume", "--env=builds/Game"]))
        lines = learn._run_lines(settings, translate(settings).lines, [], folder, resume=True)
        assert ("env.backend=player" in lines) == moves
        assert any(line.startswith("env.file_name=") and "builds/Game" in line for line in lines)


def test_a_replacement_that_was_killed_at_once_costs_no_run(tmp_path):
    run = tmp_path / "first"
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "step_240.pt").write_text("good")
    (run / "config.yaml").write_text("")

    # SIGKILL before the first checkpoint: the old run lies aside, with or without what was begun in its place
    for has_begun in (True, False):
        run.rename(tmp_path / ".first.replaced")
        if has_begun:
            run.mkdir()
            (run / "config.yaml").write_text("")

        results.bring_back(run)
        with pytest.raises(ConfigError), results.replaced(run, force=True):
            (run / "run_logs").mkdir(parents=True)
            (run / "run_logs" / "Player-0.log").write_text(f"crashed {has_begun}")
            raise ConfigError("a mistake that shows only now")
        assert (run / "run_logs" / "Player-0.log").read_text() == f"crashed {has_begun}"
        assert (run / "checkpoints" / "step_240.pt").read_text() == "good"
        assert os.listdir(tmp_path) == ["first"]


@pytest.mark.parametrize(
    "text", ["behaviors: \x00", "checkpoint_settings: {run_id: 2026-02-30}", "behaviors: &a {x: *a}"]
)
def test_a_file_that_yaml_cannot_make_anything_of_is_told(tmp_path, monkeypatch, capsys, text):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text(text)
    assert learn_main(["my.yaml"]) == 2
    assert "my.yaml" in capsys.readouterr().err and os.listdir() == ["my.yaml"]


def test_a_first_start_that_failed_blocks_no_name(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text(BALL)
    lines = ["my.yaml", "--run-id=first", "--seed=5", *SMALL]

    def fail(cfg, folder, *more):
        log = folder / "run_logs" / "Player-0.log"
        log.parent.mkdir()
        log.write_text("a player's words")
        raise ConfigError(f"the player ended; its log: {log}")

    with monkeypatch.context() as patch:
        patch.setattr("mappo_unity.training.trainer.train", fail)
        assert learn_main(lines) == 2
    assert Path("results/first/run_logs/Player-0.log").is_file(), "the message names it"
    assert learn_main(lines) == 0, capsys.readouterr().err
    assert Path("results/first/3DBall.onnx").is_file()


def test_a_behavior_of_two_words_has_its_file(tmp_path):
    checkpoint = tmp_path / "checkpoints" / "step_40.pt"
    checkpoint.parent.mkdir()
    for stem in ("My_Behavior", "Other"):
        checkpoint.with_name(f"final_{stem}.onnx").write_text(stem)

    written = results.publish(tmp_path, checkpoint, ["My Behavior", "Other"], 1.0, 40)
    assert [path.name for path in written] == ["My Behavior.onnx", "Other.onnx"]
    assert (tmp_path / "My Behavior" / "My Behavior-40.onnx").read_text() == "My_Behavior"
    status = json.loads((tmp_path / "run_logs" / "training_status.json").read_text())
    assert status["My Behavior"]["final_checkpoint"]["file_path"] == str(tmp_path / "My Behavior.onnx")


def test_another_run_begins_with_its_networks(trained, tmp_path, monkeypatch):
    import shutil

    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    flags = ["my.yaml", "--run-id=second", "--initialize-from=first", "--seed=5", *SMALL, "max_steps=240"]
    assert learn_main(flags) == 0
    saved = yaml.safe_load(Path("results/second/config.yaml").read_text())
    assert saved["init_from"] == "results/first"


def test_inference_plays_without_training(trained, monkeypatch, capsys):
    monkeypatch.chdir(trained)
    before = sorted(Path("results/first").rglob("*"))
    assert learn_main(["--run-id=first", "--inference", "--deterministic"]) == 0
    assert '"episodes": 100' in capsys.readouterr().out
    assert sorted(Path("results/first").rglob("*")) == before


def test_print_options_gives_what_mappo_train_takes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text(BALL)
    assert learn_main(["my.yaml", "--env=scene:3DBall", "--seed=2", "--print-options"]) == 0
    import shlex

    lines = shlex.split(capsys.readouterr().out)
    config = compose_config(lines).config
    assert (config.seed, config.ppo.minibatch_size, config.collect.batch_size) == (2, 64, 12_000)
    assert os.listdir() == ["my.yaml"]


def test_an_environment_with_more_behaviors_is_refused_without_default_settings(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text("behaviors: {BigWallJump: {trainer_type: ppo}}\n")
    assert learn_main(["my.yaml", "--env=scene:WallJump", "--seed=1", "env.num_areas=1"]) == 2
    assert "SmallWallJump" in capsys.readouterr().err


def test_a_behavior_that_only_the_preset_names_is_one_that_the_file_does_not(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text("behaviors: {Goalie: {trainer_type: ppo}}\n")
    flags = ["my.yaml", "--env=scene:StrikersVsGoalie", "--seed=1"]
    assert learn_main(flags) == 2
    said = (
        "the environment has Striker, which the file does not name: give behaviors.Striker there, or default"
    )
    assert said in capsys.readouterr().err and os.listdir() == ["my.yaml"]

    monkeypatch.setattr(learn, "_launch", lambda *args: 0)
    assert learn_main([*flags, "behaviors.Striker.train=false"]) == 0
    assert learn_main([*flags, "only_named_behaviors=false"]) == 0
    Path("my.yaml").write_text("default_settings: {trainer_type: ppo}\n")
    assert learn_main(flags) == 0


@pytest.mark.parametrize(
    "text, flags",
    [("", ["--initialize-from=first"]), ("    init_path: results/first/3DBall.onnx\n", [])],
)
def test_a_run_that_is_replaced_is_nothing_to_begin_with(trained, tmp_path, monkeypatch, capsys, text, flags):
    monkeypatch.chdir(trained)
    before = sorted(Path("results").rglob("*"))
    file = tmp_path / "other.yaml"
    file.write_text(BALL + text)
    assert learn_main([str(file), "--run-id=first", "--force", "--seed=1", *flags, *SMALL]) == 2
    said = "lies in results/first, which the new run replaces: give another --run-id"
    assert said in capsys.readouterr().err
    assert sorted(Path("results").rglob("*")) == before


def test_initialize_from_of_the_command_line_beats_resume_of_the_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("my.yaml").write_text(BALL + "checkpoint_settings: {resume: true, initialize_from: a}\n")
    said = "initialize_from has no effect: the run is resumed"
    assert learn_main(["my.yaml", "--env=scene:3DBall", "--seed=1"]) == 2
    error = capsys.readouterr().err
    assert said in error and "no run to resume in results/ppo" in error

    assert learn_main(["my.yaml", "--env=scene:3DBall", "--seed=1", "--initialize-from=b"]) == 2
    error = capsys.readouterr().err
    assert said not in error and "--initialize-from=b: results/b holds neither a run" in error


def test_a_side_that_pauses_has_its_files_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = ["behaviors:"]
    for name in ("Goalie", "Striker"):
        lines.append(f"  {name}: {{trainer_type: ppo, self_play: {{save_steps: 100, team_change: 100}}}}")
    Path("my.yaml").write_text("\n".join(lines))
    small = [
        "env.num_areas=1",
        "collect.batch_size=100",
        "max_steps=400",
        "model.hidden=[8]",
        "matches.interval=null",
    ]
    assert learn_main(["my.yaml", "--env=scene:StrikersVsGoalie", "--run-id=two", "--seed=1", *small]) == 0

    run = Path("results/two")
    steps = read_metrics(run / "metrics.csv")
    taken = [(row["Goalie/agent_steps"], row["Striker/agent_steps"]) for row in steps]
    assert taken[0] != taken[-1] and min(taken[-1]) > 0 and sum(taken[-1]) == steps[-1]["agent_steps"]
    assert (run / "Goalie.onnx").is_file() and (run / "Striker.onnx").is_file()


# --- tags


def test_tags_of_two_behaviors_with_sides():
    row = {
        "agent_steps": 30,
        "Goalie/agent_steps": 10,
        "Striker/agent_steps": 20,
        "return_mean": 9.0,
        "Goalie?team=1/return_mean": 3.0,
        "Goalie?team=1/group_return_mean": 1.0,
        "Goalie?team=1/episode_length_mean": 5.0,
        "Striker?team=0/return_mean": -3.0,
        "policy_loss": 5.0,
        "Goalie/policy_loss": -0.25,
        "Goalie/kl": 0.5,
        "Goalie/Self-play/ELO": 1210.0,
        "lesson/wall": 2,
    }
    assert mlagents_tags(row, "Goalie", ["Goalie", "Striker"]) == {
        "Environment/Cumulative Reward": 2.0,
        "Environment/Group Cumulative Reward": 1.0,
        "Environment/Episode Length": 4.0,
        "Environment/Lesson Number/wall": 2,
        "Policy/Extrinsic Reward": 3.0,
        "Losses/Policy Loss": 0.25,
        "return_mean": 3.0,
        "group_return_mean": 1.0,
        "episode_length_mean": 5.0,
        "policy_loss": -0.25,
        "kl": 0.5,
        "Self-play/ELO": 1210.0,
    }


def test_all_official_files_are_translated_or_refused_for_sac(shared):
    files = sorted((shared / "mlagents" / "config").rglob("*.yaml"))
    assert len(files) > 20
    for path in files:
        try:
            compose_config(translate(read_settings(parse_flags([str(path)]))).lines)
        except ConfigError as error:
            assert "sac is not supported" in str(error) and path.parent.name == "sac"
        else:
            assert path.parent.name != "sac"
