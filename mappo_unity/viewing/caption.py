"""The caption of a video: one line with the scene, the time and what was earned so far."""

from __future__ import annotations

import importlib
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from mlagents_envs.base_env import DecisionSteps, TerminalSteps

from mappo_unity.keys import team_id

TEXT_SHARE = 1 / 24  # height of the text, of the picture's height
SMALLEST = 12  # height of the text in pixels, for tiny pictures
MARGIN, GAP = 0.5, 1.3  # around the line and between its parts, in heights of the text
DIMMED = 0.35  # what the line leaves of the picture's brightness behind it
Steps = Mapping[str, tuple[DecisionSteps, TerminalSteps]]


class Tally:
    """Add up what the agents of one area earn.

    Args:
        goals: the caption tells goals, not returns.
        agent: id of the agent that the caption is about; None: the mean of all.
    """

    def __init__(self, goals: bool = False, agent: int | None = None) -> None:
        self.goals = [0, 0] if goals else None
        """Of team 0 (blue) and of team 1 (purple)."""
        self.returns: list[float] = []
        """Of every agent episode that ended."""
        self._agent = agent
        self._running: dict[tuple[str, int], float] = {}
        self._ended: list[float] = []  # returns of agents that have left the running episode
        self._last: float | None = None  # return of the episode before

    def add(self, steps: Steps) -> dict[str, list[int]]:
        """Count the records of one exchange; return which agents begin an episode, by behavior."""
        # All ends before all beginnings: WallJump's agent ends in one behavior and begins in the other.
        for name, (_, terminals) in steps.items():
            self._count_goal(name, terminals)
            for agent, reward in zip(terminals.agent_id.tolist(), _rewards(terminals)):
                if (name, agent) in self._running:
                    self.returns.append(self._running.pop((name, agent)) + reward)
                    if self._agent in (None, agent):
                        self._ended.append(self.returns[-1])
        if self._ended and not self._shown():
            self._last = float(np.mean(self._ended))
            self._ended.clear()

        begun: dict[str, list[int]] = {}
        for name, (decisions, _) in steps.items():
            agents = decisions.agent_id.tolist()
            begun[name] = [agent for agent in agents if (name, agent) not in self._running]
            for agent, reward in zip(agents, _rewards(decisions)):
                self._running[name, agent] = self._running.get((name, agent), 0.0) + reward
        return begun

    def score(self) -> list[str]:
        """Return goals, or the return of the running episode so far and that of the episode before."""
        if self.goals is not None:
            return [f"blue {self.goals[0]} : {self.goals[1]} purple"]

        so_far = [*self._ended, *self._shown()] or [0.0]
        before = [] if self._last is None else [f"last episode {_short(self._last)}"]
        return [f"return {_short(float(np.mean(so_far)))}", *before]

    def _shown(self) -> list[float]:
        """Return the returns so far of those the caption is about."""
        return [total for (_, agent), total in self._running.items() if self._agent in (None, agent)]

    def _count_goal(self, behavior: str, terminals: TerminalSteps) -> None:
        """Count a goal against the team whose episode ends with a loss: a time limit is none."""
        lost = ~np.asarray(terminals.interrupted, bool) & (terminals.group_reward < 0)
        if self.goals is not None and lost.any():
            self.goals[1 - team_id(behavior)] += 1


def _rewards(steps: DecisionSteps | TerminalSteps) -> list[float]:
    total: list[float] = (steps.reward + steps.group_reward).tolist()
    return total


def _short(figure: float) -> str:
    """Return a figure as short as a caption needs it."""
    text = f"{figure:.2f}" if abs(figure) < 100 else f"{figure:.0f}"
    return "0.00" if text == "-0.00" else text


def draw_caption(frame: np.ndarray, parts: Sequence[str]) -> None:
    """Draw a line over the lower edge of a picture uint8 [height, width, 3], in place.

    Args:
        frame: the picture.
        parts: from left to right: scene, time, score, more; where they do not fit, the last goes first,
            then the scene, then the time.
    """
    height, width = frame.shape[:2]
    size = max(SMALLEST, round(height * TEXT_SHARE))
    font, margin, gap = _font(size), round(MARGIN * size), round(GAP * size)

    # Digits count as zeros, so that nothing shivers while the figures change.
    wide = {part: font.getlength(re.sub(r"\d", "0", part)) for part in parts}
    for kept in (parts, parts[:3], parts[1:3], parts[2:3]):
        if 2 * margin + sum(wide[part] + gap for part in kept) - gap <= width:
            break

    strip = frame[-(size + 2 * margin) :]
    image = importlib.import_module("PIL.Image").fromarray((strip * np.float32(DIMMED)).astype(np.uint8))
    draw = importlib.import_module("PIL.ImageDraw").Draw(image)
    left = float(margin)
    for part in kept:
        draw.text((round(left), strip.shape[0] / 2), part, fill="white", font=font, anchor="lm")
        left += wide[part] + gap
    strip[:] = np.asarray(image)


@lru_cache
def _font(size: int) -> Any:
    """Return Pillow's own font, the same on every machine."""
    return importlib.import_module("PIL.ImageFont").load_default(size)
