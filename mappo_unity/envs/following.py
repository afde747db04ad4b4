"""What follows the rounds of a batch, so that no observation has to be held twice.

What an agent sees after a round is what it acts on in the next one, so a batch's ``next`` holds rewards and
ends alone. Two things stand in no row: what was seen where an episode was cut off, and the row after the
last. The critic asks for both.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from mappo_unity import keys
from mappo_unity.envs.tensordicts import unchecked
from mappo_unity.envs.transforms import TransformedUnityEnv, make_transforms
from mappo_unity.envs.unity_env import UnityEnv

_ENDS = (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
_KEPT = (keys.REWARD, keys.GROUP_REWARD, *_ENDS)


def followed(env: UnityEnv, keeps_ends: bool = False) -> FollowedEnv:
    """Return the environment that a training run collects its batches from.

    Args:
        env: what is played.
        keeps_ends: see `FollowedEnv.keeps_ends`.
    """
    out = FollowedEnv(env, make_transforms(env), cache_specs=True)
    out.keeps_ends = keeps_ends
    return out


class FollowedEnv(TransformedUnityEnv):
    """A `TransformedUnityEnv` whose ``next`` holds rewards and ends; `pop_following` returns the rest.

    Attributes: `keeps_ends`, whether real ends are kept like episodes that were cut off, for intrinsic
    rewards.
    """

    keeps_ends = False
    _last: TensorDictBase  # `next` of the last round, whole
    _cut_off: dict[str, list[tuple[torch.Tensor, TensorDictBase]]]  # team rows by policy name, and where
    _rounds: int  # since `pop_following`

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._forget()

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Play a round; return it with its ``next`` entry, and the root of the round after it."""
        tensordict, root = super().step_and_maybe_reset(tensordict)

        self._last = tensordict.get("next")
        if self.base_env.round_ended:
            for name, entries in self._last.items():
                self._note_cut_off(name, entries)
        self._rounds += 1

        kept = {
            name: unchecked({key: entries.get(key) for key in _KEPT}, entries.shape, entries.device)
            for name, entries in self._last.items()
        }
        tensordict.set("next", unchecked(kept, self._last.shape, self._last.device))
        return tensordict, root

    def pop_following(self) -> dict[str, TensorDictBase]:
        """Return for each policy name what followed the rounds since the last call; there must be some.

        Entries: `keys.FINAL`, `keys.CUT_OFF`, `keys.CUT_OFF_AT`.
        """
        out = {}
        for name, last in self._last.items():
            final = last.exclude(*_KEPT)
            nobody = torch.zeros(0, dtype=torch.int64), _team_rows(final)[:0]
            places, rows = zip(*self._cut_off.get(name, [nobody]))

            # from the end: whatever is put before the batch's rounds, it stays right
            at = torch.cat(places) - self._rounds * final.shape[:-1].numel()
            entries = {keys.FINAL: final, keys.CUT_OFF: torch.cat(rows), keys.CUT_OFF_AT: at}
            out[name] = TensorDict(entries, [])

        self._forget()
        return out

    def _forget(self) -> None:
        self._last, self._cut_off, self._rounds = TensorDict(), {}, 0

    def _note_cut_off(self, name: str, entries: TensorDictBase) -> None:
        ended = entries.get(keys.DONE if self.keeps_ends else keys.TRUNCATED)
        cut_off = ended.flatten(0, -3).any(-2).squeeze(-1)  # [teams]
        at = cut_off.nonzero().squeeze(-1)
        if len(at):
            rows = _team_rows(entries.exclude(*_KEPT))[at]
            self._cut_off.setdefault(name, []).append((at + self._rounds * len(cut_off), rows))


def _team_rows(entries: TensorDictBase) -> TensorDictBase:
    """Return entries ``[..., A]`` as team rows ``[R, A]``."""
    return entries.reshape(-1, entries.shape[-1])
