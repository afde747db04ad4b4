"""A player of an embedded scene that notes the return of every episode itself, whoever trains on it."""

from __future__ import annotations

import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def make_player(scene: str, folder: Path) -> Path:
    """Write an executable that plays the scene and notes its episodes; return its path."""
    path = folder / f"{scene}.x86_64"
    words = [
        "env",
        f"PYTHONPATH={os.pathsep.join([str(ROOT / 'scripts'), str(ROOT)])}",
        f"PEER_SCENE={scene}",
        f"PEER_EPISODES={folder / 'episodes.csv'}",
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


class Episodes:
    """Write a line for each episode of a BaseEnv: decisions so far, own and group return, seconds (Unix)."""

    def __init__(self, env: Any, path: Path) -> None:
        self._env, self._step, self._reset = env, env.step, env.reset
        self._decisions = 0
        self._file = open(path, "w", buffering=1)
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
