"""The league of a policy that learns: what it was at each series of matches, random, and other opponents.

Each series enters one player, and all are rated anew from all results (`ratings`; random is the anchor). The
best player is the one whose rating is highest at the lower end of its interval. Both are asked of the same
fit: who was chosen by luck loses the place as soon as more matches say so, for the best player is the first
that the next ones meet (`choose_opponents`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import astuple
from typing import Any

import numpy as np

from mappo_unity.policies.league.ratings import Rating, rate
from mappo_unity.policies.policy_files import RANDOM

MAX_PLAYERS = 60  # random among them: a fit stays short, and so does a checkpoint
DIGITS = 2  # of a rating: equal results give equal ratings, whatever was rounded on the way

Points = tuple[float, float]
"""Points won and lost in the matches against somebody: a win counts 1 and a draw 1/2."""


def step_name(agent_steps: int) -> str:
    """Return what the policy of a run is called as it was after so many agent decisions."""
    return f"step {agent_steps:,}"


class GrowingLeague:
    """Results and ratings of the players, of whom there are `MAX_PLAYERS` at most.

    Attributes: `players`, their names, random first, then in the order in which they entered; `newest` and
    `best`, the player of the last series and the one with the highest lower end; None before any series.
    """

    def __init__(self) -> None:
        self.players = [RANDOM]
        self.newest: str | None = None
        self.best: str | None = None
        # of a player (first name) and one who entered before it
        self._results: dict[tuple[str, str], Points] = {}
        self._ratings: dict[str, Rating] | None = None  # of the present results

    def enter(self, name: str, results: Mapping[str, Points], kept: Collection[str] = ()) -> Rating:
        """Take in the results of a policy's series; return its rating.

        Args:
            name: the policy's.
            results: by opponent, whose own results these are, too.
            kept: players who leave the league last, for they may be met again.
        """
        for opponent, (won, lost) in results.items():
            self._add(name, opponent, won, lost)
        self.newest = name

        # who enters is the best until another one's lower end is above its own: of equal ones the newest is
        before, self._ratings = self.best, None
        if before is None or self.rating(name).low >= self.rating(before).low:
            self.best = name

        rating = self.rating(name)
        self._drop(kept)
        return rating

    def rating(self, name: str) -> Rating:
        """Return a player's rating from all results; the interval is NaN but for the newest and the best."""
        if self._ratings is None:
            self._ratings = self._fit()
        return self._ratings[name]

    def choose_opponents(self, names: Iterable[str], most: int) -> list[str]:
        """Choose whom the next policy meets, out of `names`, which stand in the order of their age.

        The best player first: whether the next policy is better is the question. Then those whose rating is
        closest to that of the newest player, for matches between equals tell most. Who was never rated
        counts as its equal, and of equal ones the last named is met first.
        """
        names = [*names]
        place = {name: index for index, name in enumerate(names)}

        def distance(name: str) -> float:
            if name not in self.players or self.newest is None:
                return 0.0
            return abs(self.rating(name).rating - self.rating(self.newest).rating)

        return sorted(names, key=lambda name: (name != self.best, distance(name), -place[name]))[:most]

    # --- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Return players and results, as plain values."""
        results = [[*pair, *points] for pair, points in self._results.items()]
        return {"players": [*self.players], "results": results, "newest": self.newest, "best": self.best}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.players, self.newest, self.best = [*state["players"]], state["newest"], state["best"]
        self._results = {(one, other): (won, lost) for one, other, won, lost in state["results"]}
        self._ratings = None

    # --- results

    def _add(self, name: str, opponent: str, won: float, lost: float) -> None:
        for player in (opponent, name):
            if player not in self.players:
                self.players.append(player)

        if (opponent, name) in self._results:
            name, opponent, won, lost = opponent, name, lost, won
        before = self._results.get((name, opponent), (0.0, 0.0))
        self._results[name, opponent] = (before[0] + won, before[1] + lost)

    def _fit(self) -> dict[str, Rating]:
        place = {name: index for index, name in enumerate(self.players)}
        points = np.zeros((len(place), len(place)))
        for (name, opponent), (won, lost) in self._results.items():
            points[place[name], place[opponent]] = won
            points[place[opponent], place[name]] = lost

        asked = [place[name] for name in (self.newest, self.best) if name is not None]
        ratings = rate(points, anchor=place[RANDOM], intervals=asked)
        rounded = [Rating(*(round(value, DIGITS) for value in astuple(rating))) for rating in ratings]
        return dict(zip(self.players, rounded, strict=True))

    def _drop(self, kept: Collection[str]) -> None:
        """Drop the oldest players, with their results, where there are too many."""
        # sorted() leaves those in the order of their age who are equal
        droppable = [name for name in self.players if name not in (RANDOM, self.newest, self.best)]
        droppable = sorted(droppable, key=lambda name: name in kept)
        gone = {*droppable[: max(0, len(self.players) - MAX_PLAYERS)]}
        if not gone:
            return

        self.players = [name for name in self.players if name not in gone]
        self._results = {pair: points for pair, points in self._results.items() if not gone & {*pair}}
        self._ratings = None
