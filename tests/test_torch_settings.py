"""The precision of matrix products: set wherever a policy acts or learns, and taken back by the next run."""

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
