"""The Python door: the same options as the command line, no printing unless asked; the examples run."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

import mappo_unity
from mappo_unity import load_policy, make_scene, train
from mappo_unity.errors import ConfigError

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TINY = [
    *("env=3DBall", "env.num_areas=4", "collect.rounds=16", "model.hidden=[8]", "log.loggers=[]"),
    *("hydra.run.dir=run", "export_onnx=false"),
]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_train_takes_the_options_of_the_command_and_prints_nothing(capfd):
    seen = []
    outcome = train(*TINY, "max_steps=192", after_iteration=lambda state: seen.append(state.agent_steps))
    assert (outcome.status, outcome.agent_steps, seen) == ("finished", 192, [64, 128, 192])
    assert Path("run/config.yaml").is_file() and outcome.last_checkpoint.is_file()
    assert "".join(capfd.readouterr()) == ""

    resumed = train("resume=run", "max_steps=256", progress=True)
    assert resumed.agent_steps == 256
    assert "resuming from" in capfd.readouterr().out


def test_a_callback_ends_a_run():
    outcome = train(*TINY, "max_steps=100000", after_iteration=lambda state: "enough")
    assert (outcome.status, outcome.agent_steps) == ("enough", 64)


def test_mistakes_are_exceptions():
    with pytest.raises(ConfigError, match="ppo.gama"):
        train(*TINY, "ppo.gama=1")
    train(*TINY, "max_steps=64")
    with pytest.raises(ConfigError, match="nothing to train, and nothing was changed"):
        train("resume=run")
    with pytest.raises(ConfigError, match="nowhere does not exist"):
        load_policy("nowhere")
    with pytest.raises(AttributeError, match="has no attribute 'trane'"):
        mappo_unity.trane  # noqa: B018


def test_the_package_alone_imports_nothing_heavy():
    code = "import sys, mappo_unity; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=EXAMPLES.parent).returncode == 0


def test_a_policy_acts_for_the_agents_of_a_scene():
    train(*TINY, "max_steps=64")
    policy, env = load_policy("run"), make_scene("3DBall", num_areas=3)
    env.reset()
    name = next(iter(env.behavior_specs))
    decision, _ = env.get_steps(name)
    action = policy.act(name, decision, env.behavior_specs[name])
    assert action.continuous.shape == (3, 2) and abs(action.continuous).max() <= 1
    again = load_policy("run").act(name, decision, env.behavior_specs[name])
    assert (again.continuous == action.continuous).all()


def test_the_example_that_trains(capsys):
    example("train_3dball").main([*TINY, "max_steps=128"])
    out = capsys.readouterr().out
    assert "128 steps  mean return" in out and "finished: mean return" in out


def test_the_example_that_plays(capsys):
    train(*TINY, "max_steps=64")
    trained, random = (example("play_policy").main("3DBall", where, 12) for where in ("run", "random"))
    assert trained > 0 and random > 0
    assert "3DBall played by run: mean return" in capsys.readouterr().out


def test_the_example_that_plays_says_what_it_wants():
    script = [sys.executable, str(EXAMPLES / "play_policy.py"), "3DBall"]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "required: policy" in done.stderr
