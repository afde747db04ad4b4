"""Advantages from masks alone, as tests write them down."""

from __future__ import annotations

from torch import Tensor

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
    )
