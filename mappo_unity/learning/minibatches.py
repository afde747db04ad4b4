"""Minibatches that hold about the same number of decisions each."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import ReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import Sampler

from mappo_unity.config.schema import PPOConfig
from mappo_unity.learning.reduction import ALONE, Reduction


class EvenSampler(Sampler):
    """Draw each row once an epoch, in random order, cut where the decisions in the rows add up.

    Rows may hold any number of decisions: of a team some members act, of a sequence the end may be padding.
    Rows in equal numbers would leave a small rest, whose few decisions got a whole optimizer step.

    Args:
        decisions: int64 ``[R]``, decisions in each row.
        count: minibatches of an epoch.
        fills_all: give each minibatch a row at least, that there are `count` of them in every epoch; else
            where few rows hold most decisions there may be fewer.
    """

    def __init__(self, decisions: Tensor, count: int, fills_all: bool = False) -> None:
        self.decisions, self.count, self._fills_all = decisions, count, fills_all
        # where all rows hold the same number, every order is cut at the same places
        self._is_even, self._sizes = bool((decisions == decisions[0]).all()), list[int]()
        self._parts: list[Tensor] = []
        self._ran_out = False

    def sample(self, storage: Any, batch_size: int) -> tuple[Any, dict]:
        """Return the next minibatch's row numbers; `batch_size` is not looked at."""
        if not self._parts:
            self._parts = self._shuffle()
        part = self._parts.pop()
        self._ran_out = not self._parts
        return part, {}

    def _shuffle(self) -> list[Tensor]:
        order = torch.randperm(len(self.decisions)).to(self.decisions.device)
        if not (self._is_even and self._sizes):
            self._sizes = self._cut(order)
        return [part for part in order.split(self._sizes) if len(part)]

    def _cut(self, order: Tensor) -> list[int]:
        """Return how many rows in this order each minibatch takes."""
        total = self.decisions[order].cumsum(0)

        # the middle of a row's decisions says which share it belongs to
        middle = total.double() - self.decisions[order].double() / 2
        share = (middle * self.count / total[-1]).long().clamp_(0, self.count - 1)
        sizes = torch.bincount(share, minlength=self.count)
        if not self._fills_all:
            return sizes.tolist()

        # where each minibatch ends, less the row that it and each one before it has at least
        number = torch.arange(1, self.count + 1, device=sizes.device)
        spare = (sizes.cumsum(0) - number).clamp(0, len(order) - self.count).cummax(0).values
        return (spare + number).diff(prepend=number.new_zeros(1)).tolist()

    @property
    def ran_out(self) -> bool:
        """Whether the epoch is over."""
        return self._ran_out

    @ran_out.setter
    def ran_out(self, value: bool) -> None:
        self._ran_out = value

    def _empty(self) -> None:
        self._parts = []

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: between two updates there is no epoch to go on with."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take nothing."""

    def dumps(self, path: Any) -> None:
        """Write nothing."""

    def loads(self, path: Any) -> None:
        """Read nothing."""


def make_buffer(rows: Any, decisions: Tensor, cfg: PPOConfig, reduction: Reduction = ALONE) -> ReplayBuffer:
    """Return a replay buffer over the rows of an update, from which an epoch draws each row once.

    Args:
        rows: TensorDict ``[R, ...]``, on the device of the networks.
        decisions: int64 ``[R]``, decisions in each row.
        cfg: `num_minibatches`, or `minibatch_size`.
        reduction: of several learners, each of which has rows; a minibatch is then made of all their shares.
    """
    count = minibatch_count(cfg, reduction.total(int(decisions.sum())), reduction.least(len(rows)))
    sampler = EvenSampler(decisions, count, fills_all=reduction.size > 1)
    # the rows themselves are the storage: nothing is copied in
    storage = TensorStorage(rows, device=decisions.device)
    return ReplayBuffer(storage=storage, sampler=sampler, batch_size=max(1, len(rows) // count))


def minibatch_count(cfg: PPOConfig, decisions: int, rows: int) -> int:
    """Return the minibatches of an epoch over so many decisions in so many rows."""
    wanted = cfg.num_minibatches or max(1, round(decisions / cfg.minibatch_size))
    return min(wanted, rows)
