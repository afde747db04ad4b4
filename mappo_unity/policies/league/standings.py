"""What a league comes to: its players with their ratings, best first, and who won how much against whom."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mappo_unity.policies.league.ratings import rate
from mappo_unity.policies.league.table import Pair, Result, outcomes
from mappo_unity.policies.policy_files import RANDOM


@dataclass(frozen=True)
class Row:
    """A player: rating and the ends of its 95 % interval in points, and its matches against all others."""

    name: str
    rating: float
    low: float
    high: float
    won: int
    drawn: int
    lost: int


@dataclass(frozen=True)
class Standings:
    """The players, best first; ``[N, N, 3]`` wins, draws and losses of each (row) against each (column)."""

    rows: list[Row]
    outcomes: np.ndarray
    results: list[Result]  # of all pairs and sides, in the order of the pairs

    @property
    def names(self) -> list[str]:
        """The players' names, best first."""
        return [row.name for row in self.rows]

    def share(self, row: int, column: int) -> float:
        """Return the share of the points that one player won against another."""
        won, drawn, lost = self.outcomes[row, column].tolist()
        return (won + drawn / 2) / max(1, won + drawn + lost)

    def figures(self) -> dict[str, Any]:
        """Return the players as plain values."""
        return {"league": [asdict(row) for row in self.rows]}


def standings_of(names: list[str], results: dict[Pair, list[Result]]) -> Standings:
    """Rate the players; where random plays, its rating is the anchor, else the mean of all is."""
    table = outcomes(results, names)
    ratings = rate(table[..., 0] + table[..., 1] / 2, names.index(RANDOM) if RANDOM in names else None)

    # equal ratings stand in the order in which the players were named
    order = sorted(range(len(names)), key=lambda index: -round(ratings[index].rating, 6))
    rows = []
    for index in order:
        rating, totals = ratings[index], table[index].sum(0).tolist()
        middle, low, high = (round(value, 2) for value in (rating.rating, rating.low, rating.high))
        rows.append(Row(names[index], middle, low, high, *totals))
    return Standings(rows, table[np.ix_(order, order)], [row for rows in results.values() for row in rows])
