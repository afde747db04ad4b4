"""Matches in which both sides earn alike: who has won is told by the difference."""

from __future__ import annotations

import matrix_game
import pytest
from fakes import Record, ScriptedEnv
from test_matches import Always

from mappo_unity.envs.rounds import Episode
from mappo_unity.errors import ConfigError
from mappo_unity.policies.episodes import Ended, play
from mappo_unity.policies.match_pairs import other_returns
from mappo_unity.policies.matches import play_matches
from mappo_unity.policies.policy import RandomPolicy

SHIFTS = (-5.0, -2.0, -1.0, 5.0)


class Shifted(matrix_game.MatrixGame):
    """A game of which both sides earn so much beside: a step penalty, in a game with a time limit."""

    shift = 0.0

    def get_steps(self, behavior_name):
        decision, terminal = super().get_steps(behavior_name)
        terminal.reward[:] += self.shift
        return decision, terminal


def results(shift: float, policy: int, opponent: int) -> dict[str, tuple[tuple[int, int], ...]]:
    """Return what play_matches counts, result and decisions of each match by side."""

    def make(seed: int) -> Shifted:
        game = Shifted(seed, games=4)
        game.shift = shift
        return game

    scores = play_matches(make, Always(policy), Always(opponent), 12, seed=0)
    return {side: score.played for side, score in scores.items()}


@pytest.mark.parametrize("shift", SHIFTS)
def test_what_both_sides_earn_alike_decides_no_match(shift: float) -> None:
    for choices, wanted in {(0, 1): -1, (1, 0): 1, (0, 2): 1, (2, 0): -1, (1, 1): 0}.items():
        assert results(shift, *choices) == dict.fromkeys(matrix_game.SIDES, ((wanted, 1),) * 6)


class Late(matrix_game.MatrixGame):
    """A game that shows a third behavior after its first step."""

    def step(self):
        super().step()
        self.specs["Late?team=1"] = self.specs[matrix_game.SIDES[1]]

    def get_steps(self, behavior_name):
        return super().get_steps(
            behavior_name if behavior_name in matrix_game.SIDES else matrix_game.SIDES[1]
        )


def test_a_behavior_that_appears_during_matches_is_refused() -> None:
    with pytest.raises(
        ConfigError, match="'Late.team=1' appeared after the start, when there were .'Rps.team=0'"
    ):
        play_matches(Late, Always(0), Always(1), 4, seed=0)


def end(agent: int, began: int, ended: int, value: float, group: int = 0) -> Ended:
    individual, earned = (0.0, value) if group else (value, 0.0)
    return Ended(Episode(agent, individual, earned, 1, False, group), began, ended)


def test_matches_that_end_in_one_step_are_told_apart_by_their_order() -> None:
    own = [end(0, 0, 5, 1.0), end(1, 0, 5, -1.0), end(0, 5, 9, 2.0), end(1, 5, 12, 0.0)]
    other = [end(2, 0, 5, -1.0), end(3, 0, 5, 1.0), end(2, 5, 9, -2.0), end(3, 5, 13, 0.0)]
    found = other_returns(own, other)
    # of the last one the sides did not end together
    assert [found.get(id(row.episode)) for row in own] == [-1.0, 1.0, -2.0, None]


def test_a_reward_that_was_earned_before_a_match_tells_nothing_of_it() -> None:
    own, other = [end(0, 0, 5, 0.0, 1), end(0, 5, 9, 0.0, 1)], [end(1, 0, 5, -1.0, 2), end(1, 5, 9, -1.0, 2)]
    own[0] = own[0]._replace(is_late=True)
    assert list(other_returns(own, other)) == [id(own[1].episode)]
    assert list(other_returns(other, own)) == [id(other[1].episode)]


def test_every_end_is_told_with_its_steps_and_what_had_been_earned_before() -> None:
    again = [Record(0, ends="terminated"), Record(0, reward=1), Record(1, ends="terminated"), Record(1)]
    ends = [Record(0, ends="terminated"), Record(1, ends="terminated")]
    told: list[Ended] = []
    play(
        ScriptedEnv([[Record(0), Record(1)], again, [], ends]),
        RandomPolicy(0),
        1,
        told=lambda _, e: told.append(e),
    )
    assert [(row.episode.agent_id, *row[1:]) for row in told] == [(0, 0, 1, False), (1, 0, 1, False)]
    told.clear()
    play(
        ScriptedEnv([[Record(0), Record(1)], again, [], ends]),
        RandomPolicy(0),
        3,
        told=lambda _, e: told.append(e),
    )
    assert [(row.episode.agent_id, *row[1:]) for row in told[2:]] == [(0, 1, 3, True), (1, 1, 3, False)]


def test_agents_without_a_team_count_by_their_mean() -> None:
    two = [end(agent, 0, 5, float(agent)) for agent in range(4)]
    one = [end(8, 0, 5, 10.0), end(9, 0, 5, 20.0)]
    assert [other_returns(one, two)[id(row.episode)] for row in one] == [0.5, 2.5]
    assert [other_returns(two, one)[id(row.episode)] for row in two] == [10.0, 10.0, 20.0, 20.0]
    assert not other_returns(two[:3], one)


def test_the_last_member_speaks_and_one_that_is_out_ends_no_match() -> None:
    own = [end(0, 0, 5, 1.0, 1), end(1, 0, 5, 1.0, 1), end(0, 5, 9, 3.0, 1), end(1, 5, 9, 3.0, 1)]
    other = [end(4, 0, 3, 0.0, 2), end(5, 0, 5, -1.0, 2), end(6, 0, 5, 7.0), end(4, 5, 9, -3.0, 2)]
    other += [end(7, 3, 12, 8.0, 3), end(5, 5, 9, -2.0, 2)]
    found = other_returns(own, other)
    assert [found.get(id(row.episode)) for row in own] == [None, -1.0, None, -2.0]
    # somebody of another team is out in the step in which a match ends
    other.insert(1, end(8, 0, 5, 9.0, 3))
    other[5] = end(7, 0, 12, 8.0, 3)
    assert other_returns(own, other) == found
