"""A player of an embedded scene that notes the return of every episode itself, whoever trains on it."""

from __future__ import annotations

import csv
import itertools
import math
import os
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

ROOT = Path(__file__).resolve().parents[1]
EPISODES = "episodes.csv"


def make_player(scene: str, folder: Path) -> Path:
    """Write an executable that plays the scene and notes its episodes; return its path."""
    path = folder / f"{scene}.x86_64"
    words = [
        "env",
        f"PYTHONPATH={os.pathsep.join([str(ROOT / 'scripts'), str(ROOT)])}",
        f"PEER_SCENE={scene}",
        f"PEER_EPISODES={folder / EPISODES}",
        *[sys.executable, "-m", "mappo_unity.player", "recorded_player:recorded_scene"],
    ]
    path.write_text(f'#!/bin/sh\nexec {shlex.join(words)} "$@"\n')
    path.chmod(0o755)
    return path


def recorded_scene(seed: int = 0) -> Any:
    """Return the scene PEER_SCENE, which notes its episodes in the file PEER_EPISODES; Unity's areas."""
    from mappo_unity.scenes import make_scene

    env = make_scene(os.environ["PEER_SCENE"], seed=seed)
    notes = Episodes(env, Path(os.environ["PEER_EPISODES"]))
    env.step, env.reset = notes.step, notes.reset  # type: ignore[method-assign]
    return env


def places(path: Path) -> Iterator[Path]:
    """Yield where the players of a run note their episodes: the path, and those with _1, _2 ... behind it."""
    yield path
    yield from (path.with_stem(f"{path.stem}_{count}") for count in itertools.count(1))


def noted(path: Path) -> list[tuple[int, float, float]]:
    """Return decisions so far, return and second (Unix) of every episode that a run's players noted.

    A player that was started again counts on from the last episode of the one before it.
    """
    episodes: list[tuple[int, float, float]] = []
    for place in itertools.takewhile(Path.exists, places(path)):
        before = episodes[-1][0] if episodes else 0
        with open(place, newline="") as file:
            for decisions, own, group, *at_s in csv.reader(file):  # older files have no seconds
                value, second = float(own) + float(group), float(at_s[0]) if at_s else math.nan
                episodes.append((before + int(decisions), value, second))
    return episodes


class Episodes:
    """Write a line for each episode of a BaseEnv: decisions so far, own and group return, seconds (Unix)."""

    def __init__(self, env: Any, path: Path) -> None:
        self._env, self._step, self._reset = env, env.step, env.reset
        self._decisions = 0
        self._file = self._open(path)
        self._earned: dict[int, tuple[float, float]] = {}

    def step(self) -> None:
        """Step the environment and note what it paid."""
        self._step()
        self._note()

    def reset(self) -> None:
        """Reset the environment; episodes under way are forgotten."""
        self._reset()
        self._earned.clear()
        self._note()

    def _open(self, path: Path) -> TextIO:
        """Open the first place that is free: what a player noted outlasts its crash and a second player."""
        for place in places(path):
            with suppress(FileExistsError):
                return open(place, "x", buffering=1)
        raise AssertionError("places never end")

    def _note(self) -> None:
        for name in self._env.behavior_specs:
            decision, terminal = self._env.get_steps(name)
            for steps in (terminal, decision):
                columns = steps.agent_id, steps.reward, steps.group_reward
                for agent, reward, group_reward in zip(*(column.tolist() for column in columns)):
                    own, group = self._earned.get(agent, (0.0, 0.0))
                    self._earned[agent] = own + reward, group + group_reward
                if steps is terminal:
                    for agent in steps.agent_id.tolist():
                        own, group = self._earned.pop(agent)
                        self._file.write(f"{self._decisions},{own:.6g},{group:.6g},{time.time():.2f}\n")
            self._decisions += len(decision)
