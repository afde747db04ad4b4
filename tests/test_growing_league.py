"""The league of a policy that learns: who is the best, whom the next one meets, and who is forgotten."""

from __future__ import annotations

import pytest

from mappo_unity.policies.league.growing import MAX_PLAYERS, GrowingLeague, step_name
from mappo_unity.policies.league.ratings import ANCHOR
from mappo_unity.policies.policy_files import RANDOM


def test_the_best_is_asked_of_the_fit_of_today() -> None:
    league = GrowingLeague()
    lucky = league.enter("step 1", {RANDOM: (64.0, 0.0)})
    second = league.enter("step 2", {RANDOM: (57.0, 7.0)})
    assert second.low < lucky.low and league.best == "step 1"

    # it meets the lucky one: what that one scored once is higher still, what it is rated now is not
    third = league.enter("step 3", {RANDOM: (58.0, 6.0), "step 1": (40.0, 24.0)})
    assert third.low < lucky.low and league.best == "step 3" == league.newest
    assert league.rating("step 1").rating < lucky.rating
    assert ANCHOR == league.rating(RANDOM).rating < third.low < third.rating < third.high


def test_of_equals_the_newest_is_the_best() -> None:
    league = GrowingLeague()
    for index in range(5):
        league.enter(f"step {index}", {RANDOM: (64.0, 0.0)})
        assert league.best == f"step {index}"


def test_a_player_is_the_same_one_on_either_side() -> None:
    league = GrowingLeague()
    league.enter("a", {RANDOM: (5.0, 3.0)})
    league.enter("b", {"a": (6.0, 2.0)})
    league.enter("a", {"b": (1.5, 0.5), RANDOM: (1.0, 0.0)})
    assert league.players == [RANDOM, "a", "b"]
    assert league.state_dict()["results"] == [["a", RANDOM, 6.0, 3.0], ["b", "a", 6.5, 3.5]]


def test_the_best_and_those_of_about_its_strength_are_met() -> None:
    league = GrowingLeague()
    assert league.choose_opponents(["old", "new"], 1) == ["new"]  # nobody is rated
    for name, won in (("good", 15.0), ("weak", 4.0), ("even", 9.0), ("even too", 9.0), ("now", 10.0)):
        league.enter(name, {RANDOM: (won, 16 - won)})

    assert league.best == "good"
    names = ["even", "good", "weak", "even too", "unrated", "newer"]
    assert league.choose_opponents(names, 9) == ["good", "newer", "unrated", "even too", "even", "weak"]
    assert league.choose_opponents(names, 0) == []


def test_there_are_never_too_many_players_and_the_best_one_stays() -> None:
    league = GrowingLeague()
    league.enter("best", {RANDOM: (100.0, 0.0)})
    for index in range(MAX_PLAYERS + 20):
        opponents = {"fixed": (9.0, 7.0), step_name(index - 1) if index else "best": (8.0, 8.0)}
        league.enter(step_name(index), {RANDOM: (9.0, 7.0), **opponents}, kept=["fixed", "step 5"])
        assert len(league.players) <= MAX_PLAYERS

    left = [step_name(index) for index in range(24, MAX_PLAYERS + 20)]
    assert league.players == [RANDOM, "best", "fixed", "step 5", *left]
    pairs = [row[:2] for row in league.state_dict()["results"]]
    assert {name for pair in pairs for name in pair} == {*league.players}

    # even those who are kept go, where there are too many of them
    for index in range(MAX_PLAYERS):
        league.enter(f"kept {index}", {RANDOM: (8.0, 8.0)}, kept=[f"kept {i}" for i in range(MAX_PLAYERS)])
    assert len(league.players) == MAX_PLAYERS and league.players[:3] == [RANDOM, "best", "kept 2"]
    assert league.rating("kept 2").rating == pytest.approx(league.rating("kept 50").rating, abs=0.02)
