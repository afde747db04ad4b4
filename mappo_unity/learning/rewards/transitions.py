"""Decisions of a batch with what was observed next: all that an intrinsic reward looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.decisions import DecisionView


@dataclass(frozen=True)
class Transitions:
    """D decisions whose outcome has arrived, of agents that acted.

    Attributes:
        table: each observation entry ``[M, *]``, every observation once.
        at: int64 ``[D]``, the row of the table that was decided on; the table begins with the R * N slots of
            the batch's rounds.
        following: int64 ``[D]``, the row that the agent observed next: at its next decision, or at its end.
        action: ``[D, C + K]``, as the policy drew it.
        ended: bool ``[D]``, whether the episode ended, for whatever reason.
    """

    table: list[Tensor]
    at: Tensor
    following: Tensor
    action: Tensor
    ended: Tensor

    def __len__(self) -> int:
        return len(self.at)

    def __getitem__(self, index: Tensor) -> Transitions:
        """Return some of the decisions, int64 ``[d]``, over the same table."""
        chosen = ("at", "following", "action", "ended")
        return replace(self, **{name: getattr(self, name)[index] for name in chosen})

    @property
    def obs(self) -> list[Tensor]:
        """The observations decided on, each ``[D, *]``."""
        return [entry[self.at] for entry in self.table]

    @property
    def next_obs(self) -> list[Tensor]:
        """The observations that followed, each ``[D, *]``."""
        return [entry[self.following] for entry in self.table]


def find_transitions(
    rounds: TensorDict, following: TensorDictBase, view: DecisionView, obs_keys: Sequence[str]
) -> Transitions:
    """Find the decisions of a batch.

    Args:
        rounds: ``[R, ..., A]``, as `CarriedRounds.join` returns them; N slots a round.
        following: ``[T, ..., A]``, the batch's ``next``.
        view: of the rounds.
        obs_keys: the observation entries, in the encoders' order.
    """
    acting = rounds.get(keys.ACTING)
    known = view.known & acting.cpu().numpy().reshape(view.known.shape)
    number, slots = known.shape

    at, slot = np.nonzero(known)
    ended, last = view.ends[at, slot], view.last[at, slot]
    rows = at * slots + slot

    # behind the rounds and the row after them stand the observations of ends, one for each
    ends = (last[ended] - (number - len(following))) * slots + slot[ended]
    onward = view.following[at, slot] * slots + slot
    onward[ended] = (number + 1) * slots + np.arange(len(ends))

    device = acting.device
    terminal = torch.from_numpy(ends).to(device)
    last_dim = rounds.batch_dims - 1
    table = [
        torch.cat(
            [
                rounds.get(key).flatten(0, last_dim),
                following.get(key)[-1:].flatten(0, last_dim),
                following.get(key).flatten(0, last_dim)[terminal],
            ]
        )
        for key in obs_keys
    ]

    index = torch.from_numpy(rows).to(device)
    return Transitions(
        table,
        index,
        torch.from_numpy(onward).to(device),
        rounds.get(keys.ACTION).flatten(0, last_dim)[index],
        torch.from_numpy(ended).to(device),
    )
