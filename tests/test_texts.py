"""Texts on the command lines: paths and names in any letters, and commands that can be pasted."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import fake_training
import pytest
import yaml

from mappo_unity.cli import eval_main, export_main, play_main, train_main
from mappo_unity.config.behavior_lines import all_to_hydra_syntax, dotted_options, to_hydra_syntax
from mappo_unity.config.compose import compose_config, compose_plain, load_config
from mappo_unity.config.overrides import last_value, parse, shell_argument
from mappo_unity.config.schema import Config, EvalConfig, ExportConfig, PlayConfig
from mappo_unity.config.text_lines import key_name, key_spelling, literal_lines
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.process import find_executable
from mappo_unity.training.sweep import run_sweep

NAMES = [
    "jürgen",
    "日本語",
    "🏆 best",
    "a b",
    "a=b",
    "a,b",
    "it's",
    'say "so"',
    """both ' and \"""",
    "x[1]{2}(3)",
    "a&b;c#d!",
    "12",
    "1e3",
    "0x10",
    "1_000",
    "true",
    "~x",
    "$HOME",
    "50%",
    "a:b",
    "interval(1,2)",
    "back\\slash",
]


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Path]:
    """Stand in for what trains; keep the folders that were trained in."""
    folders: list[Path] = []

    def train(cfg: Config, folder: Path, checkpoint: Path | None = None, *show: object) -> Any:
        folders.append(folder)
        (folder / "metrics.csv").write_text("agent_steps\n")
        return fake_training.Outcome()

    fakes = {
        "training.trainer": {"train": train, "why_over": fake_training.why_over},
        "runs.checkpoint": {"newest_good": lambda where: (where / "checkpoints" / "step_1.pt", [])},
    }
    for name, functions in fakes.items():
        module = ModuleType(f"mappo_unity.{name}")
        vars(module).update(functions)
        monkeypatch.setitem(sys.modules, f"mappo_unity.{name}", module)
    monkeypatch.chdir(tmp_path)
    return folders


def hinted_command(text: str, start: str) -> list[str]:
    """Return the words that a shell makes of the command which a line of the output names."""
    (line,) = (line for line in text.splitlines() if line.startswith(start))
    printed = subprocess.run(
        ["sh", "-c", f'printf "%s\\n" {line.partition(":")[2]}'], capture_output=True, text=True, check=True
    )
    return printed.stdout.splitlines()


# --- single lines


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("key", "schema"),
    [
        ("run", EvalConfig),
        ("opponent", EvalConfig),
        ("run", ExportConfig),
        ("out", ExportConfig),
        ("run", PlayConfig),
        ("video", PlayConfig),
    ],
)
def test_a_plain_command_takes_a_path_as_it_is(key: str, schema: type, name: str) -> None:
    lines = {"run=there": None, f"{key}={name}": None}
    if key == "run":
        del lines["run=there"]
    assert getattr(compose_plain(list(lines), schema), key) == name


@pytest.mark.parametrize("name", NAMES)
def test_a_training_takes_a_path_as_it_is(name: str) -> None:
    keys = ("env.file_name", "env.player_logs", "env.registry", "output_dir", "resume")
    lines = literal_lines([f"{key}={name}" for key in (*keys, "hydra.run.dir")], Config)
    composed = compose_config(["env=unity", *lines])
    config = composed.config
    assert [config.env.file_name, config.env.player_logs, config.env.registry] == [name] * 3
    assert [config.output_dir, config.resume, last_value(lines, "resume")] == [name] * 3
    assert composed.run_dir == Path(name)


def test_what_a_text_in_quotes_says_stays() -> None:
    lines = ['run="a b"', "run='a,b'", r"run=a\,b", "run=a/b", "run=2026-11-20_12-00-00"]
    values = [compose_plain([line], EvalConfig).run for line in lines]
    assert values == ["a b", "a,b", "a,b", "a/b", "2026-11-20_12-00-00"]
    assert compose_plain(["run=x", "env=null"], EvalConfig).env is None
    assert compose_plain(["run=x", 'env="null"'], EvalConfig).env == "null"
    (line,) = literal_lines(["output_dir=${env.name}/ü"], Config)
    assert compose_config([line]).config.output_dir == "3DBall/ü"


def test_a_text_that_is_not_utf8_is_refused() -> None:
    with pytest.raises(ConfigError, match="no UTF-8 text"):
        literal_lines(["run=/x/\udcff"], EvalConfig)


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("env.params.name=jürgen", "jürgen"),
        ("env.params.name= ü x ", "ü x"),
        ("env.params.name=a=b", "a=b"),
        ("env.params.name=[--x=3,ü,'é,è',\"a\",${env.name},1]", ["--x=3", "ü", "é,è", "a", "${env.name}", 1]),
        ("env.params.name={a: ü, b: [é], größe: {c: 1}}", {"a": "ü", "b": ["é"], "größe": {"c": 1}}),
        (r"env.params.name=ü\,x", "ü,x"),
        ("env.params.name='ü'", "ü"),
        ("env.params.name=é's", "é's"),
        ("env.params.name=-1e-3", -1e-3),
        ("env.params.größe=3", None),
    ],
)
def test_values_in_any_letters_are_read(line: str, value: Any) -> None:
    (override,) = parse([line])
    assert to_hydra_syntax(to_hydra_syntax(line)) == to_hydra_syntax(line)
    if value is None:
        assert compose_config([line]).config.env.params == {"größe": 3}
        return
    assert compose_config([line.replace("${env.name}", "3DBall")]).config.env.params["name"] == (
        [*value[:4], "3DBall", 1] if isinstance(value, list) else value
    )


def test_several_values_in_any_letters_are_several() -> None:
    (override,) = parse(["env.params.name=choice(ü,'é,è',b)"])
    assert list(override.sweep_string_iterator()) == ['"ü"', "'é,è'", "b"]
    (line,) = literal_lines(["env.file_name=/x=1/ü,/x (2)/G,/c/d"], Config, sweep=True)
    assert [item.text if hasattr(item, "text") else item for item in parse([line])[0].sweep_iterator()] == [
        "/x=1/ü",
        "/x (2)/G",
        "/c/d",
    ]
    (line,) = literal_lines(["output_dir=a,b"], Config, sweep=True)
    assert last_value([line], "output_dir") == "a,b"


@pytest.mark.parametrize("name", ["ボール", "My Ball", "Türe (2), rot", "100%", "3D-Ball", "a/b"])
def test_a_name_survives_its_spelling(name: str) -> None:
    assert key_name(key_spelling(name)) == name
    assert key_spelling(name).isascii() and key_spelling(key_spelling(name)) == key_spelling(name)


def test_behaviors_and_parameters_may_have_any_letters() -> None:
    config = compose_config(
        [
            "behaviors.ボール.ppo.lr=1e-4",
            "behaviors.ボール.ppo.gamma=0.9",
            "behaviors.Tür, rot.model.hidden=[8]",
            "env.params.größe=3",
            "env.params.wind={höhe: {x: 1}}",
            "env.params.mass=2",
        ]
    ).config
    assert config.behaviors == {
        "ボール": {"ppo": {"lr": 1e-4, "gamma": 0.9}},
        "Tür, rot": {"model": {"hidden": [8]}},
    }
    assert config.env.params == {"größe": 3, "wind": {"höhe": {"x": 1}}, "mass": 2}
    lines = all_to_hydra_syntax(["behaviors.ボール.ppo.lr=1e-4,1e-3"])
    (override,) = parse(lines)
    tables = [dotted_options(f"behaviors={text}") for text in override.sweep_string_iterator()]
    assert [list(table) for table in tables] == [["behaviors.ボール.ppo.lr"]] * 2


@pytest.mark.parametrize("line", ["größe=3", "ppo.größe=3", "~größe", "ü"])
def test_an_unknown_name_in_any_letters_is_no_option(line: str) -> None:
    with pytest.raises(ConfigError, match="größe is not an option|ü has no value"):
        compose_config([line])


@pytest.mark.parametrize("name", [*NAMES, "a${b}", "a\\${b}", "null", " x ", "", "a\nb"])
def test_a_printed_argument_names_the_same_path(name: str) -> None:
    (line,) = shlex.split(shell_argument("run", f"/r/{name}"))
    assert compose_plain([line], EvalConfig).run == f"/r/{name}"


# --- commands


@pytest.mark.parametrize("name", ["日本語 🏆", "a=b,c", "it's a${b} & $HOME"])
def test_a_run_and_its_printed_commands(
    name: str, training: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(name)
    assert train_main([f"hydra.run.dir={folder}".replace("${", r"\${")]) == 0
    assert training == [folder]
    text = capsys.readouterr().out
    command, *lines = hinted_command(text, "resume:")
    assert command == "mappo-train" and train_main(lines) == 0
    assert training == [folder] * 2
    command, line = hinted_command(text, "evaluate:")
    assert command == "mappo-eval" and compose_plain([line], EvalConfig).run == str(folder)
    assert hinted_command(text, "curves:")[2] == str(folder)
    assert load_config(folder / "config.yaml").env.name == "3DBall"


def test_a_sweep_in_a_folder_of_any_letters(training: list[Path]) -> None:
    name = "jürgen, a=b 🏆"
    assert train_main(["-m", "seed=0,1", f"hydra.sweep.dir={name}/here"]) == 0
    assert training == [Path(name, "here", job).resolve() for job in "01"]
    assert train_main(["-m", "seed=0,1", f"output_dir={name}"]) == 0
    assert training[-1].parents[2] == Path(name, "multirun").resolve()


def test_a_sweep_over_files_of_any_letters(training: list[Path]) -> None:
    for player in map(Path, ("jürgen/a", "b=2/c")):
        player.parent.mkdir()
        player.write_text("#!/bin/sh\n")
        player.chmod(0o755)
    lines = ["env=unity", "env.file_name=jürgen/a,b=2/c", "behaviors.ボール.ppo.lr=1e-3,1e-4"]
    assert train_main(["-m", *lines]) == 0
    configs = [load_config(folder / "config.yaml") for folder in training]
    assert [config.env.file_name for config in configs] == ["jürgen/a"] * 2 + ["b=2/c"] * 2
    assert [config.behaviors["ボール"]["ppo"]["lr"] for config in configs] == [1e-3, 1e-4] * 2
    (table,) = Path("outputs/multirun").rglob("results.csv")
    head, first, *_ = table.read_text(encoding="utf-8").splitlines()
    assert head.startswith("job,env,env.file_name,behaviors.ボール.ppo.lr") and "jürgen/a" in first


@pytest.mark.parametrize(
    ("main", "name", "more"),
    [
        (eval_main, "jürgen", []),
        (export_main, "a=b, (c) [d]", []),
        (play_main, "🏆's", ["video=my.gif"]),
    ],
)
def test_a_path_that_is_missing_is_named_as_it_is(
    main: Any, name: str, more: list[str], training: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert train_main(["hydra.run.dir=mine"]) == 0
    assert main([f"run=/nowhere/{name}", *more]) == 2
    message = capsys.readouterr().err
    assert f"run=/nowhere/{name} does not exist" in message and "newest runs below .: mine" in message


@pytest.mark.skipif(sys.platform != "linux", reason="a player's file has another form there")
@pytest.mark.parametrize("name", ["Game.x86_64", "Game"])
@pytest.mark.parametrize("folder", ["jürgen", "a=b, [1] (2) *", "old.x86 builds"])
def test_a_player_is_found_in_a_folder_of_any_letters(folder: str, name: str, tmp_path: Path) -> None:
    player = tmp_path / folder / name
    player.parent.mkdir()
    player.write_text("#!/bin/sh\n")
    player.chmod(0o755)
    assert find_executable(str(player)) == player
    assert find_executable(str(player.with_suffix(""))) == player


@pytest.mark.skipif(sys.platform != "linux", reason="players have other extensions there")
@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("linux.x86_64/Game.x86_64", None),
        ("linux.x86_64/Game", "linux.x86_64/Game.x86_64"),
        ("b/Game.x86", None),
        ("b/Game", None),
        ("b/Other", "b/Other.x86_64"),
        ("my.app.builds/Game", None),
        ("linux/Game.exe", "linux/Game"),  # as ML-Agents takes it
        ("b/Both.exe", "b/Both.x86_64"),  # the build for this system beside that for another one
    ],
)
def test_a_player_of_just_that_name_is_taken(name: str, found: str | None, tmp_path: Path) -> None:
    for player in (
        *("linux.x86_64/Game.x86_64", "linux/Game", "b/Game", "b/Game.x86", "b/Game.x86_64"),
        *("b/Other.x86", "b/Other.x86_64", "b/Both.exe", "b/Both.x86_64", "my.app.builds/Game"),
    ):
        path = tmp_path / player
        path.parent.mkdir(exist_ok=True)
        path.write_text("#!/bin/sh\n")
        path.chmod(0o755)
    assert find_executable(str(tmp_path / name)) == tmp_path / (found or name)


def test_an_output_in_ascii_ends_no_run(training: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    plain = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", plain)
    assert train_main(["hydra.run.dir=jürgen"]) == 0
    plain.flush()
    assert rb"j\xfcrgen" in plain.buffer.getvalue()  # type: ignore[attr-defined]


# --- recipe=none


@pytest.mark.parametrize("name", ["none", "null"])
def test_no_recipe_is_the_preset_itself(name: str, training: list[Path]) -> None:
    assert compose_config([f"recipe={name}"]).config == compose_config([]).config
    assert train_main([f"recipe={name}", "hydra.run.dir=mine", "max_steps=5"]) == 0
    assert train_main(["resume=mine", f"recipe={name}", "max_steps=6"]) == 0
    expected = yaml.safe_load(Path("mine/config.yaml").read_text())
    assert expected["max_steps"] == 6
    assert expected["ppo"]["epochs"] == compose_config([]).config.ppo.epochs


@pytest.mark.parametrize("name", ["none", "null"])
def test_a_sweep_compares_recipes_with_the_preset(name: str, training: list[Path]) -> None:
    assert train_main(["-m", f"recipe=mappo_paper,{name}"]) == 0
    epochs = [load_config(folder / "config.yaml").ppo.epochs for folder in training]
    assert epochs == [15, compose_config([]).config.ppo.epochs]
    result = run_sweep([f"recipe=choice({name},benchmarl)"])
    assert sorted(job.overrides[0] for job in result.jobs) == ["recipe=benchmarl", "recipe=none"]


def test_a_recipe_brings_its_own_options_of_the_env_when_a_run_goes_on(training: list[Path]) -> None:
    fresh = compose_config(["env=SoccerTwos", "recipe=mlagents"]).config
    assert train_main(["env=SoccerTwos", "hydra.run.dir=mine"]) == 0
    assert train_main(["resume=mine", "recipe=mlagents"]) == 0
    assert load_config(Path("mine/config.yaml")).ppo == fresh.ppo


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("hydra/launcher=null", ["hydra/launcher=null does not exist", "choices: basic, joblib"]),
        ("hydra/sweeper=[basic]", ["hydra/sweeper=[basic] does not exist", "choices: basic"]),
        ("env=null", ["env=null does not exist", "choices: 3DBall"]),
        ("+recipe=mlagents", ["recipe is chosen without signs: recipe=mlagents"]),
        ("~recipe", ["recipe is chosen without signs"]),
        ("recipe=nothing", ["recipe=nothing does not exist", "none"]),
    ],
)
def test_a_wrong_choice_is_told(line: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        compose_config([line])
    for word in words:
        assert word in str(caught.value)
