"""Series of matches against a random side while a policy learns: when they are played, what they said.

What a policy scores is the lower end of Wilson's 95 % interval for its share p of the points of n matches,
``(p + z^2/2n - z sqrt(p (1 - p)/n + z^2/4n^2)) / (1 + z^2/n)`` with z = 1.96 (E. B. Wilson, Probable
inference, the law of succession, and statistical inference, J. Am. Stat. Assoc. 22, 1927, p. 209-212). The
matches are those of the newest series together: the best of many short series is the luckiest one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.schema import Config, EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.policies.layouts import sides_of
from mappo_unity.policies.matches import Score, play_matches, wilson
from mappo_unity.policies.policy import ActorPolicy, RandomPolicy
from mappo_unity.runs.folder import PLAYERS

POOLED = 4  # series, the newest ones, that a score is taken from
DIGITS = 9  # of a score: equal results give equal scores, whatever was rounded on the way


class MatchSeries:
    """Play a series every `matches.interval` agent decisions, and one when `max_steps` are done.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        behaviors: full behavior names of the environment.

    Attributes: `two_sided`, whether the environment has two sides; `pool`, of each of the newest four series,
    the oldest first: its points, a win counted 1 and a draw 1/2, and its matches; `said`, a line about one.

    Raises:
        ConfigError: series are wanted, but there are not two sides.
    """

    def __init__(self, cfg: Config, folder: Path, behaviors: Iterable[str]) -> None:
        names = list(behaviors)
        self._cfg, self._folder = cfg, folder
        self._played_at = 0
        self.pool: list[tuple[float, int]] = []
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
        self, env: EnvConfig, agent_steps: int, layout: dict[str, Any], actors: dict[str, UnityActor]
    ) -> dict[str, float]:
        """Play a series and return its figures; the random numbers of training stay untouched."""
        cfg = self._cfg
        policy = ActorPolicy(layout, actors, False, "the policy")
        # `torch.manual_seed` seeds the GPU, too, where the policy draws its actions
        cuda = [torch.device(cfg.device)] if cfg.device.startswith("cuda") else []
        with torch.random.fork_rng(devices=cuda):
            torch.manual_seed(cfg.seed + agent_steps)
            # a folder of its own: the run's players log under the same names
            make_env = make_env_function(env, self._folder / PLAYERS / "matches")
            seed = (cfg.seed + agent_steps) % 2**31
            scores = play_matches(make_env, policy, RandomPolicy(seed), cfg.matches.count, seed)

        if self._interval_is_over(agent_steps):  # the last series leaves the rhythm of a longer run alone
            self._played_at = agent_steps

        total = sum(scores.values(), Score())
        matches = max(1, total.matches)
        self.pool = [*self.pool, (total.wins + 0.5 * total.draws, total.matches)][-POOLED:]
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
        # below any share, which is 0 to 1, and a little higher with every step
        return _sure_share(self.pool) if self.pool else agent_steps * 1e-12 - 1.0

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        return {"played_at": self._played_at, "pool": [list(series) for series in self.pool]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned, or an older version, which kept one series' share."""
        self._played_at = state["played_at"]
        if "pool" in state:
            self.pool = [(float(points), int(matches)) for points, matches in state["pool"]]
        else:
            self.pool = [] if state["points"] is None else [self._one_series(state["points"])]

    def comparable(self, best_score: float, state: dict[str, Any]) -> float:
        """Return a checkpoint's best score as `score` counts: older versions took a single series' share.

        Args:
            best_score: as the checkpoint has it.
            state: the checkpoint's, as `state_dict` returned it.
        """
        if not self.two_sided or "pool" in state or best_score < 0:
            return best_score
        return _sure_share([self._one_series(best_score)])

    def _one_series(self, share: float) -> tuple[float, int]:
        return share * self._cfg.matches.count, self._cfg.matches.count

    def _interval_is_over(self, agent_steps: int) -> bool:
        interval = self._cfg.matches.interval
        return interval is not None and agent_steps - self._played_at >= interval


def _sure_share(pool: list[tuple[float, int]]) -> float:
    """Return the share of the points that a policy has at least, with 97.5 % confidence."""
    low, _ = wilson(sum(points for points, _ in pool), sum(matches for _, matches in pool))
    return round(low, DIGITS)
