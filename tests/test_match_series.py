"""Series of matches while a policy learns: whose random numbers they touch, and whom they call the best."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from mappo_unity.config.schema import Config, EnvConfig, MatchConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.league.ratings import ANCHOR, expected
from mappo_unity.policies.matches import Score
from mappo_unity.policies.policy import Policy, RandomPolicy
from mappo_unity.runs import checkpoint
from mappo_unity.training import match_series
from mappo_unity.training.match_series import MatchSeries

SIDES = ["Soccer?team=0", "Soccer?team=1"]
COUNT = 64
OF_95 = 400 * np.log10(0.95 / 0.05)  # points ahead of random, for 95 % of the matches


class Fake:
    """A policy of known strength, in points above random."""

    def __init__(self, strength: float) -> None:
        self.strength = strength


class FakeRun:
    """A run whose policies' strengths are known, and its series with simulated matches.

    Attributes: `policies`, whom it trained so far, by name; `rows`, the figures of each series.
    """

    def __init__(self, series: MatchSeries, monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
        self.series, self.rng, self.now = series, np.random.default_rng(seed), 0.0
        self.policies: dict[str, Fake] = {}
        self.rows: list[dict[str, float]] = []
        monkeypatch.setattr(match_series, "play_matches", self.matches)

    def matches(
        self, make_env: Any, policy: Policy, opponent: Any, count: int, seed: int
    ) -> dict[str, Score]:
        strength = 0.0 if isinstance(opponent, RandomPolicy) else opponent.strength
        wins = int(self.rng.binomial(count, expected(self.now, strength)))
        return {"blue": Score(wins=wins, losses=count - wins)}

    def play(self, strength: float, meet: bool) -> None:
        """Play the next series; with `meet` earlier policies may be met."""
        steps = 10 * (len(self.policies) + 1)
        self.now = strength
        opponents = cast(dict[str, Policy], self.policies) if meet else {}
        self.rows.append(self.series.play(self.series._cfg.env, steps, {}, {}, opponents))
        self.policies[f"step {steps}"] = Fake(strength)

    @property
    def best(self) -> str:
        assert self.series.league.best is not None
        return self.series.league.best


def make_series(tmp_path: Path, device: str = "cpu") -> MatchSeries:
    cfg = Config(
        env=EnvConfig(name="SoccerTwos"), matches=MatchConfig(interval=10, count=COUNT), device=device
    )
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


def play_all(series: MatchSeries, monkeypatch: pytest.MonkeyPatch, wins: list[int]) -> None:
    """Play series against random with these wins."""
    results = iter(wins)
    monkeypatch.setattr(
        match_series, "play_matches", lambda *args: {"blue": Score(wins=(w := next(results)), losses=64 - w)}
    )
    for index in range(len(wins)):
        series.play(series._cfg.env, 10 * (index + 1), {}, {})


def test_the_chosen_policy_is_strong_and_not_lucky(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strengths go up and down by 60 points (standard deviation) from one series to the next."""
    gaps, gaps_of_luckiest, above = [], [], []
    for seed in range(30):
        run = FakeRun(make_series(tmp_path), monkeypatch, seed)
        for strength in 500 + 60 * np.random.default_rng(1000 + seed).standard_normal(12):
            run.play(strength, meet=True)

        strengths = [policy.strength for policy in run.policies.values()]
        luckiest = max(range(12), key=lambda index: run.rows[index]["win_rate_vs_random"])
        chosen = run.policies[run.best].strength
        gaps.append(max(strengths) - chosen)
        gaps_of_luckiest.append(max(strengths) - strengths[luckiest])
        above.append(run.series.league.rating(run.best).low - ANCHOR - chosen)

    def ends(values: list[float]) -> tuple[float, float]:
        error = 4 * np.std(values) / np.sqrt(len(values))
        return float(np.mean(values) - error), float(np.mean(values) + error)

    assert ends(gaps)[1] < 30  # points below the strongest of the run's policies
    assert ends(np.subtract(gaps_of_luckiest, gaps).tolist())[0] > 0
    assert ends(above)[1] < 0  # the lower end is below the truth, of the chosen ones too


def test_against_random_alone_luck_is_not_taken_for_strength(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = FakeRun(make_series(tmp_path), monkeypatch, seed=0)
    for _ in range(50):
        run.play(OF_95, meet=False)
    assert max(row["win_rate_vs_random"] for row in run.rows) > 0.98  # the luckiest series of a 0.95
    rating = run.series.league.rating(run.best)
    assert 0.9 < expected(rating.low, ANCHOR) < 0.96 < expected(rating.high, ANCHOR)
    assert [len(run.series.pool), run.series.pool[-1][1]] == [4, COUNT]


def test_who_meets_others_is_rated_by_its_own_matches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    series = make_series(tmp_path)
    play_all(series, monkeypatch, [64, 32])
    assert series.league.state_dict()["results"] == [
        ["step 10", "random", 64, 0],
        ["step 20", "random", 96, 32],
    ]

    run = FakeRun(series, monkeypatch, seed=0)
    run.policies = {"step 10": Fake(5000), "random": Fake(5000), "step 20": Fake(-5000), "file.onnx": Fake(0)}
    monkeypatch.setattr(series._cfg.matches, "opponents", 2)
    run.play(0, meet=True)  # at 50 decisions
    assert series.league.players == ["random", "step 10", "step 20", "step 50", "file.onnx"]
    met = {opponent: won + lost for name, opponent, won, lost in series.league.state_dict()["results"][2:]}
    assert met == {"random": 64, "step 10": 64, "file.onnx": 64}
    assert run.best == "step 10" and not series.is_best(50)
    won, lost = (series.league.state_dict()["results"][-2][index] for index in (2, 3))
    assert (won, lost) == (0, 64)
    assert "; against step 10: 0 won, 0 drawn, 64 lost; " in series.said
    assert series.said.endswith("; the best is step 10")

    series.forget()  # other lessons
    assert series.is_best(60) and series.pool == [] and series.league.players == ["random"]


def test_a_resumed_run_plays_and_rates_on_to_the_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = FakeRun(make_series(tmp_path), monkeypatch, seed=1)
    for strength in (100, 300, 500, 450):
        run.play(strength, meet=True)
    checkpoint.save(tmp_path / "a.pt", {"matches": run.series.state_dict()})

    resumed = FakeRun(make_series(tmp_path), monkeypatch, seed=2)
    resumed.series.load_state_dict(checkpoint.load(tmp_path / "a.pt")["matches"], -np.inf)
    resumed.policies = dict(run.policies)
    for one in (run, resumed):
        one.rng = np.random.default_rng(3)
        monkeypatch.setattr(match_series, "play_matches", one.matches)
        for strength in (550, 520):
            one.play(strength, meet=True)
    assert resumed.rows == run.rows[4:] and resumed.series.said == run.series.said
    assert resumed.series.state_dict() == run.series.state_dict()


def test_checkpoints_of_older_versions_keep_their_best_policy(tmp_path: Path) -> None:
    series = make_series(tmp_path)
    state: dict[str, Any] = {"played_at": 10, "pool": [[50.0, 64], [64.0, 64]]}

    # 160 of 256 points, whose Wilson interval begins at 0.5642 by an independent calculator
    series.load_state_dict(state, 0.5642)
    assert series.pool == [(50, 64), (64, 64)] and not series.is_best(10)
    [[name, opponent, won, lost]] = series.league.state_dict()["results"]
    assert (name, opponent, won, lost) == (
        "the best of before",
        "random",
        pytest.approx(160, abs=0.02),
        256 - won,
    )

    # before, a checkpoint held the share of one series, and the best score was the best of these
    series.load_state_dict({"played_at": 10, "points": 0.5}, 0.75)
    assert series.pool == [(32, 64)]
    assert series.league.state_dict()["results"] == [["the best of before", "random", 48, 16]]

    for old in (state | {"pool": []}, {"played_at": 0, "points": None}):
        series.load_state_dict(old, -0.9)
        assert series.pool == [] and series.league.best is None and series.is_best(10)


def test_a_number_of_opponents_is_none_or_more() -> None:
    with pytest.raises(
        ConfigError, match="matches.opponents=-1 is out of range: matches.opponents must be >= 0"
    ):
        MatchConfig(opponents=-1)
