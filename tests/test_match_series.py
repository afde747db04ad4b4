"""Series of matches while a policy learns: whose random numbers they touch, and what their score is worth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
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
    series.play(series._cfg.env, 10, {}, {})
    assert calls == [kept, series._cfg.seed + 10]


def play_all(series: MatchSeries, monkeypatch: pytest.MonkeyPatch, wins: list[int]) -> list[float]:
    """Play series of 64 matches with these wins; return the score after each."""
    results = iter(wins)
    monkeypatch.setattr(
        match_series, "play_matches", lambda *args: {"blue": Score(wins=(w := next(results)), losses=64 - w)}
    )

    scores = []
    for index in range(len(wins)):
        series.play(series._cfg.env, 10 * (index + 1), {}, {})
        scores.append(series.score(10 * (index + 1)))
    return scores


def test_the_best_score_is_not_the_luckiest_series(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wins = np.random.default_rng(0).binomial(64, 0.95, 60).tolist()
    assert max(wins) / 64 > 0.98  # the best single series of a policy of strength 0.95
    best = max(play_all(make_series(tmp_path), monkeypatch, wins))
    assert 0.9 < best < 0.96


def test_a_score_is_the_lower_end_of_wilsons_interval_over_four_series(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = make_series(tmp_path)
    assert -1 < series.score(10) < series.score(20) < 0
    scores = play_all(series, monkeypatch, [64, 0, 32, 32, 32, 64])
    # 64 of 64 and 160 of 256, by an independent calculator
    assert (scores[0], scores[5]) == pytest.approx((0.9434, 0.5642), abs=1e-4)
    assert series.pool == [(32, 64), (32, 64), (32, 64), (64, 64)]


def test_scores_outlive_a_checkpoint_and_an_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series, other = make_series(tmp_path), make_series(tmp_path)
    play_all(series, monkeypatch, [40, 50])
    other.load_state_dict(series.state_dict())
    assert other.score(0) == series.score(0) and other.comparable(0.7, series.state_dict()) == 0.7

    # before, a checkpoint held the share of one series, and the best score was the best of these
    old: dict[str, Any] = {"played_at": 10, "points": 1.0}
    other.load_state_dict(old)
    assert other.score(0) == other.comparable(1.0, old) == pytest.approx(0.9434, abs=1e-4)
    assert other.comparable(-0.5, old) == -0.5
    other.load_state_dict(old | {"points": None})
    assert other.score(0) == -1
