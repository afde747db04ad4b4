"""Self-play: who opposes the learners, what joins the pool, and the Elo ratings of all.

The semantics and names are ML-Agents' (mlagents/trainers/ghost), but for what docs/self-play.md says. An Elo
rating moves by ``S - E`` points with each result S, where ``E = 1 / (1 + 10^((R_opponent - R) / 400))`` is
what was to be expected (K = 1), and the opponent's by as much the other way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mappo_unity import keys
from mappo_unity.config.schema import Config
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.opponents import Opponents, Player
from mappo_unity.policies.evaluate import open_policy
from mappo_unity.policies.layouts import sides_of
from mappo_unity.policies.league.growing import step_name
from mappo_unity.policies.league.ratings import expected
from mappo_unity.policies.policy import ActorPolicy, Policy
from mappo_unity.policies.policy_files import RANDOM
from mappo_unity.training.collection.batches import Batch
from mappo_unity.training.collection.lineups import (
    Lineup,
    Network,
    count_pairs,
    fits_teams,
    make_player,
    players_of_pairs,
    split_players,
)
from mappo_unity.training.episode_stats import by_policy
from mappo_unity.training.self_play.draw import LATEST, draw_teams
from mappo_unity.training.self_play.fixed import OPTION, load_fixed
from mappo_unity.training.self_play.pool import Pool, Record
from mappo_unity.training.setup import TrainingSetup

ELO = "Self-play/ELO"  # the metric, as ML-Agents calls it


class SelfPlay:
    """The opponents of a run.

    Args:
        cfg: the run's options.
        folder: the run's folder.
        setup: what is trained.

    Attributes: `elo`, the ratings of the policy names that learn.

    Raises:
        ConfigError: there are not two sides, or a fixed opponent cannot be loaded.
    """

    def __init__(self, cfg: Config, folder: Path, setup: TrainingSetup) -> None:
        self._cfg, self._setup = cfg.self_play, setup
        self._seed, self._device = cfg.seed, cfg.device
        self._in_workers = cfg.collect.workers > 0  # who plays there is followed here
        self._sides = _two_sides(cfg, setup)
        self._names = [name for name in setup.learners if name not in setup.frozen]
        policies = {side: set(map(keys.policy_name, own)) for side, own in sorted(self._sides.items())}
        self._learners = [side for side, own in policies.items() if own & {*self._names}]
        assert setup.opponents is not None
        self._opponents: Opponents = setup.opponents

        self._pool = Pool(folder, self._cfg.window)
        self._fixed = self._load_fixed()
        self.elo = dict.fromkeys(self._names, self._cfg.initial_elo)
        self._records: dict[str, dict[int, Record]] = {
            name: {number: Record(self._cfg.initial_elo) for number in self._fixed} for name in self._names
        }
        self._saved_at = self._drawn_at = self._changed_at = 0
        self._draws = 0
        takes_turns = self._cfg.team_change is not None or len(self._learners) == 1  # the other stands still
        self._learning = self._learners[0] if takes_turns else None

    def begin(self, agent_steps: int, about: Mapping[str, Any]) -> None:
        """Take the first snapshot and draw opponents, where self-play begins; count all intervals from there.

        Args:
            agent_steps: agent decisions of the run; more than 0 where one is resumed that had no opponents.
            about: what a snapshot's file needs beside networks to be played.
        """
        if self._draws == 0:
            self._drawn_at = self._changed_at = agent_steps
            self._save(agent_steps, about)
            self._draw()

    def advance(
        self, batch: Batch, agent_steps: int, about: Mapping[str, Any]
    ) -> tuple[dict[str, float], bool]:
        """Count a batch's results, take a snapshot and draw opponents where it is time.

        Args:
            batch: what was collected and learnt.
            agent_steps: agent decisions of the run with it.
            about: as for `begin`.

        Returns:
            Metrics, and whether the other side learns from now on: the environment is to be reset.
        """
        metrics, cfg = self._count(batch), self._cfg
        if self._in_workers:
            for name in self._setup.learners:
                self._opponents.playing[name] = batch.rounds.get((name, keys.PLAYER))[-1, ..., 0, 0].clone()

        if cfg.save_steps is not None and agent_steps - self._saved_at >= cfg.save_steps:
            self._save(agent_steps, about)
        period = cfg.team_change if len(self._learners) > 1 else None
        changed = period is not None and agent_steps - self._changed_at >= period
        if changed:
            self._learning = next(side for side in self._learners if side != self._learning)
            self._changed_at = agent_steps
        if changed or agent_steps - self._drawn_at >= cfg.swap_steps:
            self._drawn_at = agent_steps
            self._draw()
        self._pool.keep(self._used(), agent_steps)
        return metrics, changed

    def rivals(self, layout: dict[str, Any]) -> dict[str, Policy]:
        """Return the opponents of the pool as policies that play matches, the fixed ones first.

        Args:
            layout: what the policies were built for, by policy name.
        """
        named = [where for where in self._cfg.fixed if where != RANDOM]
        rivals = {where: open_policy(where, False, self._seed, OPTION) for where in named}
        for number in self._pool.numbers:
            name = step_name(self._pool.steps(number))
            actors = {
                policy: make_player(learner.actor, self._network(policy, number))
                for policy, learner in self._setup.learners.items()
            }
            rivals[name] = ActorPolicy(layout, actors, False, name)
        return rivals

    # --- results

    def _count(self, batch: Batch) -> dict[str, float]:
        """Move the ratings by a batch's results; return metrics."""
        points = {name: list[float]() for name in self._names}
        for result in batch.results:
            if result.opponent == LATEST:
                continue  # against its own weights a rating cannot move
            record = self._records[keys.policy_name(result.behavior)].get(result.opponent)
            if record is None:
                continue  # it has left the pool
            record.add(result.score)
            for name in self._rivals(result.behavior):
                gain = (1 - result.score) - expected(self.elo[name], record.elo)
                self.elo[name] += gain
                record.elo -= gain
                points[name].append(1 - result.score)

        size = float(len(self._pool.numbers) + len(self._fixed))
        return by_policy(
            {
                name: {ELO: self.elo[name], "points_vs_pool": _mean(points[name]), "pool_size": size}
                for name in self._names
            }
        )

    def _rivals(self, behavior: str) -> list[str]:
        """Return the policy names that learn on the other side."""
        others = [b for side, own in self._sides.items() if behavior not in own for b in own]
        return [name for name in self._names if name in {keys.policy_name(other) for other in others}]

    # --- the pool

    def _save(self, agent_steps: int, about: Mapping[str, Any]) -> None:
        self._saved_at = agent_steps
        if self._cfg.save_steps is None:
            return
        learners = self._setup.learners
        number = self._pool.add(
            agent_steps, {name: learner.actor.state_dict() for name, learner in learners.items()}, about
        )
        for name in self._names:
            self._records[name][number] = Record(self.elo[name])
            for old in self._records[name].keys() - {*self._pool.numbers, *self._fixed}:
                del self._records[name][old]

    def _draw(self) -> None:
        """Say who plays each team from its next episode on."""
        fleet, env = self._setup.fleet, self._setup.env
        rng = np.random.default_rng([self._seed, self._draws])
        self._draws += 1
        records = {behavior: self._records.get(keys.policy_name(behavior), {}) for behavior in env.behaviors}
        teams = dict.fromkeys(env.behaviors, sum(map(count_pairs, fleet.parts)))
        drawn = draw_teams(rng, self._cfg, self._sides, teams, records, self._learning)

        for name, players in players_of_pairs(drawn, fleet.parts).items():
            self._opponents.plan(name, players.to(self._device))
        self._line_up()
        self._pool.clean(self._used())

    def _used(self) -> set[int]:
        """Return the numbers of those who play, or will."""
        own = {number for name in self._names for number in self._opponents.used(name)}
        return own | self._setup.fleet.opposing

    def _line_up(self) -> None:
        """Tell those who collect who plays."""
        used, fleet = self._used(), self._setup.fleet
        networks = {
            number: {name: self._network(name, number) for name in self._names}
            for number in used
            if number in self._pool.all_numbers | {*self._fixed, LATEST}
        }
        kept = frozenset({*self._pool.numbers, *self._fixed, LATEST} | used)
        fleet.oppose(Lineup(split_players(self._opponents.following, fleet.parts), networks, kept))

    def _network(self, name: str, number: int) -> Network:
        if number == LATEST:
            return None
        return self._fixed[number][name] if number in self._fixed else self._pool.tensors(number, name)

    def _load_fixed(self) -> dict[int, dict[str, Player]]:
        env, learners = self._setup.env, self._setup.learners
        specs = {sides[0]: env.behaviors[sides[0]].spec for n, sides in env.sides.items() if n in self._names}
        actors = {name: learner.actor for name, learner in learners.items()}
        device = "cpu" if self._in_workers else self._device
        fixed = [load_fixed(where, specs, actors, device) for where in self._cfg.fixed]
        return {LATEST - 1 - index: players for index, players in enumerate(fixed)}

    # --- checkpoints

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs; snapshots by reference to their files."""
        records = {
            name: [[number, record.elo, record.lost, record.played] for number, record in known.items()]
            for name, known in self._records.items()
        }
        return {
            "pool": self._pool.state_dict(),
            "opponents": self._opponents.state_dict(),
            "fixed": list(self._cfg.fixed),
            "records": records,
            "elo": dict(self.elo),
            "learning": self._learning,
            "draws": self._draws,
            "at": [self._saved_at, self._drawn_at, self._changed_at],
        }

    def load_state_dict(self, state: Mapping[str, Any], agent_steps: int, say: Callable[[str], None]) -> None:
        """Restore what `state_dict` returned.

        Args:
            agent_steps: agent decisions of the run then.
            say: takes a line about each opponent that is left out.

        Raises:
            ConfigError: a snapshot's file is missing or damaged, or the fixed opponents are others.
        """
        if list(state["fixed"]) != list(self._cfg.fixed):
            raise ConfigError(
                f"self_play.fixed={list(self._cfg.fixed)} cannot change with resume: the run has "
                f"{list(state['fixed'])}"
            )
        # of other teams, which a player may show in new episodes, nothing is known
        fits = fits_teams(state["opponents"]["following"], self._setup.fleet.parts)
        if fits:
            self._opponents.load_state_dict(state["opponents"], self._device)
        self._pool.load_state_dict(state["pool"], self._used(), self._cfg.skip_missing, say)
        self._draws = int(state["draws"])
        self._saved_at, self._drawn_at, self._changed_at = (int(at) for at in state["at"])
        self.elo |= {name: float(elo) for name, elo in state["elo"].items() if name in self.elo}
        if self._learning is not None and state["learning"] in self._learners:
            self._learning = int(state["learning"])
        elif self._learning is not None:  # sides take turns from now on
            self._changed_at = agent_steps

        there = {*self._pool.numbers, *self._fixed}
        for name in self._names:
            rows = state["records"].get(name, [])
            self._records[name] = {int(n): Record(*values) for n, *values in rows if n in there}
            self._opponents.replace(name, self._pool.all_numbers | {*self._fixed, LATEST})
        if fits:
            self._line_up()
        else:
            self._draw()


def _two_sides(cfg: Config, setup: TrainingSetup) -> dict[int, list[str]]:
    sides = sides_of(setup.env.behaviors)
    if len(sides) != 2:
        raise ConfigError(
            f"self_play.save_steps={cfg.self_play.save_steps} self_play.fixed={list(cfg.self_play.fixed)}: "
            f"self-play needs an environment with two sides (team ids), and {cfg.env.name} has "
            f"{len(sides)}: {', '.join(setup.env.behaviors)}"
        )
    return sides


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")
