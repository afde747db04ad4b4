"""Matches between two policies in a two-sided scene, both sides in turn.

A side is a team id (``Name?team=1``): its behaviors belong to one policy.

A match is one episode of a team. The side with the higher return has won: of its group rewards, as its last
member earned them, of individual rewards where there are no groups. Equal returns are a draw. Where it cannot
be told what the other side earned in the match (`match_pairs`), a side with a positive return has won, and
one with a negative one has lost.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from mlagents_envs.base_env import BaseEnv

from mappo_unity.envs.backends import MakeEnv
from mappo_unity.envs.opening import first_results
from mappo_unity.envs.rounds import Episode
from mappo_unity.keys import policy_name
from mappo_unity.policies.episodes import Ended, play
from mappo_unity.policies.layouts import check_two_sides
from mappo_unity.policies.match_pairs import other_returns
from mappo_unity.policies.policy import Policy
from mappo_unity.scenes.contract.rules import MAX_SILENT_STEPS, check_silence, has_snapshots

Z95 = 1.959964  # two-sided 95 % quantile of the standard normal distribution


@dataclass
class Score:
    """Outcomes of matches, seen from one policy."""

    wins: int = 0
    draws: int = 0
    losses: int = 0
    decisions: int = 0  # over all matches
    played: tuple[tuple[int, int], ...] = ()  # of each match 1, 0 or -1, and decisions

    def __add__(self, other: Score) -> Score:
        return Score(
            self.wins + other.wins,
            self.draws + other.draws,
            self.losses + other.losses,
            self.decisions + other.decisions,
            self.played + other.played,
        )

    @property
    def matches(self) -> int:
        """Number of matches."""
        return self.wins + self.draws + self.losses

    def figures(self) -> dict[str, Any]:
        """Return the figures for a table; the interval is that of the share of decided matches won."""
        decided = self.wins + self.losses
        low, high = wilson(self.wins, decided)
        return {
            "matches": self.matches,
            "wins": self.wins,
            "draws": self.draws,
            "losses": self.losses,
            "won_of_decided": self.wins / decided if decided else math.nan,
            "won_of_decided_low95": low,
            "won_of_decided_high95": high,
            "goal_difference": (self.wins - self.losses) / max(1, self.matches),
            "mean_decisions": self.decisions / max(1, self.matches),
        }


def play_matches(
    make_env: MakeEnv, policy: Policy, opponent: Policy, matches: int, seed: int
) -> dict[str, Score]:
    """Play ``matches`` matches, half of them with the sides swapped.

    Both halves begin alike where the environment has snapshots. Another one goes on from where the first half
    has left it, and what its reset begins then does not count.

    Returns:
        The policy's score as each side, under the names of the side's behaviors.

    Raises:
        ConfigError: the environment has not two sides.
    """
    scores: dict[str, Score] = {}

    env: Any = make_env(seed)
    try:
        sides = find_sides(env)
        start = env.get_state() if has_snapshots(env) else None
        for index, side in enumerate(sides):
            if index and start is not None:
                env.set_state(start)

            own, other = sides[side], [b for s, names in sides.items() if s != side for b in names]
            policies = dict.fromkeys(own, policy) | dict.fromkeys(other, opponent)
            # Of an odd number of matches the first side gets one more.
            count = (matches + 1 - index) // 2
            is_used = index > 0 and start is None
            scores["+".join(own)] = play_side(env, policies, own, max(1, count), is_used)
    finally:
        env.close()

    return scores


def find_sides(env: BaseEnv) -> dict[int, list[str]]:
    """Return the behaviors of each side; they appear with the first agents that request a decision.

    Raises:
        ConfigError: there are not two sides.
        EnvironmentDataError: nobody requests a decision.
    """
    env.reset()
    return check_two_sides({name: first.spec for name, first in first_results(env, MAX_SILENT_STEPS).items()})


def play_side(
    env: BaseEnv, policies: dict[str, Policy], own: list[str], matches: int, is_used: bool = False
) -> Score:
    """Play until the first ``matches`` team episodes begun by the first of our behaviors have ended.

    In an environment that is used, where matches have been played before, those that the reset begins do not
    count: the ball lies where the other side has left it.
    """
    name, rival = own[0], next(behavior for behavior in policies if behavior not in own)
    env.reset()
    members = count_members(env, name)
    ended = defaultdict[str, list[Ended]](list)
    # Each member of a team has an agent episode of its own in every match.
    episodes = play(
        env, policies, matches * (members or 1), name, is_used, lambda who, row: ended[who].append(row)
    )[name]
    return count(episodes, members, other_returns(ended[name], ended[rival]))


def count_members(env: BaseEnv, behavior: str) -> int | None:
    """Return how many agents of a behavior make a team; None: there are no teams.

    Of an environment that was reset; where the other side moves first it is stepped until this one may.

    Raises:
        EnvironmentDataError: it never may.
    """
    steps = 0
    while not len(groups := env.get_steps(behavior)[0].group_id):
        check_silence(steps, MAX_SILENT_STEPS)
        env.step()
        steps += 1

    # group 0 is none: without teams the match of an agent is its own episode
    sizes = np.bincount(groups)[1:]
    return int(sizes.max()) if sizes.any() else None


def count(episodes: list[Episode], members: int | None, others: Mapping[int, float] | None = None) -> Score:
    """Sum up the outcomes of matches.

    Args:
        episodes: in the order of their ends.
        members: of a team, each of which has an episode in a match; None: there are no teams.
        others: the other side's returns (`other_returns`); 0 of a match that is missing there.
    """
    score = Score()
    for episode in episodes if members is None else _last_of_teams(episodes, members):
        outcome = episode.individual_return if members is None else episode.group_return
        other = (others or {}).get(id(episode), 0.0)
        # what is equal may have been added up in another order
        is_draw = math.isclose(outcome, other, rel_tol=1e-6)
        result = 0 if is_draw else int(outcome > other) - int(outcome < other)
        length = episode.length
        score += Score(int(result > 0), int(result == 0), int(result < 0), length, ((result, length),))

    return score


def _last_of_teams(episodes: list[Episode], members: int) -> Iterator[Episode]:
    """Yield the episode that ended last of each match of a team.

    A member that was out earlier has not earned what came for the team afterwards; and one that is back in
    the next match may have another id.
    """
    last: dict[int, Episode] = {}  # of the matches that are not over, by group
    ends = dict[int, int]()
    for episode in episodes:
        group = episode.group_id
        if not group:  # an agent beside the teams
            continue
        last[group], ends[group] = episode, ends.get(group, 0) + 1
        if ends[group] == members:
            ends[group] = 0
            yield last.pop(group)
    yield from last.values()  # of some members that began before so many matches had begun


def have_parts(sides: Iterable[str]) -> bool:
    """Return whether two sides play different parts, a striker's and a goalie's: their behaviors differ.

    Args:
        sides: the names of the sides' behaviors, as `play_matches` returns them.
    """
    parts = {frozenset(policy_name(behavior) for behavior in side.split("+")) for side in sides}
    return len(parts) == 2


def points(sides: Mapping[str, Score]) -> tuple[float, float]:
    """Return points won and lost as both sides: a win counts 1, a draw 1/2.

    Where the sides have different parts, a striker's and a goalie's, one of them may win always, whoever
    plays it: results alone then call all policies equal. There the matches make pairs, one as each side, and
    a pair that the same side has won twice goes to the policy that won sooner, or was beaten later.

    Args:
        sides: scores under the names of the sides' behaviors, as `play_matches` returns them.
    """
    total = sum(sides.values(), Score())
    won, lost = total.wins + 0.5 * total.draws, total.losses + 0.5 * total.draws

    if have_parts(sides):
        first, second = sides.values()
        for (result, decisions), (other_result, other_decisions) in zip(first.played, second.played):
            if result * other_result == -1:
                # we won once and lost once: a point to each so far
                gained = result * ((decisions < other_decisions) - (decisions > other_decisions))
                won, lost = won + gained, lost - gained
    return won, lost


def wilson(wins: float, total: int) -> tuple[float, float]:
    """Return Wilson's 95 % confidence interval of a share (Wilson 1927); a draw may count as half a win."""
    if not total:
        return math.nan, math.nan
    share, z2 = wins / total, Z95**2
    middle = (share + z2 / (2 * total)) / (1 + z2 / total)
    half = Z95 * math.sqrt(share * (1 - share) / total + z2 / (4 * total**2)) / (1 + z2 / total)
    return middle - half, middle + half
