"""Decisions with what was observed next: all that an intrinsic reward looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.networks.poca import flat_actions


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
        following: what was seen after them, ends too, see `keys.FINAL` and `keys.CUT_OFF`.
        view: of the rounds.
        obs_keys: the observation entries, in the encoders' order.
    """
    acting = rounds.get(keys.ACTING)
    known = view.known & acting.cpu().numpy().reshape(view.known.shape)
    number, slots = known.shape
    members = rounds.shape[-1]

    at, slot = np.nonzero(known)
    rows, ended = at * slots + slot, view.ends[at, slot]
    onward = view.following[at, slot] * slots + slot

    # behind the rounds and the row after them stand the team rows of ends, in the order of time
    ends = view.last[at, slot][ended] * slots + slot[ended]
    places = following.get(keys.CUT_OFF_AT).cpu().numpy() + number * slots // members
    team_row = np.searchsorted(places, ends // members)
    onward[ended] = (number + 1) * slots + team_row * members + ends % members

    parts = rounds, following.get(keys.FINAL), following.get(keys.CUT_OFF)
    table = [_rows([part.get(key).flatten(0, part.ndim - 1) for part in parts]) for key in obs_keys]

    device = acting.device
    index = torch.from_numpy(rows).to(device)
    return Transitions(
        table,
        index,
        torch.from_numpy(onward).to(device),
        rounds.get(keys.ACTION).flatten(0, rounds.ndim - 1)[index],
        torch.from_numpy(ended).to(device),
    )


def _rows(parts: list[Tensor]) -> Tensor:
    """Return observations ``[*, ...]`` in one, in memory as the first ones are (see `by_pixel`)."""
    first, *others = parts
    is_by_pixel = first.ndim == 4 and first.is_contiguous(memory_format=torch.channels_last)
    layout = torch.channels_last if is_by_pixel else torch.contiguous_format
    # one without rows has no layout, and would undo that of the others
    return torch.cat([first, *(part.contiguous(memory_format=layout) for part in others if len(part))])


def env_actions(action: Tensor, layout: ActionLayout) -> Tensor:
    """Return actions ``[D, C + sum of branches]`` as the environment takes them, branches one-hot.

    Args:
        action: ``[D, C + K]``, as a policy draws them.
        layout: the sizes.
    """
    flat, size = flat_actions(action, layout), layout.continuous
    if not size:
        return flat
    clipped = flat[:, :size].clamp(-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT) / CONTINUOUS_LIMIT
    return torch.cat([clipped, flat[:, size:]], -1)
