#!/usr/bin/env python3
"""Count the areas of DungeonEscape that a policy frees: over all, by quarter turn, and by the dragon's speed.

    scripts/check_dungeon.py --policy DungeonEscape.onnx [--episodes 800] [--num-areas 64] [--seed 0]
    scripts/check_dungeon.py --policy random [--sight]

An episode of an area ends when the door is unlocked (freed), the dragon or the last player reaches the
portal, or at the time limit. docs/scenes/DungeonEscape.md has the figures of Unity's policy.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from play_scene import play_until
from run_script import positive, run_script

from mappo_unity.policies.evaluate import open_policy
from mappo_unity.scenes.core.ground import TICK_S
from mappo_unity.scenes.dungeon_escape.layout import DRAGON, DRAGON_START_YAW, NUM_AGENTS
from mappo_unity.scenes.dungeon_escape.scene import DungeonEscape
from mappo_unity.scenes.dungeon_escape.sight import DRAGON_TAG, EYES, KEY_TAG

SPEEDS, SPEED_STEP = (1, 3, 5), 2  # m/s


class Outcome(NamedTuple):
    """How an area's episode went."""

    turn: int
    """Quarter turn of the platform."""
    speed: float
    """Of the dragon, m/s."""
    seconds: float
    freed: bool
    looks: int
    """Observations of players while the dragon lives."""
    sightings: int
    """Those that have it, or the key before it, on a ray."""


class CountingDungeon(DungeonEscape):
    """Note how every area's episode ended, in `outcomes`."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.outcomes: list[Outcome] = []
        self._turn = np.zeros(self.num_areas, int)
        self._freed = np.zeros(self.num_areas, bool)
        self._looks, self._sightings = np.zeros((2, self.num_areas), int)

    def observe(self, behavior: int, slots: np.ndarray) -> list[np.ndarray]:
        sensors = super().observe(behavior, slots)
        rays = sensors[1].reshape(len(slots), EYES.num_rays, -1)
        sees = (rays[:, :, [DRAGON_TAG, KEY_TAG]] > 0).any(axis=(1, 2))
        areas = slots // NUM_AGENTS
        lives = self.room.present[areas, DRAGON]
        np.add.at(self._looks, areas, lives)
        np.add.at(self._sightings, areas, lives & sees)
        return sensors

    def _unlock(self, areas: np.ndarray) -> None:
        self._freed[areas] = True
        super()._unlock(areas)

    def _reset_areas(self, areas: np.ndarray) -> None:
        if self.started:
            course = self._turn, self.room.dragon_speed, self.timer * TICK_S
            parts = *course, self._freed, self._looks, self._sightings
            self.outcomes += map(Outcome, *(part[areas].tolist() for part in parts))
        self._freed[areas] = False
        self._looks[areas] = self._sightings[areas] = 0
        super()._reset_areas(areas)
        yaw = self.room.thing_yaw[areas, DRAGON]
        self._turn[areas] = np.abs(yaw[:, None] - DRAGON_START_YAW).argmin(axis=1)


def main() -> None:
    """Play, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", required=True, help="an ONNX file, a run, or random")
    parser.add_argument("--episodes", type=positive, default=800, help="of areas, at least")
    parser.add_argument("--num-areas", type=positive, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--sight", action="store_true", help="also how often players see the fastest dragons")
    options = parser.parse_args()
    torch.manual_seed(options.seed)  # a checkpoint's policy draws from it
    env = CountingDungeon(num_areas=options.num_areas, seed=options.seed)
    policy = open_policy(options.policy, deterministic=False, seed=options.seed, option="policy")
    play_until(lambda: len(env.outcomes) >= options.episodes, env, policy)
    turn, speed, seconds, freed, looks, sightings = map(np.array, zip(*env.outcomes, strict=True))
    print(f"{Path(options.policy).name}, seed {options.seed}: {freed.mean():.1%} of {len(freed)} areas freed")
    for number in range(4):
        of_turn = freed[turn == number]
        print(f"  quarter turn {number}: {of_turn.mean():.3f} of {len(of_turn)}")

    # At quarter turns 2 and 3 the portal is 12.1 m from the dragon, else 22.8 m.
    for way, ways in (("short", turn >= 2), ("long", turn < 2)):
        for slowest in SPEEDS:
            rows = ways & (speed >= slowest) & (speed < slowest + SPEED_STEP)
            share, lasting = (values[rows].mean() if rows.any() else np.nan for values in (freed, seconds))
            speeds = f"{slowest} to {slowest + SPEED_STEP} m/s"
            print(f"  {way} way, dragon at {speeds}: {share:.3f} of {rows.sum()}, {lasting:.1f} s each")

    if not options.sight:
        return
    fastest = (turn >= 2) & (speed >= SPEEDS[-1])
    for outcome, rows in (("freed", fastest & freed), ("lost", fastest & ~freed)):
        seen = sightings[rows].sum() / max(looks[rows].sum(), 1)
        print(f"  short way, fastest dragons, {outcome}: seen in {seen:.2f} of {looks[rows].sum()} looks")


if __name__ == "__main__":
    run_script(main)
