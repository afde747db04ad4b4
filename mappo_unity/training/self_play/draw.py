"""Who meets whom: opponents drawn for the teams of both sides."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mappo_unity.config.schema import OpponentDraw, SelfPlayConfig
from mappo_unity.keys import LEARNER, policy_name
from mappo_unity.training.self_play.pool import Record

LATEST = -2
"""The number of an opponent that plays the newest weights without being learnt from."""


def draw_teams(
    rng: np.random.Generator,
    cfg: SelfPlayConfig,
    sides: Mapping[int, list[str]],
    teams: Mapping[str, int],
    records: Mapping[str, Mapping[int, Record]],
    learning: int | None,
) -> dict[str, np.ndarray]:
    """Return who plays each team, int64 ``[G]`` by behavior.

    The teams that stand at the same place in the lists of both sides play each other.

    Args:
        rng: what is drawn with.
        cfg: the options.
        sides: behaviors of each side.
        teams: how many teams G each behavior has.
        records: of the opponents there are, by behavior and number; none of a behavior that has no opponents.
        learning: the side that learns; None: both do, and in every match against a past opponent one of them,
            by lot.
    """
    count = max(teams.values())
    latest = rng.random(count) < cfg.play_against_latest_model_ratio
    order = np.array(sorted(sides))
    learns = order[rng.integers(0, len(order), count)] if learning is None else np.full(count, learning)

    players: dict[str, np.ndarray] = {}
    met: dict[str, np.ndarray] = {}  # by policy name: what both its sides meet is one forward pass
    for side in order:
        for behavior in sides[int(side)]:
            everybody = np.full(count, LEARNER)
            if records[behavior]:
                name = policy_name(behavior)
                if name not in met:
                    met[name] = _draw(rng, cfg, records[behavior])
                past = rng.choice(met[name], count)
                everybody = np.where(latest, LEARNER if learning is None else LATEST, past)
                everybody[learns == side] = LEARNER
            players[behavior] = everybody[: teams[behavior]].astype(np.int64)
    return players


def _draw(rng: np.random.Generator, cfg: SelfPlayConfig, records: Mapping[int, Record]) -> np.ndarray:
    """Return `num_opponents` numbers; one that is drawn twice is met twice as often."""
    numbers = np.array(sorted(records))
    weights = np.ones(len(numbers))
    if cfg.opponents is OpponentDraw.hardest:
        # prioritised fictitious self-play: O. Vinyals et al., Nature 575, 2019, p. 350-354
        weights = np.array([(1 - records[number].share_lost) ** 2 for number in numbers.tolist()])
    return rng.choice(numbers, cfg.num_opponents, p=weights / weights.sum())
