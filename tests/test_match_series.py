"""Series of matches while a policy learns: whose random numbers they touch, and what their score is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch

from mappo_unity.config.schema import Config, EnvConfig, MatchConfig
from mappo_unity.policies.matches import Score
from mappo_unity.training import match_series
from mappo_unity.training.match_series import MatchSeries

SIDES = ["Soccer?team=0", "Soccer?team=1"]


def make_series(tmp_path: Path, device: str = "cpu") -> MatchSeries:
    cfg = Config(env=EnvConfig(name="SoccerTwos"), matches=MatchConfig(interval=10, count=64), device=device)
    return MatchSeries(cfg, tmp_path, SIDES)


@pytest.mark.parametrize(("device", "kept"), [("cpu", []), ("cuda:1", [torch.device("cuda:1")])])
def test_the_generator_that_draws_actions_is_restored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: str, kept: list[torch.device]
) -> None:
    calls = []

    @contextmanager
    def fork_rng(devices: list[torch.device]) -> Iterator[None]:
        calls.append(list(devices))
        yield

    monkeypatch.setattr(torch.random, "fork_rng", fork_rng)
    monkeypatch.setattr(torch, "manual_seed", lambda seed: calls.append(seed))
    monkeypatch.setattr(match_series, "play_matches", lambda *args: {"blue": Score(wins=1)})
    series = make_series(tmp_path, device)
    series.play(10, {}, {})
    assert calls == [kept, series._cfg.seed + 10]
