"""How torch computes: the precision of products, wherever a policy acts or learns, and compiled updates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from test_workers import SMALL, options

from mappo_unity.cli import train_main
from mappo_unity.errors import ConfigError
from mappo_unity.training.setup import set_up

LINES = ["env=3DBall", "env.num_areas=2", "collect.rounds=16", *SMALL]


def says_precision(seed: int) -> Any:
    """Instead of an environment: refuse with the precision of the process that opens it."""
    raise ValueError(f"opened with {torch.get_float32_matmul_precision()}")


@pytest.fixture(autouse=True)
def as_before() -> Any:
    before = torch.get_float32_matmul_precision()
    yield
    torch.set_float32_matmul_precision(before)


def test_a_run_sets_its_precision(tmp_path: Path) -> None:
    for precision in ("medium", "highest"):
        with set_up(options(*LINES, f"matmul_precision={precision}"), tmp_path) as setup:
            assert torch.get_float32_matmul_precision() == precision
            with setup.collecting() as batches:
                metrics = setup.learn(next(batches), 0.0)["3DBall"]
            # what acts is what learns: the first minibatch's ratios are 1
            assert metrics["kl"] == pytest.approx(0.0, abs=1e-4)
            assert torch.get_float32_matmul_precision() == precision


ELSEWHERE = [pytest.param(engine, marks=pytest.mark.slow) for engine in ("processes", "ray")]


@pytest.mark.parametrize("engine", ["local", *ELSEWHERE])
def test_workers_have_it_too(tmp_path: Path, capsys: Any, engine: str) -> None:
    if engine == "ray":
        pytest.importorskip("ray")
    lines = ["env=custom", "env.factory=test_torch_settings:says_precision", "collect.workers=1", *SMALL]
    lines += [f"collect.engine={engine}", "matmul_precision=medium", f"hydra.run.dir={tmp_path}"]
    assert train_main(lines) == 2
    assert "opened with medium" in capsys.readouterr().err


def test_another_precision_is_refused() -> None:
    with pytest.raises(ConfigError, match="matmul_precision") as error:
        options("matmul_precision=low")
    assert "highest, high, medium" in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("memory", ["none", "traces"])
def test_a_compiled_update_is_the_same_to_rounding(memory: str, tmp_path: Path) -> None:
    lines = [*LINES, "ppo.minibatch_size=16", "ppo.epochs=2", "seed=3", f"model.memory={memory}"]
    parameters = []
    for compile_ in ("false", "true"):
        with set_up(options(*lines, f"ppo.compile={compile_}"), tmp_path / compile_) as setup:
            before = [p.detach().clone() for p in setup.learners["3DBall"].params]
            with setup.collecting() as batches:
                metrics = setup.learn(next(batches), 0.0)["3DBall"]
            assert metrics["rolled_back"] == 0.0
            after = setup.learners["3DBall"].params
            assert any((p - old).abs().max() > 1e-4 for p, old in zip(after, before))
            parameters.append([p.detach().clone() for p in after])

    for plain, compiled in zip(*parameters):
        torch.testing.assert_close(compiled, plain, rtol=1e-3, atol=1e-5)


def test_memories_are_not_compiled(tmp_path: Path, capsys: Any) -> None:
    lines = ["env=Hallway", "env.num_areas=2", "ppo.compile=true", "model.memory=gru", *SMALL]
    assert train_main([*lines, f"hydra.run.dir={tmp_path}"]) == 2
    assert "ppo.compile=true does not go with the memory of 'Hallway'" in capsys.readouterr().err


def test_a_cpu_without_a_compiler_compiles_nothing(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert train_main([*LINES, "ppo.compile=true", f"hydra.run.dir={tmp_path}"]) == 2
    error = capsys.readouterr().err
    assert "there is no no-such-compiler" in error and "g++" in error
