"""Series of matches against a random side while a policy learns: when they are played, what they said."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.schema import Config
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.learning.actor_critic import UnityActor
from mappo_unity.policies.layouts import sides_of
from mappo_unity.policies.matches import Score, play_matches
from mappo_unity.policies.policy import ActorPolicy, RandomPolicy
from mappo_unity.runs.folder import PLAYERS


class MatchSeries:
    """Play a series every `matches.interval` agent decisions, and one when `max_steps` are done.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        behaviors: full behavior names of the environment.

    Attributes: `two_sided`, whether the environment has two sides; `points`, of the newest series: the share
    of its matches won, draws counted half; None: none has been played; `said`, a line about it.

    Raises:
        ConfigError: series are wanted, but there are not two sides.
    """

    def __init__(self, cfg: Config, folder: Path, behaviors: Iterable[str]) -> None:
        names = list(behaviors)
        self._cfg, self._folder = cfg, folder
        self._played_at = 0
        self.points: float | None = None
        self.said = ""

        self.two_sided = len(sides_of(names)) == 2
        if cfg.matches.interval is not None and not self.two_sided:
            raise ConfigError(
                f"matches.interval={cfg.matches.interval}: matches need an environment with two sides (team "
                f"ids), and {cfg.env.name} has {', '.join(names)}; matches.interval=null plays none"
            )

    def is_due(self, agent_steps: int) -> bool:
        """Return whether a series is to be played now."""
        last = self._cfg.matches.interval is not None and agent_steps >= self._cfg.max_steps
        return last or self._interval_is_over(agent_steps)

    def play(
        self, agent_steps: int, layout: dict[str, Any], actors: dict[str, UnityActor]
    ) -> dict[str, float]:
        """Play a series and return its figures; the random numbers of training stay untouched."""
        cfg = self._cfg
        policy = ActorPolicy(layout, actors, False, "the policy")
        # `torch.manual_seed` seeds the GPU, too, where the policy draws its actions
        cuda = [torch.device(cfg.device)] if cfg.device.startswith("cuda") else []
        with torch.random.fork_rng(devices=cuda):
            torch.manual_seed(cfg.seed + agent_steps)
            # a folder of its own: the run's players log under the same names
            make_env = make_env_function(cfg.env, self._folder / PLAYERS / "matches")
            seed = (cfg.seed + agent_steps) % 2**31
            scores = play_matches(make_env, policy, RandomPolicy(seed), cfg.matches.count, seed)

        if self._interval_is_over(agent_steps):  # the last series leaves the rhythm of a longer run alone
            self._played_at = agent_steps

        total = sum(scores.values(), Score())
        matches = max(1, total.matches)
        self.points = (total.wins + 0.5 * total.draws) / matches
        self.said = (
            f"{agent_steps:,} steps: of {matches} matches against a random side "
            f"{total.wins} won, {total.draws} drawn, {total.losses} lost"
        )

        return {
            "win_rate_vs_random": total.figures()["won_of_decided"],
            "draw_rate_vs_random": total.draws / matches,
            "match_decisions_vs_random": total.decisions / matches,
        }

    def score(self, agent_steps: int) -> float:
        """Return what a two-sided run's best checkpoint is chosen by; before any series newer is better."""
        # below any points, which are 0 to 1, and a little higher with every step
        return agent_steps * 1e-12 - 1.0 if self.points is None else self.points

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        return {"played_at": self._played_at, "points": self.points}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self._played_at, self.points = state["played_at"], state["points"]

    def _interval_is_over(self, agent_steps: int) -> bool:
        interval = self._cfg.matches.interval
        return interval is not None and agent_steps - self._played_at >= interval
