"""Series of matches against a random side while a policy learns: when they are played, what they said.

In: the run's options, the actors. Out: figures for the metrics, the newest win rate. Knows no learner.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from mappo_unity.backend import make_env_function
from mappo_unity.config import Config
from mappo_unity.matches import Score, play_matches
from mappo_unity.models import UnityActor
from mappo_unity.policies import ActorPolicy, RandomPolicy


class MatchSeries:
    """Play a series every `matches.interval` agent decisions, and after the last one.

    Attributes: `win_rate`, won of decided matches of the newest series; NaN: none yet, or all drawn.
    """

    def __init__(self, cfg: Config, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._played_at = 0
        self.win_rate = math.nan

    def is_due(self, agent_steps: int) -> bool:
        """Return whether a series is to be played now."""
        last = self._cfg.matches.interval is not None and agent_steps >= self._cfg.max_steps
        return last or self._interval_is_over(agent_steps)

    def play(
        self, agent_steps: int, layout: dict[str, Any], actors: dict[str, UnityActor]
    ) -> dict[str, float]:
        """Play a series and return its figures; the random numbers of training stay untouched."""
        cfg = self._cfg
        if self._interval_is_over(agent_steps):  # the last series leaves the rhythm of a longer run alone
            self._played_at = agent_steps
        player = ActorPolicy(layout, actors, False, "the policy")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(cfg.seed + agent_steps)
            make_env = make_env_function(cfg.env, self._folder / "players" / "matches")
            seed = (cfg.seed + agent_steps) % 2**31
            scores = play_matches(make_env, player, RandomPolicy(seed), cfg.matches.count, seed)
        total = sum(scores.values(), Score())
        self.win_rate = total.figures()["won_of_decided"]
        return {
            "win_rate_vs_random": self.win_rate,
            "draw_rate_vs_random": total.draws / max(1, total.matches),
            "match_decisions_vs_random": total.decisions / max(1, total.matches),
        }

    def _interval_is_over(self, agent_steps: int) -> bool:
        interval = self._cfg.matches.interval
        return interval is not None and agent_steps - self._played_at >= interval

    def state_dict(self) -> dict[str, float]:
        """Return what continuing needs."""
        return {"played_at": self._played_at, "win_rate": self.win_rate}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore what `state_dict` returned."""
        self._played_at, self.win_rate = int(state["played_at"]), state["win_rate"]
