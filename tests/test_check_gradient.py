"""scripts/check_gradient.py: what a critic of several streams of rewards learns further."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import check_gradient

from mappo_unity.learning.value_norm import ValueNorm


def test_more_epochs_fit_the_rewards_of_the_environment_alone(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A second stream, whose returns spread ten times as wide, has no say."""
    torch.manual_seed(0)
    norm = ValueNorm(0.5, streams=2)
    norm.update(torch.randn(10_000, 2) * torch.tensor([1.0, 10.0]))
    learner = check_gradient.Learner.__new__(check_gradient.Learner)
    learner.norm = norm
    learner.critic = SimpleNamespace(module=nn.Linear(1, 2))  # type: ignore[assignment]
    monkeypatch.setattr(check_gradient, "FIT_RATE", 0.01)

    seen = torch.randn(20_000, 1)
    # each earns what its agent saw
    episodes = [check_gradient.Episode(obs=[obs], rewards=[obs.item()]) for obs in seen]
    check_gradient.show_critic(learner, episodes, 0.99)
    last = capsys.readouterr().out.splitlines()[-1]
    assert float(last.rpartition(" ")[2]) > 0.99
