"""Advantages from masks alone, and batches whose ``next`` is whole, as tests write them down."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.advantage import Advantage, estimate, make_view


def masked_gae(
    reward_T: Tensor,
    value_T: Tensor,
    end_value_T: Tensor,
    final_value: Tensor,
    valued_T: Tensor,
    final_valued: Tensor,
    terminated_T: Tensor,
    truncated_T: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
    horizon: int | None = None,
    rho_T: Tensor | None = None,
) -> Advantage:
    """Build the decision view of these masks and estimate advantages; shapes as in `estimate`."""
    view = make_view(valued_T, final_valued, terminated_T | truncated_T)
    return estimate(
        view,
        reward_T,
        value_T,
        end_value_T,
        final_value,
        truncated_T,
        gamma=gamma,
        gae_lambda=gae_lambda,
        horizon=horizon,
        rho_T=rho_T,
    )


def whole(batch: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """Return a batch ``[T, ..., A]`` whose ``next`` holds everything, and all rows of that as cut off."""
    following = batch.get("next")
    rows = following.reshape(-1, following.shape[-1])
    entries = {keys.FINAL: following[-1], keys.CUT_OFF: rows, keys.CUT_OFF_AT: torch.arange(-len(rows), 0)}
    return batch, TensorDict(entries, [])
