"""Batches: so many decisions collected from an environment, with all that was seen of it on the way."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector

from mappo_unity import keys
from mappo_unity.config.schema import CollectConfig
from mappo_unity.envs.rounds import Episode
from mappo_unity.envs.unity_env import UnityEnv
from mappo_unity.learning.networks.opponents import Opponents
from mappo_unity.scenes.contract.statistics import Statistics
from mappo_unity.training.collection.crashed_episodes import mask_crashed_episodes
from mappo_unity.training.collection.results import Result, count_learning, split_episodes


@dataclass
class Batch:
    """A stretch of play: all that a learner and the run's counters need of it.

    Attributes:
        rounds: ``[T]``, one entry a policy name; ``next`` holds rewards and ends alone.
        following: by policy name what was seen after them, as `FollowedEnv.pop_following` returns it.
        episodes: those that finished, for each behavior.
        void: by policy name bool ``[..., A, 1]``, slots whose episode a crash cut off that had begun before
            the batch: what is pending of them teaches nothing.
        statistics: what the environment reported of itself, see `UnityEnv.pop_statistics`.
        restarts: how often players have been started again so far; None: there are no players.
        dropped_episodes, dropped_steps: what crashes cost in this batch.
        results: how opponents fared against those who learn, with self-play.
    """

    rounds: TensorDictBase
    following: dict[str, TensorDictBase]
    episodes: dict[str, list[Episode]]
    void: dict[str, Tensor] = field(default_factory=dict)
    statistics: Statistics = field(default_factory=dict)
    restarts: int | None = None
    dropped_episodes: int = 0
    dropped_steps: int = 0
    results: list[Result] = field(default_factory=list)

    def of(self, name: str) -> tuple[TensorDictBase, TensorDictBase]:
        """Return one policy name's entries ``[T, ..., A]`` with its own ``next``, and what followed them."""
        entries = self.rounds.get(name).copy()
        entries.set("next", self.rounds.get(("next", name)))
        return entries, self.following[name]

    def count_decisions(self, name: str) -> int:
        """Return how many agent decisions a policy made in it (ML-Agents' steps)."""
        return count_decisions(self.rounds, [name])


class BatchCollector:
    """Collect batches from where the environment stands.

    Args:
        collector: plays rounds of a `FollowedEnv`.
        env: what is played, below the collector's transforms.
        cfg: how large a batch is.
        opponents: who plays some of the teams instead of the learners; None: nobody does.
    """

    def __init__(
        self, collector: Collector, env: UnityEnv, cfg: CollectConfig, opponents: Opponents | None = None
    ) -> None:
        self._collector, self._env, self._cfg, self._opponents = collector, env, cfg, opponents

    def __iter__(self) -> Iterator[Batch]:
        return self

    def __next__(self) -> Batch:
        """Return `collect.rounds` rounds, or as many as hold `collect.batch_size` decisions."""
        if self._cfg.rounds is not None:
            return self._with_records(self._play(self._cfg.rounds))

        parts: list[TensorDictBase] = []
        missing, rate = self._cfg.batch_size, self._expected()
        while missing > 0:
            # not everybody is asked in every round: what is missing then is played in further parts
            parts.append(self._play(-(-missing // max(1, rate))))
            decisions = count_decisions(parts[-1], self._env.sides)
            missing -= decisions
            # as many as are there now, or as the last part had in a round
            rate = max(self._present()[0], -(-decisions // len(parts[-1])))

        return self._with_records(parts[0] if len(parts) == 1 else torch.cat(parts, 0))

    def restart(self) -> None:
        """Reset the scene: the next batch begins with new episodes."""
        self._env.restart()
        self._collector.reset_at_each_iter = True  # hands out what the reset has brought

    def _expected(self) -> int:
        """Return how many agents of the learners a first round may hold: those now, or half of their slots.

        Few may be there for a moment only: where all but one have died, the next round may bring all back,
        and rounds for one would make a batch many times too large. Where few stay, further parts follow.
        """
        present, slots = self._present()
        return max(present, slots // 2)

    def _present(self) -> tuple[int, int]:
        """Return how many agents of the learners are there now, and how many slots these have."""
        if self._opponents is not None:
            return count_learning(self._env, self._opponents)
        return count_present(self._env), count_slots(self._env)

    def _play(self, rounds: int) -> TensorDictBase:
        self._collector.frames_per_batch = self._collector.requested_frames_per_batch = rounds
        # not through its iterator, which would hold this batch while it collects the next
        part = self._collector.rollout()
        self._collector.reset_at_each_iter = False
        return part

    def _with_records(self, rounds: TensorDictBase) -> Batch:
        env = self._env
        following = self._collector.env.pop_following()
        # only tensors know the device: a collector on the CPU clears that of its batches
        device = rounds.get((next(iter(env.sides)), keys.ACTING)).device
        following = {name: part.to(device) for name, part in following.items()}
        statistics = env.pop_statistics()
        episodes, results = env.pop_episodes(), list[Result]()
        if self._opponents is not None:
            episodes, results = split_episodes(episodes, rounds, env)
        batch = Batch(
            rounds, following, episodes, statistics=statistics, restarts=env.restarts, results=results
        )
        if env.restarts is None:
            return batch

        crashes = env.pop_crashed_episodes()
        batch.dropped_steps, batch.void = mask_crashed_episodes(rounds, crashes, env)
        batch.dropped_episodes = sum(int(crash.slots.sum()) for crash in crashes)
        return batch


def count_decisions(rounds: TensorDictBase, names: Iterable[str]) -> int:
    """Return how many agent decisions policies made in rounds ``[T]``."""
    return sum(int(rounds.get((name, keys.ACTING)).sum()) for name in names)


def count_present(env: UnityEnv) -> int:
    """Return how many agents are there now."""
    return sum(int(behavior.present.sum()) for behavior in env.behaviors.values())


def count_slots(env: UnityEnv) -> int:
    """Return how many agents there can be at once."""
    return sum(behavior.present.size for behavior in env.behaviors.values())
