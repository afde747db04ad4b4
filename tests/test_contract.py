"""Environments that break the contract: the checker names how, and so do training and evaluation."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import broken_envs
import numpy as np
import pytest
from broken_envs import AGENTS, DECISIONS, LENGTH, NAME, RAISING, RESULTS, SPECS, TERMINALS, WORDS, Crew
from fakes import vector_spec
from mlagents_envs.base_env import (
    ActionSpec,
    BaseEnv,
    BehaviorSpec,
    DecisionSteps,
    DimensionProperty,
    TerminalSteps,
)

from mappo_unity.cli import eval_main, train_main
from mappo_unity.config.schema import Backend, EnvConfig
from mappo_unity.envs import unity_env
from mappo_unity.envs.backends import make_env_function
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.policies.episodes import play
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.scenes.contract import rules as contract
from mappo_unity.scenes.contract.check import check_env, main
from mappo_unity.scenes.contract.records import RecordCheck
from mappo_unity.scenes.contract.rules import ContractError, EnvironmentDataError


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (contract, unity_env):
        monkeypatch.setattr(module, "MAX_SILENT_STEPS", 2000)
    monkeypatch.setattr("mappo_unity.policies.episodes.MAX_SILENT_STEPS", 2000)


def custom(breaks: str, **params: Any) -> EnvConfig:
    return EnvConfig(backend=Backend.custom, factory="broken_envs:make", params={"breaks": breaks, **params})


def train_some(cfg: EnvConfig) -> None:
    """Collect some rounds as training does."""
    env = UnityEnv(make_env_function(cfg))
    env.rollout(3 * LENGTH, break_when_any_done=False)
    env.close()


def test_an_environment_that_is_right_passes() -> None:
    report = check_env(Crew(), steps=30, remake=Crew)
    assert report.interrupted == report.terminals > 0
    train_some(custom(""))


@pytest.mark.parametrize("breaks", WORDS)
def test_the_checker_names_it(breaks: str) -> None:
    with pytest.raises(ContractError, match=WORDS[breaks]) as caught:
        check_env(Crew(breaks), steps=30)
    assert "\n" not in str(caught.value)
    if breaks in RAISING:
        assert any(f'File "{broken_envs.__file__}"' in line for line in caught.value.details)


def one_line(caught: Any, breaks: str) -> None:
    """Check that the message is one line, and that a user's error comes with the user's frames alone."""
    assert "\n" not in str(caught.value)
    if breaks in RAISING:
        assert str(caught.value).startswith("env.factory=broken_envs:make: its ")
        assert any(f'File "{broken_envs.__file__}"' in line for line in caught.value.details)
        assert not any("mappo_unity" in line for line in caught.value.details)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("breaks", WORDS)
def test_training_names_it(breaks: str) -> None:
    with pytest.raises((ConfigError, EnvironmentFailure), match=WORDS[breaks]) as caught:
        train_some(custom(breaks))
    one_line(caught, breaks)


@pytest.mark.parametrize("breaks", [*DECISIONS, *TERMINALS, "None", "swapped", "no mapping", *RAISING])
def test_training_names_what_is_wrong_from_the_start(breaks: str) -> None:
    with pytest.raises((ConfigError, EnvironmentFailure), match=WORDS[breaks]) as caught:
        train_some(custom(breaks, good=0))
    one_line(caught, breaks)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("breaks", [name for name in WORDS if name not in SPECS or name in RAISING])
def test_evaluation_names_it(breaks: str) -> None:
    env = make_env_function(custom(breaks))(0)
    with pytest.raises((ConfigError, EnvironmentFailure), match=WORDS[breaks]) as caught:
        play(env, RandomPolicy(0), 20)
    one_line(caught, breaks)


SENSOR, ACTION = vector_spec(3), ActionSpec(1, ())
STARTS = [
    ({}, "behavior_specs (stayed|is) empty"),
    (None, "behavior_specs is None; it must be a mapping"),
    ({"": BehaviorSpec([SENSOR], ACTION)}, "behavior_specs has a name ''; names must be texts"),
    ({"Crew?team=red": BehaviorSpec([SENSOR], ACTION)}, "what follows .team= must be a whole number"),
    (
        dict.fromkeys(["Crew?team=1", "Crew"], BehaviorSpec([SENSOR], ACTION)),
        "behaviors 'Crew' and 'Crew.team=1' share the policy 'Crew': give each a side",
    ),
    (
        dict.fromkeys(["Red crew", "red_crew?team=1"], BehaviorSpec([SENSOR], ACTION)),
        "behaviors 'Red crew' and 'red_crew' would share the file red_crew.onnx: give them names",
    ),
    ({NAME: ACTION}, "'Crew.team=0': its spec is a ActionSpec; it must be a BehaviorSpec"),
    ({NAME: BehaviorSpec([], ACTION)}, "'Crew.team=0' has no observation"),
    ({NAME: BehaviorSpec([(3,)], ACTION)}, "observation_specs is .*; it must be a list of ObservationSpec"),
    (
        {NAME: BehaviorSpec([vector_spec(0)], ACTION)},
        r"obs_0 \(vector\) has shape \(0,\); it must be a tuple",
    ),
    (
        {NAME: BehaviorSpec([SENSOR._replace(dimension_property=DimensionProperty.NONE)], ACTION)},
        r"obs_0 \(vector\) has dimension_property .*; it must be a tuple",
    ),
    ({NAME: BehaviorSpec([SENSOR], None)}, "action_spec is None; it must be an ActionSpec"),
    ({NAME: BehaviorSpec([SENSOR], ActionSpec(0, ()))}, "has no action"),
    ({NAME: BehaviorSpec([SENSOR], ActionSpec(0, (3, 0)))}, r"discrete_branches \(3, 0\) a tuple of whole"),
    ({NAME: BehaviorSpec([SENSOR], ActionSpec(1.5, ()))}, "continuous_size 1.5 must be a whole number"),
]


class Silent(Crew):
    """Shows some behaviors, and nobody in them."""

    def __init__(self, specs: Any) -> None:
        super().__init__()
        self.specs = specs

    def get_steps(self, behavior_name: str) -> Any:
        spec = self.specs[behavior_name]
        return DecisionSteps.empty(spec), TerminalSteps.empty(spec)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(("specs", "words"), STARTS)
def test_behaviors_that_nobody_can_play(specs: Any, words: str) -> None:
    with pytest.raises(ContractError, match=words):
        check_env(Silent(specs), steps=5)
    with pytest.raises(EnvironmentDataError, match=words):
        UnityEnv(lambda seed: Silent(specs))


@pytest.mark.usefixtures("impatient")
def test_an_environment_in_which_nobody_ever_asks(caplog: Any) -> None:
    specs = {NAME: BehaviorSpec([SENSOR], ACTION)}
    with pytest.raises(ContractError, match=r"reset\(\) returned without any record"):
        check_env(Silent(specs), steps=5)
    with pytest.raises(
        ConfigError, match="no behavior with an agent that requests.*of .'Crew.team=0'. in 2000 steps"
    ):
        UnityEnv(lambda seed: Silent(specs))
    with pytest.raises(ConfigError, match="no agent asked for a decision in 2000 environment steps"):
        play(Silent(specs), RandomPolicy(0), 1)
    note = (
        "no agent has requested a decision for 1000 environment steps in a row; after 2000 that is an error"
    )
    assert caplog.messages == [note, note]


def test_numbers_of_another_type_are_converted() -> None:
    env = Crew()
    env.reset()
    decision, _ = env.result
    decision.obs = [decision.obs[0].astype(np.float64), np.ones((AGENTS, 2), np.uint8)]
    decision.reward = np.array([1, 2, 3, 4])
    decision.agent_id = decision.agent_id.astype(np.uint16)
    decision.action_mask = [np.eye(AGENTS, 3, dtype=int), decision.action_mask[1]]
    terminal = TerminalSteps([], *[np.zeros(0)] * 5)  # nobody: nothing to look at
    checked, ended = RecordCheck(NAME, env.spec)([decision, terminal])
    assert [obs.dtype for obs in checked.obs] == [np.float32, np.float32]
    assert checked.reward.dtype == np.float32 and checked.reward.tolist() == [1, 2, 3, 4]
    assert checked.agent_id.tolist() == [0, 1, 2, 3]
    assert [mask.dtype for mask in checked.action_mask] == [bool, bool]
    assert checked.action_mask[0].sum() == 3 and ended is terminal


@pytest.mark.parametrize(
    ("methods", "words"),
    [
        (
            {"get_state": lambda self: {"rng": np.random.default_rng(0)}},
            r"get_state\(\)\['rng'\] is Generator, not",
        ),
        (
            {"get_state": lambda self: {"at": (1, 2)}},
            r"get_state\(\)\['at'\] is tuple, not an array of numbers or a plain",
        ),
        ({"get_state": lambda self: {"names": np.array(["a"])}}, r"\['names'\] is ndarray, not an array of"),
        ({"get_state": lambda self: {3: 4}}, "has a key 3 that is no string"),
        ({"get_state": lambda self: 1 / 0}, "its get_state raised ZeroDivisionError"),
    ],
)
def test_snapshots_that_no_checkpoint_gives_back(
    methods: dict[str, Any], words: str, monkeypatch: Any
) -> None:
    for name, method in ({"set_state": lambda self, state: None} | methods).items():
        monkeypatch.setattr(Crew, name, method, raising=False)
    with pytest.raises(ConfigError, match=words):
        train_some(custom(""))
    with pytest.raises(ContractError, match=words):
        check_env(Crew(), steps=5)


def test_a_snapshot_that_cannot_be_put_back_is_none(monkeypatch: Any) -> None:
    monkeypatch.setattr(Crew, "get_state", lambda self: {}, raising=False)
    assert UnityEnv(lambda seed: Crew()).get_state() is None
    with pytest.raises(ContractError, match="of get_state and set_state there is only one"):
        check_env(Crew(), steps=5)


# --- the commands

TINY = [
    *("env=custom", "env.name=Crew", "env.factory=broken_envs:make", "collect.rounds=4", "max_steps=40"),
    *("model.hidden=[4]", "ppo.epochs=1", "ppo.num_minibatches=1", "log.loggers=[]", "log.progress=false"),
    "export_onnx=false",
]


def command(main: Callable[[list[str]], int], lines: list[str], capfd: Any) -> tuple[int, str, str]:
    code = main(lines)
    captured = capfd.readouterr()
    return code, captured.out, captured.err


@pytest.mark.parametrize(
    ("breaks", "good", "code", "words"),
    [
        ("decision: wide observation", 8, 2, r"obs_0 \(place\) has shape \(4, 2\), not \(4, 3\)"),
        ("decision: same id twice", 0, 2, "agent 1: twice in one DecisionSteps"),
        ("reset raises", 0, 2, "env.factory=broken_envs:make: its reset raised OSError: no scene"),
        ("step raises", 8, 3, "env.factory=broken_envs:make: its step raised ZeroDivisionError: a pole"),
    ],
)
def test_mappo_train_ends_with_one_line(
    breaks: str, good: int, code: int, words: str, tmp_path: Path, capfd: Any
) -> None:
    lines = [*TINY, f"env.params.breaks='{breaks}'", f"env.params.good={good}", f"output_dir={tmp_path}"]
    got, _, err = command(train_main, lines, capfd)
    first, *frames = err.splitlines()
    assert got == code and re.search(f"^mappo-train: .*{words}", first)
    assert bool(frames) == (breaks in RAISING) and "mappo_unity" not in "".join(frames)
    if not good:
        assert not list(tmp_path.iterdir())  # nothing was trained: no folder is left


def test_a_close_that_raises_hides_nothing(tmp_path: Path, capfd: Any, caplog: Any) -> None:
    lines = [*TINY, "env.params.breaks='close raises'", f"hydra.run.dir={tmp_path}/run"]
    code, out, err = command(train_main, lines, capfd)
    assert code == 0 and "finished: 48 agent steps" in out and "Traceback" not in err
    note, *frames = caplog.messages[0].splitlines()
    assert note.endswith("its close raised OSError: the door is stuck; what was done before stands")
    assert sum(
        f'File "{broken_envs.__file__}"' in line for line in frames
    ) == 1 and "mappo_unity" not in "".join(frames)

    caplog.clear()
    code, out, err = command(eval_main, [f"run={tmp_path}/run", "episodes=4"], capfd)
    assert code == 0 and '"episodes": 4' in out and "the door is stuck" in caplog.text


def test_a_close_that_raises_does_not_hide_an_error(caplog: Any, monkeypatch: Any) -> None:
    monkeypatch.setitem(RESULTS, "close raises", RESULTS["None"])
    with pytest.raises(EnvironmentDataError, match="get_steps returned None"):
        UnityEnv(make_env_function(custom("close raises", good=0)))
    assert "the door is stuck" in caplog.text


@pytest.mark.parametrize(
    ("lines", "code", "words"),
    [
        (["env.params.breaks=None", "env.params.good=1"], 1, "get_steps returned None"),
        (["env.params.breaks='reset raises'"], 1, "Crew: its reset raised OSError: no scene"),
        (["env.params.breaks='close raises'"], 1, "Crew: its close raised OSError: the door is stuck"),
        (["env.params.size=3"], 2, "broken_envs:make cannot be called with seed and size"),
        (["breaks=None"], 2, "breaks=None is not of the form env.params.NAME=VALUE"),
        (["--num-areas", "3"], 2, "--num-areas is for scenes"),
        (["--steps", "0"], 2, "--steps 0 is out of range"),
    ],
)
def test_the_checker_s_command(lines: list[str], code: int, words: str, capfd: Any) -> None:
    got, out, err = command(main, ["broken_envs:make", "--steps", "20", *lines], capfd)
    assert got == code and not out and err.startswith("broken_envs:make: ") and words in err
    assert "mappo_unity" not in err


def make_at_random(seed: int) -> BaseEnv:
    """Return an environment that does not look at its seed."""
    env = Crew()
    env.groups = env.groups + next(COUNT)
    return env


COUNT = iter(range(1, 100))


def test_an_environment_that_cannot_repeat_itself_may_say_so(capfd: Any) -> None:
    factory = "test_contract:make_at_random"
    code, _, err = command(main, [factory, "--steps", "20"], capfd)
    assert (
        code == 1
        and "the same seed and actions give other records (first step 0, Crew?team=0: decision group_id)"
        in err
    )
    code, out, _ = command(main, [factory, "--steps", "20", "--any-seed"], capfd)
    assert code == 0 and f"{factory} keeps the contract: 22 steps, 88 decisions" in out
