"""Series of matches while a policy learns: when they are played, against whom, and which policy is the best.

Each series enters the policy as it is into a `GrowingLeague`; what it scores is the lower end of its rating's
95 % interval. The best of many short series is the luckiest one, therefore a rating counts more than one:

* Where a policy met opponents beside random, its results against all of them, and later those of the
  policies that meet it in its turn. Random tells little there: whoever wins 63 of 64 could be anybody.
* Where it met random alone, the matches of the newest four series together, its own among them: from one
  series to the next a policy changes little, and nobody meets it again. Of equal fours the newest is chosen.
  In simulated runs (24 series of 64 matches, true strengths that wander, rise or peak) no other count of
  series chose better throughout, nor did a random walk that links them all (R. Coulom, Whole-history rating,
  Computers and Games 2008): better after a peak, it stays with an early policy while the run still rises.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mappo_unity.config.schema import Config, EnvConfig
from mappo_unity.envs.backends import make_env_function
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.policies.layouts import sides_of
from mappo_unity.policies.league.growing import GrowingLeague, Points, step_name
from mappo_unity.policies.matches import Z95, Score, have_parts, play_matches, points
from mappo_unity.policies.policy import ActorPolicy, Policy, RandomPolicy
from mappo_unity.policies.policy_files import RANDOM
from mappo_unity.runs.folder import PLAYERS

MISSING = "missing"  # in the state of a checkpoint that was kept before its series was played
POOLED = 4  # series, the newest ones, that a rating against random alone is taken from


class MatchSeries:
    """Play a series every `matches.interval` agent decisions, and one when `max_steps` are done.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        behaviors: full behavior names of the environment.

    Attributes: `two_sided`, whether the environment has two sides; `league`, whom the series made players and
    their ratings; `pool`, of each of the newest four series against random, the oldest first: its points, a
    win counted 1 and a draw 1/2, and its matches; `said`, a line about the last one; `is_missing`, whether
    the one that was due at the checkpoint that is resumed was not played to its end.

    Raises:
        ConfigError: series are wanted, but there are not two sides.
    """

    def __init__(self, cfg: Config, folder: Path, behaviors: Iterable[str]) -> None:
        names = list(behaviors)
        self._cfg, self._folder = cfg, folder
        self._played_at = 0
        self.league = GrowingLeague()
        self.pool: list[tuple[float, int]] = []
        self.said = ""
        self.is_missing = False

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
        self,
        env: EnvConfig,
        agent_steps: int,
        layout: dict[str, Any],
        actors: dict[str, UnityActor],
        opponents: Mapping[str, Policy] | None = None,
    ) -> dict[str, float]:
        """Play a series and return its figures; the random numbers of training stay untouched.

        Args:
            env: options of the environment that is played in.
            agent_steps: agent decisions that the policy has learnt from.
            layout, actors: of the policy.
            opponents: whom it may meet beside random, the oldest first; `matches.opponents` of them it does
                (`GrowingLeague.choose_opponents`). A name stands for one policy all through the run;
                `step_name` is that of the run's own.
        """
        name = step_name(agent_steps)
        others = {other: rival for other, rival in (opponents or {}).items() if other not in (name, RANDOM)}
        chosen = self.league.choose_opponents(others, self._cfg.matches.opponents)
        policy = ActorPolicy(layout, actors, False, "the policy")
        met = self._meet(env, agent_steps, policy, {name: others[name] for name in chosen})
        scores = {name: sum(sides.values(), Score()) for name, sides in met.items()}

        if self._interval_is_over(agent_steps):  # the last series leaves the rhythm of a longer run alone
            self._played_at = agent_steps

        total, results = scores[RANDOM], {name: points(sides) for name, sides in met.items()}
        self.pool = [*self.pool, (results[RANDOM][0], total.matches)][-POOLED:]
        rating = self.league.enter(name, self._pooled(results), kept=others)
        self.said = f"{agent_steps:,} steps: of {total.matches} matches against a random side {_words(total)}"
        self.said += "".join(f"; against {other}: {_words(scores[other])}" for other in chosen)
        self.said += f"; rating {rating.rating:,.0f} ({rating.low:,.0f} to {rating.high:,.0f})"
        self.said += ", the best so far" if self.is_best(agent_steps) else f"; the best is {self.league.best}"

        matches = max(1, total.matches)
        by_side = met[RANDOM] if have_parts(met[RANDOM]) else {}
        return {
            f"{side}/match_decisions_vs_random": score.decisions / max(1, score.matches)
            for side, score in by_side.items()
        } | {
            "win_rate_vs_random": total.figures()["won_of_decided"],
            "draw_rate_vs_random": total.draws / matches,
            "match_decisions_vs_random": total.decisions / matches,
            "rating": rating.rating,
            "rating_low": rating.low,
            "rating_high": rating.high,
        }

    def is_best(self, agent_steps: int) -> bool:
        """Return whether the run's policy of so many steps is its best; before any series newer is better."""
        return self.league.best in (None, step_name(agent_steps))

    def forget(self) -> None:
        """Forget all results: the environment is another one now."""
        self.league, self.pool = GrowingLeague(), []

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        pool = [list(series) for series in self.pool]
        return {"played_at": self._played_at, "pool": pool, "league": self.league.state_dict()}

    def load_state_dict(self, state: dict[str, Any], best_score: float) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: the checkpoint's, or that of an older version: points and matches of the newest four
                series, and before that one series' share.
            best_score: the checkpoint's. Older versions chose by it: it was the lower end of Wilson's
                interval for the share of four series' points, and before that one series' share; negative
                before any series.
        """
        self._played_at, count = state["played_at"], self._cfg.matches.count
        self.is_missing = is_missing(self._cfg, state)
        self.forget()
        if "pool" in state:
            self.pool = [(float(points), int(matches)) for points, matches in state["pool"]]
        elif state["points"] is not None:
            self.pool = [(state["points"] * count, count)]

        if "league" in state:
            self.league.load_state_dict(state["league"])
        elif self.two_sided and best_score >= 0:
            series = POOLED if "pool" in state else 1
            share = _share_of_low(best_score, series * count) if "pool" in state else best_score
            points = (share * series * count, (1 - share) * series * count)
            self.league.enter("the best of before", {RANDOM: points})

    def _meet(
        self, env: EnvConfig, agent_steps: int, policy: Policy, opponents: dict[str, Policy]
    ) -> dict[str, dict[str, Score]]:
        """Return the policy's scores against random and each opponent, as each side."""
        cfg = self._cfg
        # `torch.manual_seed` seeds the GPU, too, where the policy draws its actions
        cuda = [torch.device(cfg.device)] if cfg.device.startswith("cuda") else []
        with torch.random.fork_rng(devices=cuda):
            torch.manual_seed(cfg.seed + agent_steps)
            # a folder of its own: the run's players log under the same names
            if env.player_logs is not None:
                env = replace(env, player_logs=str(Path(env.player_logs) / "matches"))
            make_env = make_env_function(env, self._folder / PLAYERS / "matches")
            seed = (cfg.seed + agent_steps) % 2**31

            scores = {}
            everybody: dict[str, Policy] = {RANDOM: RandomPolicy(seed), **opponents}
            for index, (name, other) in enumerate(everybody.items()):
                # matches that begin alike would be lucky alike
                seed_of_other = (seed + index) % 2**31
                scores[name] = play_matches(make_env, policy, other, cfg.matches.count, seed_of_other)

        return scores

    def _pooled(self, results: dict[str, Points]) -> dict[str, Points]:
        """Return the points won and lost that the policy's rating is taken from, by opponent."""
        if len(results) > 1:
            return results
        won, matches = (sum(column) for column in zip(*self.pool, strict=True))  # random alone
        return {RANDOM: (won, matches - won)}

    def _interval_is_over(self, agent_steps: int) -> bool:
        interval = self._cfg.matches.interval
        return interval is not None and agent_steps - self._played_at >= interval


def is_missing(cfg: Config, state: Mapping[str, Any]) -> bool:
    """Return whether a series is wanted that was due at a checkpoint, and was not played to its end.

    Args:
        cfg: the run's options.
        state: what the checkpoint has of matches; that of an older version does not tell.
    """
    return cfg.matches.interval is not None and bool(state.get(MISSING, False))


def _words(score: Score) -> str:
    return f"{score.wins} won, {score.draws} drawn, {score.losses} lost"


def _share_of_low(low: float, matches: int) -> float:
    """Return the share of the points whose 95 % interval (E. B. Wilson, 1927) begins at `low`.

    The interval's ends are the shares p0 with ``|p - p0| = z sqrt(p0 (1 - p0) / n)``.
    """
    return min(1.0, low + Z95 * math.sqrt(low * (1 - low) / matches))
