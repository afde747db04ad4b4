#!/usr/bin/env python3
"""Show what figures of Walker earn and where they fall: by the goal's speed, by their turn at the start, and
by how long the target has been where it is.

    scripts/check_walker.py --policy RUN [--episodes 8] [--num-areas 64] [--deterministic] [--seed 0]

Every area plays the same number of episodes, so that short ones do not count more often than long ones.
What a fall takes away (the last decision's reward, for -1) is not counted.
"""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

import numpy as np
import torch
from play_scene import play_until
from run_script import positive, run_script

from mappo_unity.policies.evaluate import open_policy
from mappo_unity.scenes.walker import body
from mappo_unity.scenes.walker.scene import MAX_SPEED, Walker, forward

SPEED_STEP = 1.0  # m/s
TURN_STEP = 45.0  # degrees
MOVED_STEP, MOVED_MOST = 0.5, 4.0  # seconds since the target was elsewhere, and the most told apart
TICKS_A_DECISION = Walker.DECISION_PERIOD


class Outcome(NamedTuple):
    """How an episode of a figure went."""

    goal_speed: float
    """m/s."""
    turn: float
    """Degrees between where the figure looked at first and its target."""
    decisions: float
    earned: float
    """Sum of the rewards of its ticks."""
    way: float
    """Of the hips over the ground, towards the target, m."""
    targets: int
    """How many it reached."""
    moved: int
    """For how many `MOVED_STEP` the target had stood where it stands: since it was reached, or the start."""
    fallen_on: str
    """What hit the ground first; empty where the time was up."""


class WatchedWalker(Walker):
    """Note how every figure's episode went, in the `outcomes` of its area."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.outcomes: list[list[Outcome]] = [[] for _ in range(self.num_areas)]
        self.lived = np.zeros(round(MOVED_MOST / MOVED_STEP), int)  # ticks of all figures, by `moved`
        self._turn, self._earned, self._way, self._targets, self._moved_at = np.zeros((5, self.num_areas))

    def fixed_update(self) -> None:
        """Add up what the tick earns, and the way towards the target."""
        before = self.agents.reward.copy()
        super().fixed_update()
        self._earned += self.agents.reward - before
        self._way += (self.physics.velocity[:, 0] * self.cube_forward).sum(axis=1) * body.TICK_S
        np.add.at(self.lived, self._moved(), 1)

    def begin_episode(self, slots: np.ndarray) -> None:
        """Count from 0."""
        super().begin_episode(slots)
        looks = (forward(self.physics.rotation[slots, 0]) * self.cube_forward[slots]).sum(axis=1)
        self._turn[slots] = np.degrees(np.arccos(np.clip(looks, -1, 1)))
        self._earned[slots] = self._way[slots] = self._targets[slots] = self._moved_at[slots] = 0

    def end_episode(self, slots: np.ndarray, interrupted: bool = False) -> None:
        """Note how it went; the second hit of a tick ends an episode without any."""
        for area in self.agents.enabled_slots(slots):
            ticks = self.agents.step_count[area]
            if not ticks:
                continue

            hits = np.flatnonzero(self.touching[area] & body.ENDS)
            self.outcomes[area].append(
                Outcome(
                    goal_speed=self.goal_speed[area],
                    turn=self._turn[area],
                    decisions=ticks / TICKS_A_DECISION,
                    earned=self._earned[area],
                    way=self._way[area],
                    targets=self._targets[area],
                    moved=self._moved()[area],
                    fallen_on="" if interrupted else body.PARTS[hits[0]].name,
                )
            )
        super().end_episode(slots, interrupted)

    def _moved(self) -> np.ndarray:
        """int64 ``[areas]``, see `Outcome.moved`."""
        since = (self.agents.step_count - self._moved_at) * body.TICK_S / MOVED_STEP
        return np.minimum(since.astype(int), len(self.lived) - 1)

    def _place_targets(self, areas: np.ndarray) -> None:
        self._targets[areas] += 1
        self._moved_at[areas] = self.agents.step_count[areas]
        super()._place_targets(areas)


def main() -> None:
    """Play, and print a table by speed, one by turn, and what hit the ground."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", required=True, help="an ONNX file, a run, or random")
    parser.add_argument("--episodes", type=positive, default=8, help="of each area")
    parser.add_argument("--num-areas", type=positive, default=64)
    parser.add_argument("--deterministic", action="store_true", help="without sampling")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()

    torch.manual_seed(options.seed)  # a checkpoint's policy draws from it
    torch.set_num_threads(1)
    env = WatchedWalker(num_areas=options.num_areas, seed=options.seed)
    policy = open_policy(
        options.policy, deterministic=options.deterministic, seed=options.seed, option="policy"
    )

    play_until(lambda: min(map(len, env.outcomes)) >= options.episodes, env, policy)
    report([outcome for of_area in env.outcomes for outcome in of_area[: options.episodes]])
    report_turns([outcome for of_area in env.outcomes for outcome in of_area], env.lived)


def report(outcomes: list[Outcome]) -> None:
    """Print the tables."""
    columns = {name: np.array([getattr(o, name) for o in outcomes]) for name in Outcome._fields}
    fell = columns["fallen_on"] != ""
    print(f"{'':>14}  episodes  earned  decisions  a decision   m/s  targets  fell")

    def row(title: str, rows: np.ndarray) -> None:
        earned, decisions, way, targets = (
            columns[name][rows].mean() for name in ("earned", "decisions", "way", "targets")
        )
        speed = way / (decisions * TICKS_A_DECISION * body.TICK_S)
        print(
            f"{title:>14}  {rows.sum():8}  {earned:6.0f}  {decisions:9.0f}  {earned / decisions:10.2f}  "
            f"{speed:4.2f}  {targets:7.1f}  {fell[rows].mean():4.0%}"
        )

    row("all", np.ones(len(outcomes), bool))
    for name, unit, step, most in (
        ("goal_speed", "m/s", SPEED_STEP, MAX_SPEED),
        ("turn", "deg", TURN_STEP, 180),
    ):
        for low in np.arange(0, most, step):
            rows = (columns[name] >= low) & (columns[name] < low + step)
            if rows.any():
                row(f"{low:g} to {low + step:g} {unit}", rows)

    parts, counts = np.unique(columns["fallen_on"][fell], return_counts=True)
    most_first = sorted(zip(counts, parts, strict=True), reverse=True)
    print("fell on:", ", ".join(f"{part} {count}" for count, part in most_first))


def report_turns(outcomes: list[Outcome], lived: np.ndarray) -> None:
    """Print how often figures fall, by how long the target has been where it is.

    Args:
        outcomes: of all episodes that ended.
        lived: ticks of all figures by `Outcome.moved`.
    """
    falls = np.bincount([o.moved for o in outcomes if o.fallen_on], minlength=len(lived))
    print("target stands for  falls  of all  in 1,000 decisions")
    for number, (count, ticks) in enumerate(zip(falls, lived, strict=True)):
        low = number * MOVED_STEP
        title = f"{low:g} s or more" if number == len(lived) - 1 else f"{low:g} to {low + MOVED_STEP:g} s"
        rate = 1000 * count * TICKS_A_DECISION / max(ticks, 1)
        print(f"{title:>17}  {count:5}  {count / max(falls.sum(), 1):6.0%}  {rate:18.1f}")


if __name__ == "__main__":
    run_script(main)
