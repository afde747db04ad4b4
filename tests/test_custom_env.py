"""The example of an environment of one's own: the contract, learning, exact resume, runs played elsewhere."""

from __future__ import annotations

import csv
import importlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_train import assert_same

from mappo_unity.cli import eval_main, train_main
from mappo_unity.config.compose import compose_config
from mappo_unity.config.user_modules import folder_of
from mappo_unity.errors import ConfigError
from mappo_unity.runs import checkpoint
from mappo_unity.runs import folder as runs
from mappo_unity.runs.options import compose_resumed, config_to_play
from mappo_unity.scenes.contract.check import main as check_main
from mappo_unity.scenes.factory import load_factory
from mappo_unity.training.trainer import train

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "custom_env.py"
FACTORY = "env.factory=custom_env:make"
TINY = [
    *("env=custom", "env.name=Points", FACTORY, "env.params.num_agents=4", "collect.rounds=8"),
    *("model.hidden=[8]", "ppo.epochs=1", "ppo.num_minibatches=2", "log.loggers=[]", "log.progress=false"),
    *("export_onnx=false", "checkpoint_interval=1"),
]


def forget_the_module() -> None:
    sys.modules.pop("custom_env", None)
    importlib.invalidate_caches()


@pytest.fixture
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Go to a folder that holds the example, as a user would."""
    folder = tmp_path / "mine"
    folder.mkdir()
    shutil.copy(EXAMPLE, folder)
    monkeypatch.setattr(sys, "path", list(sys.path))  # what commands add goes afterwards
    monkeypatch.chdir(folder)
    forget_the_module()
    yield folder
    forget_the_module()


@pytest.mark.usefixtures("beside")
def test_it_keeps_the_contract(capsys: Any) -> None:
    assert check_main(["custom_env:make", "env.params.num_agents=3", "env.params.max_decisions=9"]) == 0
    out = capsys.readouterr().out
    assert "behavior Point?team=0: observations way to target (2,); actions: Continuous: 2" in out
    assert (
        "keeps the contract: 550 steps, 1,650 decisions" in out and "get_state/set_state, seed, close" in out
    )
    assert check_main(["custom_env:make", "env.params.num_agents=0"]) == 2
    assert "custom_env:make raised ValueError: num_agents=0 must be at least 1" in capsys.readouterr().err


def test_what_it_pays_and_when_it_ends(beside: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(beside)
    env: Any = importlib.import_module("custom_env").make(0, num_agents=2, max_decisions=3)
    env.reset()
    env.position, env.target = np.array([[0, 0], [0, 0.5]]), np.array([[0, 0.2], [1, 0.5]])
    env.action = np.array([[0, 1], [1, 0]])
    env.step()
    decision, terminal = env.get_steps("Point?team=0")
    assert terminal.agent_id.tolist() == [0] and not terminal.interrupted.any()
    np.testing.assert_allclose(terminal.reward, [1.1], rtol=1e-6)  # 0.1 closer, and there
    np.testing.assert_allclose(terminal.obs[0], [[0, 0.1]], rtol=1e-6)
    np.testing.assert_allclose(decision.reward, [0, 0.1], rtol=1e-6)
    env.step()
    env.step()
    decision, terminal = env.get_steps("Point?team=0")
    assert terminal.agent_id.tolist() == [1] and terminal.interrupted.all()
    assert decision.agent_id.tolist() == [0, 1]


@pytest.mark.usefixtures("beside")
def test_it_is_learnt(tmp_path: Path) -> None:
    lines = [*TINY, "env.params.num_agents=64", "collect.rounds=32", "ppo.epochs=4", "ppo.num_minibatches=8"]
    outcome = train(compose_config([*lines, "ppo.lr=3e-3", "max_steps=24000"]).config, tmp_path)
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert outcome.return_mean > float(rows[1]["return_mean"]) + 0.5


@pytest.mark.usefixtures("beside")
def test_a_resumed_run_goes_on_to_the_bit(tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    for folder, steps in ((whole, [128]), (parts, [64, 128])):
        folder.mkdir()
        for max_steps in steps:
            cfg = compose_config([*TINY, "ppo.lr_schedule=constant", f"max_steps={max_steps}"]).config
            earlier = checkpoint.checkpoints_in(folder)
            train(cfg, folder, checkpoint.newest_good(folder)[0] if earlier else None)
    states = [checkpoint.load(checkpoint.newest_good(folder)[0]) for folder in (whole, parts)]
    for name in ("learners", "env"):
        assert_same(states[0][name], states[1][name])


def test_a_run_is_played_and_resumed_in_another_folder(
    beside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    run = tmp_path / "run"
    path = list(sys.path)
    assert train_main([*TINY, "max_steps=64", f"hydra.run.dir={run}"]) == 0
    assert json.loads((run / runs.VERSIONS).read_text())["factory_folder"] == str(beside)

    def go_elsewhere() -> None:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "path", list(path))
        forget_the_module()
        capsys.readouterr()

    go_elsewhere()
    assert eval_main([f"run={run}", "episodes=3"]) == 0
    go_elsewhere()
    assert train_main([f"resume={run}", "max_steps=96"]) == 0
    assert runs.factory_folder(run) == beside
    (beside / EXAMPLE.name).unlink()
    go_elsewhere()
    assert eval_main([f"run={run}"]) == 2
    err = capsys.readouterr().err
    assert f"there is no module 'custom_env' in the working directory {tmp_path} or elsewhere" in err
    assert f"nor in {beside}, where the run {run} found it" in err and "Traceback" not in err


def test_where_a_module_was_looked_for(beside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cfg = compose_config(TINY).config
    run = tmp_path / "run"
    run.mkdir()
    monkeypatch.syspath_prepend(beside)
    runs.write_record(run, cfg, [])
    sys.path.remove(str(beside))
    config_to_play(run, None)
    assert str(beside) in sys.path
    assert load_factory("custom_env:make", FACTORY)(seed=0).num_agents == 16

    forget_the_module()
    sys.path.remove(str(beside))
    shutil.rmtree(beside)
    with pytest.raises(ConfigError, match=f"the folder {beside}, where the run {run} found it, is gone"):
        config_to_play(run, None)
    for record in ("[]", '{"factory_folder": 3}', "not json", "{}"):  # damaged, and of an older version
        (run / runs.VERSIONS).write_text(record)
        assert runs.factory_folder(run) is None
    with pytest.raises(ConfigError, match=f"the record of the run {run} does not say where it was"):
        compose_resumed([f"resume={run}"], run / runs.CONFIG)


@pytest.mark.parametrize(
    ("files", "factory", "found"),
    [
        (["game.py"], "game:make", True),
        (["pack/__init__.py", "pack/game.py"], "pack.game:make", True),
        (["pack/__init__.py"], "pack:make", True),
        (["bare/game.py"], "bare.game:make", True),
        ([], "builtins:dict", False),
        ([], "no_such_module:make", False),
    ],
)
def test_the_folder_of_a_factory(
    files: list[str], factory: str, found: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    monkeypatch.chdir(tmp_path)
    importlib.invalidate_caches()
    assert folder_of(factory) == (tmp_path if found else None)


def test_a_module_that_fails_is_not_called_absent(
    beside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mappo_unity.config.user_modules import look_in

    monkeypatch.setattr(sys, "modules", dict(sys.modules))
    (beside / "pack").mkdir()
    (beside / "pack" / "__init__.py").write_text("import not_installed\n")
    look_in(None, "pack.game:make", tmp_path)  # the import itself will tell
    with pytest.raises(ConfigError, match="no module 'pack2.game'"):
        look_in(None, "pack2.game:make", tmp_path)
