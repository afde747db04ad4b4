"""scripts/check_export.py: its standard errors, the bias of counting, its messages."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return __import__("check_export")


def test_the_bias_is_that_of_leaving_out_the_last_episode(script):
    """Exponential lengths of mean 5 that earn themselves, in 200 decisions: 40 episodes sum up to 195."""
    length = np.random.default_rng(0).exponential(5.0, size=(5_000, 120))
    ended = length[length.cumsum(1) <= 200]
    assert ended.mean() == pytest.approx(195 / 40, rel=0.005)
    assert script.counting_bias(ended, ended, agents=5_000) == pytest.approx(-5 / 40, rel=0.1)


def test_a_missing_run_policy_is_named(script, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["check_export.py", "run", "--run-policy", "nowhere.py"])
    assert script.main() == 2
    assert "nowhere.py; say where it lies: --run-policy PATH" in capsys.readouterr().err
