"""Options from a file (--config): over the presets, under the command line."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import fake_training
import pytest
import yaml

from mappo_unity.cli import train_main
from mappo_unity.config.compose import compose_config, load_config
from mappo_unity.config.options_file import take_file
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.training.sweep import run_sweep


@pytest.fixture(autouse=True)
def _training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    module = ModuleType("mappo_unity.training.trainer")

    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Any:
        (folder / "metrics.csv").write_text("agent_steps\n")
        return fake_training.Outcome()

    vars(module)["train"] = train
    monkeypatch.setitem(sys.modules, "mappo_unity.training.trainer", module)
    monkeypatch.chdir(tmp_path)


def compose(text: str, *lines: str) -> Config:
    """Compose a file of this text and lines on top."""
    Path("my.yaml").write_text(text, encoding="utf-8")
    return compose_config(list(lines), file=Path("my.yaml")).config


def test_a_part_of_the_options_goes_over_the_presets() -> None:
    text = "env: Basic\nppo: {lr: 2e-3}\nmodel.hidden: [16]\nbehaviors: {ボール: {ppo: {lr: 1}}}\n"
    config, preset = compose(text, "seed=3", "ppo.epochs=7"), compose_config(["env=Basic"]).config
    assert (config.ppo.lr, config.model.hidden, config.seed, config.ppo.epochs) == (2e-3, [16], 3, 7)
    assert config.env == preset.env and config.max_steps == preset.max_steps
    assert config.behaviors == {"ボール": {"ppo": {"lr": 1}}}
    assert compose(text, "ppo.lr=1").ppo.lr == 1


def test_a_parameter_of_the_file_takes_the_place_of_the_presets() -> None:
    text = "env: {name: CooperativePushBlock, params: {gravity: {sampler: uniform, min: 5, max: 15}}}"

    def gravity(*lines: str) -> Any:
        return compose(text, *lines).env.params["gravity"]

    assert gravity() == {"sampler": "uniform", "min": 5, "max": 15}
    assert gravity("env.params.gravity.max=7") == {"sampler": "uniform", "min": 5, "max": 7}
    assert gravity("recipe=mlagents") == 14.715
    Path("my.yaml").write_text(text)
    assert train_main(["-m", "seed=1,2", "hydra.sweep.dir=here", "--config", "my.yaml"]) == 0
    for job in "01":
        assert load_config(Path("here", job, "config.yaml")).env.params == {"gravity": gravity()}


def test_the_name_of_an_env_chooses_its_preset() -> None:
    assert compose("env: {name: Basic}\n") == compose_config(["env=Basic"]).config
    assert compose("env: {name: Mine}\n").env.name == "Mine"
    assert compose("env: {num_areas: 3}\n", "env=Basic").env.num_areas == 3


def test_a_recipe_of_the_file_is_below_it_and_one_of_the_command_line_above() -> None:
    text = "recipe: mlagents\nppo: {epochs: 9}\n"
    config, recipe = compose(text), compose_config(["recipe=mlagents"]).config
    assert config.ppo.epochs == 9 and config.ppo.lr == recipe.ppo.lr
    assert config.collect.batch_size == recipe.collect.batch_size == 12_000  # the recipe's own for 3DBall
    assert compose(text, "recipe=mappo_paper").ppo.epochs == 15
    assert compose(text, "recipe=none").ppo.lr == compose_config([]).config.ppo.lr
    assert compose("recipe: null\n") == compose_config([]).config


def test_a_runs_own_file_gives_the_same_run_again() -> None:
    lines = ["env=SoccerTwos", "recipe=mlagents", "env.num_areas=3", "ppo.lr=0.5", "hydra.run.dir=one"]
    assert train_main(lines) == 0
    assert train_main(["--config", "one/config.yaml", "hydra.run.dir=two"]) == 0
    assert train_main(["hydra.run.dir=three", "--config=one/config.yaml", "seed=5"]) == 0
    one, two, three = (load_config(Path(name, "config.yaml")) for name in ("one", "two", "three"))
    assert two == one and (three.seed, three.ppo) == (5, one.ppo)
    record = yaml.safe_load(Path("two/overrides.yaml").read_text())
    assert record[0]["overrides"] == ["--config=one/config.yaml", "hydra.run.dir=two"]


def test_a_sweep_takes_a_file() -> None:
    Path("my.yaml").write_text("env: {num_areas: 3}\nppo: {epochs: 9}\n")
    lines = ["env=Basic,3DBall", "ppo.lr=1,2", "hydra.sweep.dir=here"]
    assert train_main(["-m", *lines, "--config", "my.yaml"]) == 0
    configs = [load_config(Path("here", job, "config.yaml")) for job in "0123"]
    assert [(c.env.name, c.ppo.lr, c.env.num_areas, c.ppo.epochs) for c in configs] == [
        (name, lr, 3, 9) for name in ("Basic", "3DBall") for lr in (1, 2)
    ]
    assert {config.max_steps for config in configs[:2]} == {compose_config(["env=Basic"]).config.max_steps}


def test_a_sweep_of_processes_takes_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    monkeypatch.setitem(sys.modules, "mappo_unity.training.trainer", fake_training)
    Path("my.yaml").write_text("ppo: {lr: 0.5}\n")
    result = run_sweep(["hydra/launcher=joblib", "hydra.launcher.n_jobs=1", "seed=1,2"], Path("my.yaml"))
    assert [job.return_mean for job in result.jobs] == [2 - 500, 1 - 500]


@pytest.mark.parametrize(
    ("text", "lines", "words"),
    [
        ("ppo: {lrr: 1}", [], ["my.yaml: ppo.lrr is not an option", "did you mean ppo.lr"]),
        ("ppo: {lr: x}", [], ["my.yaml: ppo.lr=x does not fit", "a number"]),
        ("ppo: {gamma: 3}", [], ["ppo.gamma=3.0 is out of range"]),
        ("ppo: 3", [], ["my.yaml: ppo=3: ppo is a section"]),
        ("env: Nope", [], ["my.yaml: env=Nope does not exist", "choices: 3DBall"]),
        ("recipe: 3", [], ["my.yaml: recipe=3 does not exist", "none"]),
        ("env: {name: Basic}", ["env=3DBall"], ["env=3DBall differs from env.name=Basic in my.yaml"]),
        ("resume: there", [], ["resume belongs on the command line"]),
        ("", [], ["my.yaml holds no options"]),
        ("- a", [], ["my.yaml holds no options"]),
        ("a: [", [], ["my.yaml cannot be read"]),
        ("1: 2", [], ["my.yaml: 1 is not an option"]),
    ],
)
def test_a_mistake_in_the_file_is_told(text: str, lines: list[str], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(text, *lines)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            ["my.yaml"],
            ["my.yaml alone says nothing", "mappo-train --config my.yaml", "as mappo-learn my.yaml"],
        ),
        (["seed=1", "a b.yml"], ["mappo-train --config 'a b.yml'"]),
        (["--config"], ["--config names no file"]),
        (["--config="], ["--config names no file"]),
        (["--config", "nowhere.yaml"], ["--config nowhere.yaml", "no such file"]),
        (["--config", "a.yaml", "--config", "b.yaml"], ["--config is given 2 times"]),
        (["--config", "a.yaml", "resume=run"], ["--config and resume cannot go together"]),
    ],
)
def test_a_file_that_is_named_wrongly(
    lines: list[str], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(lines) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message


def test_the_file_may_stand_anywhere() -> None:
    assert take_file(["a=1", "--config", "x=y.yaml", "b=2"]) == (["a=1", "b=2"], Path("x=y.yaml"))
    assert take_file(["--config=jürgen/x", "b=2"]) == (["b=2"], Path("jürgen/x"))
    assert take_file(["b=2"]) == (["b=2"], None)
