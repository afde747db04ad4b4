"""Matches: outcomes, sides, intervals."""

import matrix_game
import numpy as np
import pytest
from fakes import behavior_spec
from mlagents_envs.base_env import ActionSpec, BaseEnv, DecisionSteps, TerminalSteps

from mappo_unity.envs.rounds import Episode
from mappo_unity.errors import ConfigError
from mappo_unity.policies import evaluate as evaluation
from mappo_unity.policies.evaluate import evaluate
from mappo_unity.policies.matches import Score, count, find_sides, play_matches, points, wilson
from mappo_unity.policies.policy import RandomPolicy
from mappo_unity.scenes import make_scene

SIDES = ("Duel?team=1", "Duel?team=0")


class Duel(BaseEnv):
    """One decision a match, two agents a side: the side whose members choose 1 more often wins."""

    def __init__(self, seed):
        self.choices = {name: np.zeros(2, int) for name in SIDES}

    behavior_specs = property(lambda self: {name: behavior_spec(1, ActionSpec(0, (2,))) for name in SIDES})

    def reset(self):
        self.over = False

    def step(self):
        self.over = True

    def set_actions(self, name, action):
        self.choices[name] = action.discrete[:, 0]

    def set_action_for_agent(self, *args):
        raise NotImplementedError

    def close(self):
        pass

    def get_steps(self, name):
        spec, side = self.behavior_specs[name], SIDES.index(name)
        ids = np.array([2 * side, 2 * side + 1], np.int32)
        groups = np.full(2, side + 1, np.int32)
        obs, zeros = [np.zeros((2, 1), np.float32)], np.zeros(2, np.float32)
        decision = DecisionSteps(obs, zeros, ids, [np.zeros((2, 2), bool)], groups, zeros)
        if not self.over:
            return decision, TerminalSteps.empty(spec)
        other = SIDES[1 - side]
        won = np.sign(self.choices[name].sum() - self.choices[other].sum())
        reward = np.full(2, won, np.float32)
        return decision, TerminalSteps(obs, zeros, np.zeros(2, bool), ids, groups, reward)


class Always(RandomPolicy):
    def __init__(self, choice):
        self.choice = choice

    def act(self, behavior, steps, spec):
        action = spec.action_spec.empty_action(len(steps))
        action.add_discrete(np.full((len(steps), 1), self.choice, np.int32))
        return action


def test_the_better_player_wins_from_both_sides():
    scores = play_matches(Duel, Always(1), Always(0), 20, seed=0)
    assert list(scores) == ["Duel?team=0", "Duel?team=1"]
    assert all((s.wins, s.draws, s.losses) == (10, 0, 0) for s in scores.values())
    scores = play_matches(Duel, Always(0), Always(1), 9, seed=0)
    assert [s.losses for s in scores.values()] == [5, 4]
    assert all(s.draws == s.matches for s in play_matches(Duel, Always(1), Always(1), 4, seed=0).values())


def of(*played):
    """Return the score of matches, each a result and its decisions."""
    return sum((Score(r > 0, r == 0, r < 0, d, ((r, d),)) for r, d in played), Score())


@pytest.mark.parametrize(
    "striker, goalie, wanted",
    [
        ([(1, 30), (1, 40)], [(-1, 50), (-1, 39)], (2, 2)),  # sooner in one pair, later in the other
        ([(1, 30), (1, 40)], [(-1, 50), (-1, 60)], (4, 0)),  # scored sooner than it was scored against
        ([(1, 30), (1, 40)], [(-1, 30), (-1, 20)], (1, 3)),  # as fast in one pair, slower in the other
        ([(-1, 90), (-1, 90)], [(1, 80), (1, 95)], (2, 2)),  # goalies win: again the sooner the better
        ([(1, 30), (0, 99)], [(0, 99), (-1, 50)], (2, 2)),  # draws are halves, however long
        ([(1, 30), (1, 30)], [(1, 50), (-1, 50)], (4, 0)),  # won as either side; and sooner
        ([(1, 30), (1, 30)], [(-1, 50)], (3, 0)),  # the last match has no other to be compared with
    ],
)
def test_where_one_side_always_wins_time_tells(striker, goalie, wanted):
    sides = {"Striker?team=0": of(*striker), "Goalie?team=1": of(*goalie)}
    assert points(sides) == wanted


def test_where_both_sides_play_alike_results_tell():
    sides = {"Duel?team=0": of((1, 30), (1, 40)), "Duel?team=1": of((-1, 50), (0, 60))}
    assert points(sides) == (2.5, 1.5)


def test_matches_that_are_played_tell_their_results_and_decisions():
    scores = play_matches(Duel, Always(1), Always(0), 6, seed=0)
    assert [s.played for s in scores.values()] == [((1, 1),) * 3] * 2


def test_figures_and_the_interval_of_wilson():
    figures = Score(wins=81, draws=10, losses=9, decisions=400).figures()
    assert figures["won_of_decided"] == 0.9 and figures["goal_difference"] == 0.72
    assert figures["mean_decisions"] == 4.0
    # 81 of 90: Wilson's interval by an independent calculator
    assert (figures["won_of_decided_low95"], figures["won_of_decided_high95"]) == pytest.approx(
        (0.8208, 0.9465), abs=1e-3
    )
    assert wilson(0, 10)[0] == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(wilson(0, 0)).all()


def test_a_team_counts_once_a_match():
    def end(agent, group, result):
        return Episode(agent, 0.0, result, 5, False, group)

    rows = [
        end(0, 1, 0.9),
        end(2, 1, 0.9),
        end(4, 3, -1.0),
        end(0, 1, -1.0),
        end(6, 3, -1.0),
        end(2, 1, -1.0),
    ]
    score = count(rows, members=2)
    assert (score.wins, score.draws, score.losses, score.decisions) == (1, 0, 2, 15)


def test_the_last_member_of_a_team_speaks_and_may_be_back_under_another_id():
    def end(agent, length, result):
        return Episode(agent, 0.0, result, length, False, 1)

    # out before the team wins; the next match has two new members; the last one began too late to count
    rows = [end(0, 3, 0.0), end(1, 9, 1.0), end(2, 4, 0.0), end(3, 8, -1.0), end(4, 2, 1.0)]
    score = count(rows, members=2)
    assert score.played == ((1, 9), (-1, 8), (1, 2))


def test_scenes_with_one_side_are_refused():
    with pytest.raises(ConfigError, match="two sides.*has 1: 3DBall"):
        find_sides(make_scene("3DBall", num_areas=1))


def test_random_play_in_the_soccer_scenes_is_even():
    for name in ("SoccerTwos", "StrikersVsGoalie"):
        scores = play_matches(
            lambda seed, name=name: make_scene(name, seed=seed, num_areas=2),
            RandomPolicy(0),
            RandomPolicy(1),
            4,
            0,
        )
        assert sum(s.matches for s in scores.values()) == 4
        if name == "StrikersVsGoalie":  # the goalie's side cannot score
            assert scores["Goalie?team=1"].wins == 0 and scores["Striker?team=0"].losses == 0


class LeftBehind(matrix_game.MatrixGame):
    """A game that the second side wins; later resets go on from where it stands, in a match that it loses."""

    is_used = stale = False

    def reset(self):
        super().reset()
        self.stale = self.is_used

    def step(self):
        self.stale = self.stale and not self.played
        self.is_used = True
        super().step()

    def get_steps(self, behavior_name):
        decision, terminal = super().get_steps(behavior_name)
        terminal.reward[:] = -1.0 if self.stale == (behavior_name == matrix_game.SIDES[1]) else 1.0
        return decision, terminal


class WithSnapshots(LeftBehind):
    """The same with snapshots, and a count of its steps."""

    steps = 0

    def step(self):
        self.steps += 1
        super().step()

    def get_state(self):
        return {"is_used": self.is_used}

    def set_state(self, state):
        self.is_used, self.stale, self.played = state["is_used"], False, False


@pytest.mark.parametrize("game", [LeftBehind, WithSnapshots])
def test_matches_that_begin_with_the_reset_of_a_used_environment_do_not_count(game):
    policy = RandomPolicy(0)
    scores = play_matches(lambda seed: game(seed, games=4), policy, policy, 16, seed=0)
    assert [(score.wins, score.losses) for score in scores.values()] == [(0, 8), (8, 0)]


class SecondLater(matrix_game.MatrixGame):
    """A game whose second side is asked one step later than the first, as in a game of turns."""

    def get_steps(self, behavior_name):
        decision, terminal = super().get_steps(behavior_name)
        if behavior_name == matrix_game.SIDES[1] and not self.played:
            return DecisionSteps.empty(self.specs[behavior_name]), terminal
        return decision, terminal


def test_a_side_that_moves_later_has_its_matches_too():
    scores = play_matches(lambda seed: SecondLater(seed, games=4), Always(0), Always(1), 16, seed=0)
    assert {side: score.matches for side, score in scores.items()} == dict.fromkeys(matrix_game.SIDES, 8)


def test_a_policy_and_its_opponent_draw_numbers_of_their_own(monkeypatch):
    opened = []
    monkeypatch.setattr(evaluation, "play_matches", lambda make, *players: opened.extend(players) or {})
    evaluate("random", 2, seed=7, opponent="random", env="SoccerTwos")
    own, other = (player.rng.random(4).tolist() for player in opened[:2])
    assert own == np.random.default_rng(7).random(4).tolist() != other


class LaterAndLeft(SecondLater):
    """The same, which the second side wins, and loses the first match after later resets."""

    is_used, since = False, 99

    def reset(self):
        super().reset()
        self.since = 0 if self.is_used else 99

    def step(self):
        self.since += 1
        self.is_used = True
        super().step()

    def get_steps(self, behavior_name):
        decision, terminal = super().get_steps(behavior_name)
        is_first = self.since <= 2  # the step that ends the second side's first match
        terminal.reward[:] = -1.0 if is_first == (behavior_name == matrix_game.SIDES[1]) else 1.0
        return decision, terminal


def test_what_the_reset_of_a_used_environment_begins_does_not_count_for_a_later_side():
    scores = play_matches(lambda seed: LaterAndLeft(seed, games=4), Always(0), Always(1), 16, seed=0)
    assert [(score.wins, score.losses) for score in scores.values()] == [(0, 8), (8, 0)]


def test_both_sides_begin_at_a_snapshot_where_there_are_some():
    made = []

    def make(seed):
        made.append(WithSnapshots(seed, games=4))
        return made[-1]

    play_matches(make, RandomPolicy(0), RandomPolicy(1), 16, seed=0)
    assert [env.steps for env in made] == [4]  # two for the 8 matches of each side, none is played in vain
