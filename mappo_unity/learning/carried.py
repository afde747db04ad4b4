"""Rounds of a batch as the learner reads them, with the decisions that the batch before left pending.

A decision whose outcome has not arrived when a batch ends is learnt with the next one, under the
log-probability with which it was taken. Its round is put before the next batch's rounds, with the reward that
has arrived since; a round in which nobody is pending any more is dropped, so that little is carried.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.networks.encoders import in_type
from mappo_unity.learning.networks.images import by_pixel

VALUED = "valued"  # bool [..., A, 1]: the row has a value, see `DecisionView`
_SUMS = (keys.REWARD, keys.GROUP_REWARD)
_ENDS = (keys.TERMINATED, keys.TRUNCATED)


def has_value(entries: TensorDictBase) -> Tensor:
    """Return which slots a value counts for: those that act, and departed ones while a team mate acts."""
    acting = entries.get(keys.ACTING)
    return acting | (entries.get(keys.DEPARTED) & acting.any(-2, keepdim=True))


class CarriedRounds:
    """The rounds that hold pending decisions, between two batches.

    Args:
        row_keys: entries that the networks read or wrote.
        shares_rewards: every member earns the sum of its team's individual rewards, as in MA-POCA, whose
            value is the whole team's.
        images: those of `row_keys` that are images ``[..., C, H, W]``.
    """

    def __init__(self, row_keys: list[str], shares_rewards: bool = False, images: Sequence[str] = ()) -> None:
        self._row_keys, self._shares_rewards, self._images = row_keys, shares_rewards, images
        self.rounds: TensorDict | None = None  # [P, ..., A]

    def join(self, batch: TensorDictBase) -> TensorDict:
        """Return the batch's rounds behind the carried ones, ``[P + T, ..., A]``.

        Entries: `row_keys`, ``acting`` (of carried rounds: what is still pending), ``valued``, rewards, ends.
        """
        following = batch.get("next")
        entries = {key: batch.get(key) for key in self._row_keys}
        entries |= {key: by_pixel(entries[key]) for key in self._images}
        entries |= {keys.ACTING: batch.get(keys.ACTING), VALUED: has_value(batch)}
        entries |= {key: following.get(key) for key in (*_SUMS, *_ENDS)}
        if self._shares_rewards:
            own = entries[keys.REWARD]
            entries[keys.REWARD] = own.sum(-2, keepdim=True).expand_as(own)
        rounds = TensorDict(entries, batch.batch_size)
        # with another ppo.ratio or model.memory, which a resume may bring, what is pending cannot be learnt
        if self.rounds is None or self.rounds.keys() ^ rounds.keys():
            return rounds

        for key, entry in self.rounds.items():
            if entry.dtype != rounds.get(key).dtype:  # older checkpoints hold all images as floats
                self.rounds.set(key, in_type(entry, rounds.get(key).dtype))
        return torch.cat([self.rounds, rounds], 0)

    def keep(self, rounds: TensorDict, view: DecisionView) -> None:
        """Keep the rounds in which decisions are pending, with the rewards that have come since."""
        pending = view.pending
        where = np.flatnonzero(pending.any(1))
        if not len(where):
            self.rounds = None
            return

        index = torch.from_numpy(where).to(rounds.get(VALUED).device)
        kept = rounds[index].clone()
        mask = _like(pending[where], kept.get(VALUED))
        kept.set(VALUED, mask)
        # who is not pending stands there no more: not as the beginning of an episode, either
        for key in (keys.ACTING, keys.FIRST):
            if key in kept.keys():
                kept.set(key, kept.get(key) & mask)
        for key in _SUMS:
            flat = rounds.get(key).cpu().numpy().reshape(len(rounds), -1)
            kept.set(key, _like(np.where(pending, view.rewards(flat), 0)[where], kept.get(key)))
        for key in _ENDS:
            kept.set(key, torch.zeros_like(mask))
        self.rounds = kept

    def void(self, slots: Tensor) -> int:
        """Forget what is pending of these slots, bool ``[..., A, 1]``; return how many decisions."""
        if self.rounds is None:
            return 0
        acting = self.rounds.get(keys.ACTING)
        count = int((acting & slots).sum())
        for key in (keys.ACTING, VALUED):
            self.rounds.set(key, self.rounds.get(key) & ~slots)
        return count

    def state_dict(self) -> dict[str, Tensor] | None:
        """Return what resuming needs."""
        return None if self.rounds is None else {str(k): v.clone() for k, v in self.rounds.items()}

    def load_state_dict(self, state: dict[str, Tensor] | None, device: torch.device) -> None:
        """Restore what `state_dict` returned, on the device of the networks."""
        if state is None:
            self.rounds = None
            return
        self.rounds = TensorDict({k: v.to(device) for k, v in state.items()}, state[VALUED].shape[:-1])


def _like(values: np.ndarray, other: Tensor) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).view(other.shape).to(other.device)
