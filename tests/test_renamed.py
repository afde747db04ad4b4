"""Options that had another name: the old one keeps working on the command line, in files and in runs."""

import pytest
from omegaconf import OmegaConf

from mappo_unity.cli import learn_main, train_main
from mappo_unity.config.compose import compose_config, load_config
from mappo_unity.config.renamed import rename_keys, rename_lines
from mappo_unity.config.schema import Activation, CriticKind, LoggerKind, MirrorConfig, ModelConfig
from mappo_unity.policies.policy import model_from_saved
from mappo_unity.training.resume_check import check_compatible, describe_models

TINY = [
    *("env=3DBall", "env.num_areas=4", "collect.rounds=16", "model.hidden=[8]", "max_steps=64"),
    *("export_onnx=false", "hydra.run.dir=run"),
]


def test_lines_and_keys():
    notes = []
    assert rename_lines(["log.backends=[csv]", "++log.backends=[]", "seed=1"], notes.append) == [
        *("log.loggers=[csv]", "++log.loggers=[]", "seed=1"),
    ]
    assert notes == 2 * ["note: log.backends is called log.loggers now"]
    assert rename_keys({"log": {"backends": ["csv"], "project": "p"}, "seed": 1}) == {
        "log": {"loggers": ["csv"], "project": "p"},
        "seed": 1,
    }
    assert rename_keys({"seed": 1, "log.backends": ["csv"]}) == {"log.loggers": ["csv"], "seed": 1}
    assert rename_keys({"log.loggers": [], "log.backends": ["csv"]}) == {"log.loggers": []}


def test_the_old_name_keeps_working_with_a_note(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert train_main([*TINY, "log.backends=[csv]"]) == 0
    assert "mappo-train: note: log.backends is called log.loggers now" in capfd.readouterr().err
    assert load_config(tmp_path / "run/config.yaml").log.loggers == [LoggerKind.csv]

    # a run of an older version
    saved = OmegaConf.load("run/config.yaml")
    saved.log.backends = saved.log.pop("loggers")
    OmegaConf.save(saved, "run/config.yaml")
    assert load_config(tmp_path / "run/config.yaml").log.loggers == [LoggerKind.csv]
    assert train_main(["resume=run", "max_steps=128"]) == 0


def test_the_old_name_in_a_file_of_options(tmp_path):
    for text in (
        "log: {backends: [csv]}",
        "log.backends: [csv]",
        "{log.backends: [], log: {loggers: [csv]}}",
    ):
        (tmp_path / "my.yaml").write_text(text)
        config = compose_config([], file=tmp_path / "my.yaml").config
        assert config.log.loggers == [LoggerKind.csv], text


def test_mappo_learn_takes_the_old_name_with_a_note(capsys):
    assert learn_main(["--env=scene:3DBall", "--print-options", "log.backends=[csv]"]) == 0
    captured = capsys.readouterr()
    assert "mappo-learn: note: log.backends is called log.loggers now" in captured.err
    assert "log.loggers=[csv]" in captured.out.replace("'", "")


def test_a_checkpoint_that_does_not_know_a_model_option_yet_has_its_default(tmp_path):
    saved = {"hidden": [8], "critic": "local", "activation": "relu"}
    wanted = ModelConfig(hidden=[8], critic=CriticKind.local, activation=Activation.relu)
    assert model_from_saved(saved) == wanted
    state = {"env_name": "X", "layout": {}, "model": {"P": {"hidden": [8]}}}
    check_compatible(tmp_path, state, "X", {}, {"P": {"hidden": [8], "init_log_std": 0.0}})
    with pytest.raises(ValueError, match=r"model.init_log_std=0.0 there, 1.0 here"):
        check_compatible(tmp_path, state, "X", {}, {"P": {"hidden": [8], "init_log_std": 1.0}})


def test_so_has_an_option_within_a_group_of_them(tmp_path):
    def mirror(**options):
        return describe_models({"P": ModelConfig(mirror=MirrorConfig(swap=[0, 1, 1], **options))})

    known = mirror()
    del known["P"]["mirror"]["flip_images"]
    state = {"env_name": "X", "layout": {}, "model": known}
    check_compatible(tmp_path, state, "X", {}, mirror())
    said = r"another network: model.mirror.flip_images=false there, true here$"
    with pytest.raises(ValueError, match=said):
        check_compatible(tmp_path, state, "X", {}, mirror(flip_images=True))


def test_an_initial_deviation_beyond_todays_range_still_loads(tmp_path):
    beyond = {"env_name": "X", "layout": {}, "model": {"P": {"hidden": [8], "init_log_std": -7.0}}}
    check_compatible(tmp_path, beyond, "X", {}, {"P": {"hidden": [8], "init_log_std": -5}})
    assert model_from_saved(beyond["model"]["P"]).init_log_std == -5
