"""Options from the command line: composition, precedence, and what every mistake is told."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from mappo_unity.config import compose, presets
from mappo_unity.config.compose import check_effect, compose_config, compose_plain, load_config
from mappo_unity.config.extras import install_command
from mappo_unity.config.option_table import option_table
from mappo_unity.config.overrides import last_value, shell_argument
from mappo_unity.config.per_behavior import behavior_config
from mappo_unity.config.presets import conf_dir
from mappo_unity.config.schema import Activation, Config, EvalConfig, LoggerKind
from mappo_unity.errors import ConfigError
from mappo_unity.runs.folder import CONFIG, write_record
from mappo_unity.runs.options import compose_resumed
from mappo_unity.scenes.factory import check_factory

FILES = sorted(
    path.relative_to(conf_dir()).as_posix()
    for path in conf_dir().rglob("*.yaml")
    if path.parent.name != "search"  # spaces, which test_search.py reads
)
FACTORY = "env.factory=test_compose:make_nothing"


def make_nothing(seed: int) -> None:
    """Stand for a factory of the user's."""


NOT_A_FUNCTION = 3


@pytest.fixture
def own_conf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Give a copy of conf/ that a test may add presets to."""
    copy = tmp_path / "conf"
    shutil.copytree(conf_dir(), copy)
    monkeypatch.setattr(compose, "conf_dir", lambda: copy)
    monkeypatch.setattr(presets, "conf_dir", lambda: copy)
    presets.group_choices.cache_clear()
    yield copy
    presets.group_choices.cache_clear()


def message_of(lines: list[str]) -> str:
    with pytest.raises(ConfigError) as caught:
        compose_config(lines)
    return str(caught.value)


@pytest.mark.parametrize("file", FILES)
def test_every_file_under_conf_composes(file: str) -> None:
    group, _, name = file.removesuffix(".yaml").rpartition("/")
    lines = [f"{group}={name}"] if group else []
    if group.startswith("official/"):  # chosen by the recipe and the env together
        lines = [f"recipe={group.removeprefix('official/')}", f"env={name}"]
    if name == "unity":
        lines.append("env.file_name=Game")
    if name in ("custom", "pettingzoo"):
        lines.append(FACTORY)
    config = compose_config(lines).config
    assert isinstance(config, Config)
    if group == "env":
        assert config.env.name == name


def test_later_sources_win(own_conf: Path) -> None:
    head = "# @package _global_\n"
    (own_conf / "env" / "Fast.yaml").write_text(
        head + "env: {name: Fast}\nppo: {gamma: 0.91, epochs: 11, lr: 0.011}\n"
    )
    (own_conf / "recipe").mkdir(exist_ok=True)
    (own_conf / "recipe" / "hot.yaml").write_text(head + "ppo: {epochs: 22, lr: 0.022}\n")
    config = compose_config(["ppo.lr=0.033", "recipe=hot", "env=Fast"]).config
    assert config.ppo.gae_lambda == Config().ppo.gae_lambda  # the dataclass
    assert config.ppo.gamma == 0.91  # the env preset
    assert config.ppo.epochs == 22  # the recipe
    assert config.ppo.lr == 0.033  # the command line


def test_values_arrive_with_their_types() -> None:
    config = compose_config(
        ["model.hidden=[32,16]", "model.activation=relu", "log.loggers=[csv,wandb]", "stop_at_return=95"]
    ).config
    assert config.model.hidden == [32, 16]
    assert config.model.activation is Activation.relu
    assert config.log.loggers == [LoggerKind.csv, LoggerKind.wandb]
    assert config.stop_at_return == 95.0 and isinstance(config.stop_at_return, float)


def test_env_params_take_new_names_without_a_plus() -> None:
    config = compose_config(
        ["env.params.mass=2", "env.params.wind={x: 1, y: [0.5]}", "+env.params.z=a"]
    ).config
    assert config.env.params == {"mass": 2, "wind": {"x": 1, "y": [0.5]}, "z": "a"}


def test_behaviors_may_have_any_name() -> None:
    config = compose_config(
        [
            "behaviors.3DBall.ppo.lr=1e-4",
            "behaviors.3DBall.ppo.gamma=0.9",
            "behaviors.3DBall.model.hidden=[8,4]",
            "++behaviors.3DBall.ppo.lr=2e-4",
            "behaviors.3D-Ball.ppo={lr: 3e-4}",
            "behaviors.My Ball.ppo.optimizer='adamw'",
            "behaviors.Goalie.ppo.lr=0.1",
        ]
    ).config
    assert config.behaviors == {
        "3DBall": {"ppo": {"lr": 2e-4, "gamma": 0.9}, "model": {"hidden": [8, 4]}},
        "3D-Ball": {"ppo": {"lr": 3e-4}},
        "My Ball": {"ppo": {"optimizer": "adamw"}},
        "Goalie": {"ppo": {"lr": 0.1}},
    }
    model, ppo, *_ = behavior_config(config, "3DBall")
    assert (model.hidden, ppo.lr, ppo.gamma) == ([8, 4], 2e-4, 0.9)


@pytest.mark.parametrize(
    "line",
    [
        "behaviors.3DBall.ppo.time_horizon=99999999999999999999",
        "behaviors.3DBall.model.hidden=[99999999999999999999]",
        "behaviors.3DBall.model.normalize_obs=1",
    ],
)
def test_options_of_a_behavior_are_checked_as_those_of_all(line: str) -> None:
    option = line.partition("=")[0]
    with pytest.raises(ConfigError, match=re.escape(option)):
        behavior_config(compose_config(["env=3DBall", line]).config, "3DBall")


def test_run_folder_is_named_by_env_and_by_the_user() -> None:
    assert compose_config(["output_dir=there"]).run_dir.parent == Path("there/3DBall")
    assert compose_config(["hydra.run.dir=mine"]).run_dir == Path("mine")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("env=3Dball", ["env=3Dball", "does not exist", "did you mean 3DBall", "choices: 3DBall", "custom"]),
        ("env=", ["env=", "does not exist", "choices: 3DBall"]),
        ("sed=3", ["sed is not an option", "did you mean seed", "max_steps"]),
        ("lr=1", ["lr is not an option", "did you mean ppo.lr"]),
        ("search=ppo", ["search is not an option of this command", "mappo-search takes it"]),
        ("ppo.gama=0.9", ["ppo.gama", "did you mean ppo.gamma", "ppo.clip_epsilon"]),
        ("pppo.lr=1", ["pppo.lr is not an option", "did you mean ppo.lr", "ppo.*"]),
        ("+extra=1", ["extra is not an option"]),
        ("ppo={lrr: 1}", ["ppo.lrr is not an option", "did you mean ppo.lr"]),
        ("ppo=3", ["ppo=3", "section", "ppo.lr"]),
        ("~ppo.lr", ["ppo.lr cannot be deleted"]),
        ("seed=abc", ["seed=abc", "a whole number"]),
        ("seed=1.5", ["seed=1.5", "a whole number"]),
        ("seed=null", ["seed=null", "a whole number"]),
        ("max_steps=1e6", ["max_steps", "a whole number", "write 1000000"]),
        ("ppo.lr=fast", ["ppo.lr=fast", "a number", "Learning rate"]),
        ("stop_at_return=x", ["stop_at_return=x", "a number or null"]),
        ("log.progress=7", ["log.progress=7", "true or false"]),
        ("model.hidden=3", ["model.hidden=3", "a list of whole numbers", "[128,128]"]),
        ("model.hidden=[a]", ["model.hidden=[a]", "a list of whole numbers"]),
        ("model.activation=foo", ["model.activation=foo", "one of tanh, relu, silu, elu"]),
        ("log.loggers=[csv,tb]", ["log.loggers=[csv,tb]", "any of csv, tensorboard, wandb, mlflow"]),
        ("env.params=3", ["env.params=3", "named values"]),
        ("ppo.gamma=2", ["ppo.gamma=2", "out of range", "from 0 to 1"]),
        ("ppo.lr=nan", ["ppo.lr=nan", "must be > 0, and finite"]),
        ("ppo.lr=inf", ["ppo.lr=inf", "must be > 0, and finite"]),
        ("ppo.optimizer_eps=0", ["ppo.optimizer_eps=0.0 is out of range", "must be > 0"]),
        ("ppo.time_horizon=0", ["ppo.time_horizon=0 is out of range", "must be >= 1"]),
        ("ppo.obs_norm_update=step", ["ppo.obs_norm_update", "batch", "round"]),
        ("ppo.lr=-1", ["ppo.lr=-1.0 is out of range: ppo.lr must be > 0"]),
        ("max_steps=1e30", ["max_steps=1e+30 is out of range", "at most 9223372036854775807"]),
        (f"max_steps={10**400}", ["is out of range", "at most 9223372036854775807"]),
        ("model.hidden=[100000000000000000000]", ["model.hidden=[100000000000000000000] is out of range"]),
        ("stop_at_return=inf", ["stop_at_return=inf", "finite"]),
        ("model.hidden=[]", ["model.hidden=[]", "at least one width"]),
        ("seed=-1", ["seed=-1", "from 0 to 2147483647"]),
        ("device=tpu", ["device='tpu'", "cpu, cuda, cuda:N"]),
        ("env.name=../up", ["env.name='../up'", "letters, digits"]),
        ("env=custom", ["env.factory is not given", "package.module:function"]),
        ("env.factory=a.b", ["env.factory='a.b'", "package.module:function"]),
        ("seed", ["seed has no value", "seed=value"]),
        ("3dball", ["3dball has no value", "did you mean env=3DBall?"]),
        ("mappo_paper", ["did you mean recipe=mappo_paper?"]),
        (str(Path(__file__).parent), [f"did you mean resume={Path(__file__).parent}?"]),
        ("a b=3", ["'a b=3'", "option=value"]),
        ("--cfg", ["--cfg is not an option", "option=value", "--help"]),
        (
            "behaviors.3DBall.ppo.lr",
            ["behaviors.3DBall.ppo.lr has no value", "behaviors.3DBall.ppo.lr=value"],
        ),
        ("behaviors.3DBall.ppo.lr=[1,", ["behaviors.3DBall.ppo.lr=[1, cannot be read"]),
        ("behaviors.3DBall.ppo.lr=1,2", ["several values", "mappo-train -m behaviors.3DBall.ppo.lr=1,2"]),
        ("behaviors.3DBall.ppo.lr=interval(1,2)", ["interval is not taken", "give values"]),
        ("ppo.lr=[1,", ["ppo.lr=[1,", "cannot be read", "in quotes"]),
        ("seed=1,2", ["seed=1,2", "needs -m"]),
        ("ppo.lr=${nothing}", ["ppo.lr", "nothing", "not found"]),
        ("hydra/launcher=nope", ["hydra/launcher/nope", "joblib", "basic"]),
        ("hydra.nope=1", ["hydra.nope"]),
    ],
)
def test_a_mistake_is_told(line: str, words: list[str]) -> None:
    message = message_of([line])
    for word in words:
        assert word in message
    assert "Traceback" not in message and "full stack trace" not in message


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            ["env.file_name=Game"],
            ["env.file_name=Game has no effect", "embedded", "needs env.backend=player"],
        ),
        ([FACTORY], [f"{FACTORY} has no effect", "needs env.backend=custom"]),
        (["env.registry_entry=Game"], ["env.registry_entry=Game", "needs env.backend=registry"]),
        (["env.no_graphics=true"], ["env.no_graphics=true", "needs env.backend=player or registry"]),
        (["env.time_scale=1"], ["env.time_scale=1.0", "env.backend=player, editor or registry"]),
        (["env=unity", "env.file_name=Game", "env.port=5005"], ["env.port=5005", "needs env.backend=editor"]),
        (["env=unity", "env.file_name=Game", "env.backend=editor"], ["env.file_name=Game", "backend=editor"]),
        (["env=custom", FACTORY, "env.num_areas=3"], ["env.num_areas=3", "custom", "env.params.NAME"]),
    ],
)
def test_an_option_without_effect_is_told(lines: list[str], words: list[str]) -> None:
    config = compose_config(lines).config
    with pytest.raises(ConfigError) as caught:
        check_effect(lines, [config])
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    "lines",
    [
        ["env.num_areas=3", "env.params.mass=2", "env.max_teams=2", "env.port=null", "ppo.lr=1"],
        ["env=unity", "env.file_name=Game", "env.no_graphics=true", "env.num_players=2", "env.time_scale=1"],
        ["env=unity", "env.backend=editor", "env.port=5005", "env.timeout_s=600", "env.quality_level=1"],
        ["env=unity", "env.backend=registry", "env.registry=a.yaml", "env.registry_entry=Game"],
        ["env=custom", FACTORY, "env.params.size=3"],
    ],
)
def test_an_option_of_the_chosen_backend_is_taken(lines: list[str]) -> None:
    check_effect(lines, [compose_config(lines).config])


def test_an_option_without_effect_is_refused_when_a_run_goes_on(tmp_path: Path) -> None:
    write_record(tmp_path, compose_config([]).config, [])
    with pytest.raises(ConfigError, match="env.file_name=Game has no effect"):
        compose_resumed([f"resume={tmp_path}", "env.file_name=Game"], tmp_path / CONFIG)


@pytest.mark.parametrize(
    ("factory", "words"),
    [
        ("no_such_module:f", ["no_such_module cannot be imported", "No module named"]),
        ("test_compose:make_nothin", ["has no function 'make_nothin'", "did you mean make_nothing"]),
        ("test_compose:NOT_A_FUNCTION", ["is an int", "must be a function that returns a BaseEnv"]),
    ],
)
def test_a_wrong_factory_is_told(factory: str, words: list[str]) -> None:
    config = compose_config(["env=custom", f"env.factory={factory}"]).config
    with pytest.raises(ConfigError) as caught:
        check_factory(config.env)
    for word in (f"env.factory={factory}", *words):
        assert word in str(caught.value)


def test_a_factory_of_the_working_directory_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_own_simulator.py").write_text("def make(seed):\n    pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))  # what is added goes afterwards
    check_factory(compose_config(["env=custom", "env.factory=my_own_simulator:make"]).config.env)


def test_a_missing_sweep_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    from mappo_unity.config import overrides

    monkeypatch.setattr(overrides, "is_installed", lambda module: False)
    for line, package, extra in (
        ("hydra/launcher=joblib", "hydra-joblib-launcher", "sweep"),
        ("hydra/launcher=submitit_slurm", "hydra-submitit-launcher", "slurm"),
    ):
        message = message_of([line])
        assert package in message and install_command(extra) in message


def test_a_run_goes_on_with_its_own_options(tmp_path: Path) -> None:
    lines = ["env.params.mass=2", "model.hidden=[8]", "max_steps=50", "log.loggers=[csv]"]
    config = compose_config(lines).config
    write_record(tmp_path, config, lines)
    assert load_config(tmp_path / CONFIG) == config
    resumed = compose_resumed(
        [f"resume={tmp_path}", "max_steps=70", "env=3DBall", "env.params.wind=1"], tmp_path / CONFIG
    )
    assert (resumed.max_steps, resumed.model.hidden) == (70, [8])
    assert resumed.env.params == {"mass": 2, "wind": 1}
    assert resumed.env.num_areas == config.env.num_areas


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("env=custom", ["env=custom", "env=3DBall"]),
        ("env.name=Other", ["env.name cannot change with resume"]),
        ("output_dir=x", ["output_dir cannot change with resume"]),
        ("ppo.gamma=3", ["ppo.gamma=3", "from 0 to 1"]),
        ("ppo.gama=1", ["did you mean ppo.gamma"]),
    ],
)
def test_a_mistake_in_going_on_is_told(line: str, words: list[str], tmp_path: Path) -> None:
    write_record(tmp_path, compose_config([]).config, [])
    with pytest.raises(ConfigError) as caught:
        compose_resumed([f"resume={tmp_path}", line], tmp_path / CONFIG)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: "", ["holds no options"]),
        (lambda text: "# nothing", ["holds no options"]),
        (lambda text: "- 1", ["holds no options"]),
        (lambda text: "a: [", ["cannot be read"]),
        (lambda text: text[: len(text) // 2].rpartition("\n")[0], ["is not complete: output_dir missing"]),
        (lambda text: text.replace("seed: 0", "seed: x"), ["seed=x does not fit", "a whole number"]),
        (lambda text: text.replace("seed: 0", "seed: -1"), ["seed=-1 is out of range"]),
        (lambda text: text.replace("gamma: 0.99", "gamma: [1]"), ["ppo.gamma=[1]", "must be a number"]),
        (lambda text: text.replace("seed: 0", "sed: 0"), ["sed is not an option (did you mean seed?)"]),
        (lambda text: text + "1: 2", ["1 is not an option"]),
    ],
)
def test_a_broken_config_file_of_a_run_is_told(
    change: Callable[[str], str], words: list[str], tmp_path: Path
) -> None:
    write_record(tmp_path, compose_config([]).config, [])
    path = tmp_path / CONFIG
    path.write_text(change(path.read_text()))
    for read in (load_config, lambda file: compose_resumed([f"resume={tmp_path}", "seed=3"], file)):
        with pytest.raises(ConfigError) as caught:
            read(path)
        message = str(caught.value)
        assert message.startswith(str(path)) and "\n" not in message
        for word in words:
            assert word in message


@pytest.mark.parametrize(
    ("path", "argument"),
    [
        ("outputs/3DBall/2026-11-20_12-00-00", "resume=outputs/3DBall/2026-11-20_12-00-00"),
        ("sp ace/run", "'resume=sp ace/run'"),
        ("a=b,c (d)", """'resume="a=b,c (d)"'"""),
        ("007", "resume=007"),
        ("12", """'resume="12"'"""),
        *(
            (path, None)
            for path in ("null", "a'b", 'a"b', "a\\'b\"", "x[1]", "~/ä#$", r"C:\Users\x", "e\\", "[")
        ),
    ],
)
def test_an_argument_for_the_shell_names_the_same_path(path: str, argument: str | None) -> None:
    shown = shell_argument("resume", path)
    assert argument in (None, shown)
    (line,) = shlex.split(shown)
    assert last_value([line], "resume") == path


def test_evaluation_options() -> None:
    options = compose_plain(["run=there", "episodes=7", "deterministic=true"], EvalConfig)
    assert (options.run, options.episodes, options.deterministic, options.seed) == ("there", 7, True, 0)
    for lines, word in (
        (["episodes=3"], "run is not given"),
        (["run=x", "episodes=0"], "episodes=0 is out of range"),
        (["run="], "run= is empty"),
        (["run=x", "opponent="], "opponent= is empty"),
        (["run=x", "episode=3"], "did you mean episodes"),
        (["run=x", "deterministic=2"], "true or false"),
        (["run=x", "seed=1,2"], "seed=1,2: seed takes one value; a text with a comma"),
    ):
        with pytest.raises(ConfigError, match=word):
            compose_plain(lines, EvalConfig)


@pytest.mark.parametrize("schema", [Config, EvalConfig])
def test_every_option_is_described(schema: type) -> None:
    undescribed = [key for key, option in option_table(schema).items() if not option.description]
    assert undescribed == []
