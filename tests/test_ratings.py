"""Ratings of players: worked by hand, and recovered from simulated leagues of known strengths."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mappo_unity.policies.league.ratings import ANCHOR, ELO, expected, rate

REPEATS = 150


def test_two_players_by_hand() -> None:
    # 3 : 1 is a chance of 3/4, so odds of 3: 400 log10(3) points
    lead = 400 * math.log10(3)
    points = np.array([[0, 30], [10, 0]])
    first, second = rate(points, prior=None)
    assert (first.rating, second.rating) == pytest.approx((ANCHOR + lead / 2, ANCHOR - lead / 2))
    assert [row.rating for row in rate(points, 1, None)] == pytest.approx([ANCHOR + lead, ANCHOR])

    # the ends of the interval by the definition: twice the loss of log-likelihood is 1.96 squared
    best = 30 * math.log(0.75) + 10 * math.log(0.25)
    for end in (rate(points, 1, None)[0].low, rate(points, 1, None)[0].high):
        p = expected(end, ANCHOR)
        assert 2 * (best - 30 * math.log(p) - 10 * math.log(1 - p)) == pytest.approx(1.959964**2)
    assert rate(points, 1)[1] == rate(points, 1)[1].__class__(ANCHOR, ANCHOR, ANCHOR)


def test_intervals_of_some_players_are_those_of_all() -> None:
    points = np.array([[0, 8, 12], [4, 0, 8], [3, 4, 0]])
    every, some = rate(points, 0), rate(points, 0, intervals=[2])
    assert some[2] == every[2] and [row.rating for row in some] == [row.rating for row in every]
    assert math.isnan(some[1].low) and math.isnan(some[1].high)


def test_three_players_whose_results_agree_with_one_another() -> None:
    # odds of 2 between neighbours, so of 4 between the ends
    points = np.array([[0, 8, 12], [4, 0, 8], [3, 4, 0]])
    step = ELO * math.log(2)
    wanted = [ANCHOR + step, ANCHOR, ANCHOR - step]
    assert [row.rating for row in rate(points, prior=None)] == pytest.approx(wanted)


def test_a_draw_is_half_a_win_and_the_order_of_the_players_says_nothing() -> None:
    points = np.array([[0, 2.5, 4], [1.5, 0, 2], [0, 2, 0]])
    ratings, turned = rate(points), rate(points[::-1, ::-1])[::-1]
    assert ratings[1].rating != ANCHOR and ratings[0].rating > ratings[1].rating > ratings[2].rating
    for one, other in zip(ratings, turned):
        assert (one.rating, one.low, one.high) == pytest.approx((other.rating, other.low, other.high))


def test_who_has_won_everything_has_a_rating_with_a_long_upper_end() -> None:
    few, many = (rate(np.array([[0, n], [0, 0]]), 1)[0] for n in (4, 400))
    assert ANCHOR < few.rating < many.rating < ANCHOR + 3000
    assert few.low < many.low and many.low > ANCHOR + 600
    assert many.high - many.rating > 2 * (many.rating - many.low)
    nothing = rate(np.zeros((3, 3)))  # no match at all: everybody at the mean, and nobody knows
    assert all(row.rating == pytest.approx(ANCHOR) and row.high > ANCHOR + 1000 for row in nothing)


@pytest.mark.parametrize("anchor", [None, 0])
@pytest.mark.parametrize("draws", [0.0, 0.3])
def test_known_strengths_lie_in_their_intervals(anchor: int | None, draws: float) -> None:
    strengths = np.array([0.0, 120.0, 260.0, 500.0])
    level = strengths.mean() if anchor is None else strengths[anchor]
    rng = np.random.default_rng(13)

    inside = []
    for _ in range(REPEATS):
        ratings = rate(simulate(rng, strengths, 50, draws), anchor)
        known = zip(ratings, strengths - level + ANCHOR)
        hits = [row.low <= strength <= row.high for row, strength in known]
        inside.append(np.mean([hit for player, hit in enumerate(hits) if player != anchor]))

    error = np.std(inside) / math.sqrt(REPEATS)
    assert np.mean(inside) > 0.95 - 4 * error
    assert draws or np.mean(inside) < 0.95 + 4 * error  # with draws they are wider than need be


def simulate(rng: np.random.Generator, strengths: np.ndarray, matches: int, draws: float) -> np.ndarray:
    """Return points ``[N, N]``; a draw takes as much from a player's wins as from its losses."""
    points = np.zeros((len(strengths), len(strengths)))
    for i in range(len(strengths)):
        for j in range(i):
            share = expected(strengths[i], strengths[j])
            drawn = 2 * draws * min(share, 1 - share)
            won, even, lost = rng.multinomial(matches, [share - drawn / 2, drawn, 1 - share - drawn / 2])
            points[i, j], points[j, i] = won + even / 2, lost + even / 2
    return points
