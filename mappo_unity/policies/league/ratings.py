"""Ratings of players from the results of their matches: Bradley-Terry by maximum likelihood.

The model (R. A. Bradley and M. E. Terry, Rank analysis of incomplete block designs, Biometrika 39, 1952,
p. 324-345): a player rated r beats one rated s with probability 1 / (1 + 10^((s - r) / 400)), which is the
scale of A. E. Elo. A draw counts as half a win and half a loss.

A weak prior keeps the ratings of those finite who won or lost everything: ratings are normal around the
league's mean with a standard deviation of 1000 points. The intervals are those of the profile likelihood,
which, unlike the estimate plus and minus its standard error, are long on the side of which such results say
little. Draws vary less than wins and losses, so that with many of them the intervals are too wide, not too
narrow.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

ELO = 400 / math.log(10)  # points for one unit of log-odds
ANCHOR = 1200.0
"""Rating of the anchor, in points: where ML-Agents' own ratings begin (`initial_elo`)."""
PRIOR = 1000.0
"""Standard deviation of the prior, in points."""
Z95 = 1.959964  # two-sided 95 % quantile of the standard normal distribution

_STEPS = 200  # of Newton's method; it takes some ten
_CLOSE = 1e-10  # units of log-odds


@dataclass(frozen=True)
class Rating:
    """A player's rating and the ends of its 95 % interval, in points."""

    rating: float
    low: float
    high: float


def rate(
    points: np.ndarray,
    anchor: int | None = None,
    prior: float | None = PRIOR,
    intervals: Collection[int] | None = None,
) -> list[Rating]:
    """Return the players' ratings.

    Args:
        points: ``[N, N]``; in row i and column j what i scored against j, a win 1 and a draw 1/2. The
            matches of the two are ``points[i, j] + points[j, i]``.
        anchor: the player who is rated `ANCHOR` by definition; None: the mean of all is.
        prior: standard deviation in points; None: no prior, where nobody won or lost everything.
        intervals: the players whose intervals are wanted, which take most of the time; None: all. The ends
            of the others' are NaN.
    """
    count = len(points)
    league = _League(np.asarray(points, float), 0.0 if prior is None else (ELO / prior) ** 2)
    best = league.maximum()

    ratings = []
    for player in range(count):
        # what is asked for: the player's strength less that of the anchor
        contrast = np.eye(count)[player]
        contrast = contrast - (np.full(count, 1 / count) if anchor is None else np.eye(count)[anchor])
        middle = float(contrast @ best)
        if intervals is not None and player not in intervals:
            ends = [math.nan, math.nan]
        else:
            ends = [_end(league, contrast, best, sign) if contrast.any() else middle for sign in (-1, 1)]
        ratings.append(Rating(*(ANCHOR + ELO * value for value in (middle, *ends))))

    return ratings


def expected(rating: float, other: float) -> float:
    """Return the share of the points that a player so rated wins against another."""
    return 1 / (1 + 10 ** ((other - rating) / 400))


class _League:
    """The log-likelihood of strengths in log-odds, less ``precision / 2`` times their squares (the prior)."""

    def __init__(self, points: np.ndarray, precision: float) -> None:
        self.points, self.matches, self.precision = points, points + points.T, precision
        np.fill_diagonal(self.matches, 0.0)

    def value(self, strengths: np.ndarray) -> float:
        gaps = strengths[:, None] - strengths[None, :]
        likelihood = -(self.points * np.logaddexp(0, -gaps)).sum()
        # the level of all is free without a prior; this pins it, and no difference feels it
        return float(likelihood - self.precision * (strengths**2).sum() / 2 - strengths.sum() ** 2 / 2)

    def slopes(self, strengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gradient ``[N]`` and observed information ``[N, N]``."""
        win = 1 / (1 + np.exp(np.clip(strengths[None, :] - strengths[:, None], -700, 700)))
        gradient = (self.points - self.matches * win).sum(1) - self.precision * strengths - strengths.sum()
        weights = self.matches * win * (1 - win)
        information = np.diag(weights.sum(1) + self.precision) - weights + 1.0
        return gradient, information

    def maximum(self, contrast: np.ndarray | None = None, start: np.ndarray | None = None) -> np.ndarray:
        """Return the best strengths; with a contrast among those that have the start's value of it."""
        count = len(self.points)
        strengths = np.zeros(count) if start is None else start
        value = self.value(strengths)

        for _ in range(_STEPS):
            gradient, information = self.slopes(strengths)
            if contrast is None:
                step = np.linalg.solve(information, gradient)
            else:
                # no step along the contrast: Lagrange's condition in the last row
                bordered = np.block([[information, contrast[:, None]], [contrast[None, :], np.zeros((1, 1))]])
                step = np.linalg.solve(bordered, np.append(gradient, 0.0))[:count]

            size, new = 1.0, self.value(strengths + step)
            while new < value - 1e-12 * abs(value) and size > 1e-6:
                size /= 2
                new = self.value(strengths + size * step)
            strengths, value = strengths + size * step, new
            if np.abs(step).max() < _CLOSE:
                break

        return strengths


def _end(league: _League, contrast: np.ndarray, best: np.ndarray, sign: int) -> float:
    """Return where twice the loss of log-likelihood reaches 1.96 squared, on one side of the estimate.

    What is searched is z = the root of twice the loss, which grows nearly in proportion: Newton's method with
    a bracket, from the standard error of the observed information.
    """
    top, middle = league.value(best), float(contrast @ best)
    direction = np.linalg.solve(league.slopes(best)[1], contrast)
    variance = float(contrast @ direction)

    inside, outside = 0.0, math.inf
    distance = Z95 * math.sqrt(variance)
    strengths = best
    for _ in range(60):
        wanted = middle + sign * distance
        # the value asked for, reached in the direction in which the likelihood loses least
        start = strengths + direction * (wanted - float(contrast @ strengths)) / variance
        strengths = league.maximum(contrast, start)
        z = math.sqrt(max(0.0, 2 * (top - league.value(strengths))))
        if abs(z - Z95) < 1e-7:
            break

        inside, outside = (distance, outside) if z < Z95 else (inside, distance)
        slope = abs(float(direction @ league.slopes(strengths)[0])) / variance / z if z else 0.0
        following = distance + (Z95 - z) / slope if slope else 2 * distance
        if not inside < following < outside:
            following = (inside + outside) / 2 if math.isfinite(outside) else 2 * distance
        distance = following

    return middle + sign * distance
