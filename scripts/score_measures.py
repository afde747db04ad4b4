"""What scripts/score_table.py measures in each scene, and what it should come to."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Figure = tuple[float, float]
"""A value and its standard error."""


@dataclass(frozen=True)
class Measure:
    """A figure of mappo-eval, and its target.

    Attributes:
        scene: preset whose policy is measured.
        name: what the figure is.
        figure: value and standard error from the JSON line of mappo-eval.
        target: what the preset should reach.
        column: of metrics.csv, whose curve shows how training came there.
        opponent: None, "random", "unity", or "own": the same policy plays the other side, too.
        is_lower_better: for times.
        episodes: or matches, that the figure is of.
    """

    scene: str
    name: str
    figure: Callable[[dict[str, Any]], Figure]
    target: float
    column: str = "return_mean"
    opponent: str | None = None
    is_lower_better: bool = False
    episodes: int = 400

    def is_reached(self, value: float) -> bool:
        """Return whether a value meets the target."""
        return value <= self.target if self.is_lower_better else value >= self.target


def mean_return(said: dict[str, Any]) -> Figure:
    """The mean return of an agent's episode."""
    return said["mean_return"], said["stderr"]


def group_return(said: dict[str, Any]) -> Figure:
    """The mean return of a group; that of its members is the same in scenes that pay nobody alone."""
    return said.get("mean_group_return", said["mean_return"]), said["stderr"]


def behavior_return(name: str) -> Callable[[dict[str, Any]], Figure]:
    """The mean return of one of several behaviors."""

    def figure(said: dict[str, Any]) -> Figure:
        return next(mean_return(own) for key, own in said["behaviors"].items() if key.startswith(name))

    return figure


def share_won(said: dict[str, Any]) -> Figure:
    """The share won of the decided matches; the error is a quarter of its 95 % interval."""
    width = said["won_of_decided_high95"] - said["won_of_decided_low95"]
    return said["won_of_decided"], width / 4


def as_strikers(said: dict[str, Any]) -> dict[str, Any]:
    """What came of the matches as the strikers: matches, wins, mean_decisions and so on."""
    own: dict[str, Any] = next(score for side, score in said["as"].items() if side.startswith("Striker"))
    return own


def decisions_to_goal(said: dict[str, Any]) -> Figure:
    """Decisions of a match as the strikers; the error is not known."""
    return as_strikers(said)["mean_decisions"], math.nan


MEASURES = (
    Measure("3DBall", "return", mean_return, 99.5),
    Measure("Basic", "return", mean_return, 0.93),
    Measure("Hallway", "return", mean_return, 0.92),
    # The first episodes of its areas are harder than what follows; of many episodes they weigh little.
    Measure(
        *("WallJump", "SmallWallJump", behavior_return("Small"), 0.94, "SmallWallJump?team=0/return_mean"),
        episodes=2000,
    ),
    Measure(
        *("WallJump", "BigWallJump", behavior_return("Big"), 0.86, "BigWallJump?team=0/return_mean"),
        episodes=2000,
    ),
    Measure("Pyramids", "return", mean_return, 1.78),
    Measure("PushBlock", "return", mean_return, 4.7),
    # Those who die for the group do not share in it: a policy that frees 96 % of the areas earns 0.60.
    Measure("DungeonEscape", "group return", group_return, 0.61, "group_return_mean"),
    Measure("GridFoodCollector", "return", mean_return, 65.0),
    Measure("Walker", "return", mean_return, 1000.0),
    Measure("CooperativePushBlock", "group return", group_return, 11.0, "group_return_mean"),
    Measure("SoccerTwos", "won against random", share_won, 0.98, "win_rate_vs_random", "random"),
    Measure("SoccerTwos", "won against Unity's policy", share_won, 0.5, "win_rate_vs_random", "unity"),
    Measure(
        *("StrikersVsGoalie", "decisions to a goal, random goalie", decisions_to_goal, 35.0),
        column="Striker?team=0/match_decisions_vs_random",
        opponent="random",
        is_lower_better=True,
    ),
    Measure(
        *("StrikersVsGoalie", "decisions to a goal, own goalie", decisions_to_goal, 100.0),
        column="Striker?team=0/match_decisions_vs_random",
        opponent="own",
        episodes=800,
    ),
)


def measures_of(scene: str) -> list[Measure]:
    """Return what is measured in a scene."""
    return [measure for measure in MEASURES if measure.scene == scene]
