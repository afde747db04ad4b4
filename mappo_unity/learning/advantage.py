"""Pure maths of the learner: the masked advantage recursion, masked statistics, schedules.

Suffixes: see `keys`; ``_T`` stands for ``[T, ...]`` with any trailing slot dimensions.

The recursion, for slots that do not act in every round: of the k-th row in which a slot has a value (a
decision was requested of it), with R_k the sum of all rewards that arrived from that row up to the next such
row or the end,

    delta_k = R_k + gamma * V_next - V_k
    A_k     = delta_k + gamma * gae_lambda * A_next

where V_next, A_next belong to the next row with a value; at a real end both are 0, at an interruption V_next
is the value of the terminal observation and A_next is 0. Rounds without a value pass both on
unchanged. A decision whose outcome has not arrived when the batch ends has no advantage (``known`` is False);
the rows before it bootstrap from its value. With a value in every round this is GAE (Schulman et al., arXiv
1506.02438, eq. 16).

V-trace (Espeholt et al., arXiv 1802.01561, eq. 1 with rho-bar = c-bar = 1) corrects it where an older policy
chose the actions. With rho_k = min(1, pi / pi_behavior) of each decision

    A_k    = delta_k + gamma * gae_lambda * rho_next * A_next
    target = V_k + rho_k * A_k

The targets are the paper's, lambda as in its remark 2. Advantages mix V_next and the next target by lambda,
as rlax has them, and bear no rho_k of their own: the objective's ratio is there for that. Where all rho_k are
1 this is the recursion above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from mappo_unity.config.schema import Schedule
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.reduction import ALONE, Reduction


class Advantage(NamedTuple):
    """Result of `estimate` and `estimate_streams`."""

    advantage: Tensor  # float32 as the values, 0 where not known
    target: Tensor  # float32 as the values, value targets, 0 where not known
    known: Tensor  # bool [T, ...]: rows with a decision whose outcome has arrived


def make_view(valued_T: Tensor, final_valued: Tensor, ended_T: Tensor) -> DecisionView:
    """Return the decision view of masks ``[T, ...]`` and of the mask ``[...]`` of the row after the last."""
    return DecisionView.of(_flat(valued_T), _row(final_valued), _flat(ended_T))


def estimate(
    view: DecisionView,
    reward_T: Tensor,
    value_T: Tensor,
    end_value_T: Tensor,
    final_value: Tensor,
    truncated_T: Tensor,
    *,
    gamma: float,
    gae_lambda: float,
    horizon: int | None = None,
    rho_T: Tensor | None = None,
) -> Advantage:
    """Estimate advantages of slots that do not act in every round, by the recursion above.

    Args:
        view: of the batch; every reward signal with values of its own uses the same one.
        reward_T: float ``[T, ...]``, reward that arrived in a round.
        value_T: float ``[T, ...]``, value of the row's observation (read where it has one).
        end_value_T: float ``[T, ...]``, value of the terminal observation (read where truncated).
        final_value: ``[...]``, value of the row after the last.
        truncated_T: bool ``[T, ...]``, episodes cut off; other ends are real.
        gamma: discount of a decision.
        gae_lambda: lambda.
        horizon: decisions of a slot after which A_next counts as 0; None: nowhere but where the batch ends.
        rho_T: float32 ``[T, ...]``, V-trace's rho, 1 in rows without an action; None: no correction.
    """
    value = _flat(value_T)
    following = view.next_values(value, _row(final_value), _flat(end_value_T), _flat(truncated_T))
    delta = view.rewards(_flat(reward_T)) + np.float32(gamma) * following - value
    if rho_T is None:
        advantage = moved = view.scan(delta, gamma * gae_lambda, horizon)
    else:
        rho = _flat(rho_T)
        decay = np.float32(gamma * gae_lambda) * view.onward(rho, np.ones_like(rho[0]))
        advantage = view.scan(delta, decay, horizon)
        moved = rho * advantage
    target = np.where(view.known, moved + value, np.float32(0))

    def back(values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).view(value_T.shape).to(value_T.device)

    return Advantage(back(advantage), back(target), back(view.known))


def estimate_streams(
    view: DecisionView,
    reward_T: Tensor,
    value_T: Tensor,
    end_value_T: Tensor,
    final_value: Tensor,
    truncated_T: Tensor,
    *,
    gammas: Sequence[float],
    gae_lambda: float,
    horizon: int | None = None,
    rho_T: Tensor | None = None,
) -> Advantage:
    """Estimate advantages and targets ``[T, ..., V]`` of V reward streams, each as in `estimate`.

    Args:
        view: see `estimate`; so are the others, with a last dimension V.
        truncated_T: bool ``[T, ..., 1]``.
        gammas: the discount of each stream.
        rho_T: float32 ``[T, ..., 1]``, or None.
    """
    columns = [x.split(1, -1) for x in (reward_T, value_T, end_value_T, final_value)]
    parts = [
        estimate(
            *(view, reward, value, end, final, truncated_T),
            gamma=gamma,
            gae_lambda=gae_lambda,
            horizon=horizon,
            rho_T=rho_T,
        )
        for gamma, reward, value, end, final in zip(gammas, *columns, strict=True)
    ]
    if len(parts) == 1:
        return parts[0]
    advantage, target = (torch.cat([part[i] for part in parts], -1) for i in range(2))
    return Advantage(advantage, target, parts[0].known)


def _flat(values: Tensor) -> np.ndarray:
    """Return ``[T, ...]`` as an array ``[T, N]``."""
    return values.cpu().numpy().reshape(len(values), -1)


def _row(values: Tensor) -> np.ndarray:
    """Return ``[...]`` as an array ``[N]``."""
    return values.cpu().numpy().reshape(-1)


def last_mean(values: Tensor) -> Tensor:
    """Return the mean over the last dimension, which becomes 1; where it is 1, the values themselves."""
    return values if values.shape[-1] == 1 else values.mean(-1, keepdim=True)


def normalize(values: Tensor, mask: Tensor, eps: float = 1e-5, reduction: Reduction = ALONE) -> Tensor:
    """Return ``(values - mean) / (std + eps)`` with statistics over ``mask``; 0 elsewhere."""
    mean = reduction.mean(values, mask)
    std = reduction.mean((values - mean) ** 2, mask).sqrt()
    return torch.where(mask, (values - mean) / (std + eps), 0.0)


def explained_variance(value: Tensor, target: Tensor, mask: Tensor, reduction: Reduction = ALONE) -> Tensor:
    """Return ``1 - Var[target - value] / Var[target]`` over ``mask``; nan if the targets are equal."""
    error, mean = target - value, reduction.mean
    error_var = mean((error - mean(error, mask)) ** 2, mask)
    target_var = mean((target - mean(target, mask)) ** 2, mask)
    return torch.where(target_var > 0, 1 - error_var / target_var, torch.nan)


def value_metrics(
    names: Sequence[str], value: Tensor, target: Tensor, mask: Tensor, reduction: Reduction = ALONE
) -> dict[str, float]:
    """Return how well values ``[..., V]`` explain their targets, and their means.

    Args:
        names: of the streams; the first one's metrics have no prefix.
        mask: bool ``[..., 1]``, rows that count.
        reduction: of several learners.
    """
    metrics = {}
    for number, name in enumerate(names):
        prefix = f"{name}_" if number else ""
        column, wanted = value[..., number : number + 1], target[..., number : number + 1]
        explained = explained_variance(column, wanted, mask, reduction)
        metrics[f"{prefix}explained_variance"] = float(explained)
        metrics[f"{prefix}value_mean"] = float(reduction.mean(column, mask))
    return metrics


def approximate_kl(
    log_ratio: Tensor, ratio: Tensor, mask: Tensor | None, reduction: Reduction = ALONE
) -> Tensor:
    """Return the approximate KL of ratios ``[..., n]`` of an action's n components, a scalar.

    k3 of http://joschu.net/blog/kl-approx.html: (r - 1) - log r, never negative. Of several learners it is
    this one's part.
    """
    if log_ratio.shape[-1] > 1:
        log_ratio = log_ratio.sum(-1, keepdim=True)
        ratio = log_ratio.exp()
    return reduction.part(ratio - 1 - log_ratio, mask)


def scheduled(schedule: Schedule, start: float, final: float, progress: float) -> float:
    """Return where a quantity stands after ``progress`` (0 to 1) of a run."""
    progress = min(max(progress, 0.0), 1.0)
    if schedule is Schedule.constant:
        return start
    if schedule is Schedule.cosine:
        progress = 0.5 - 0.5 * math.cos(math.pi * progress)
    return start + (final - start) * progress


def part_over(progress: float, first: float, last: float) -> float:
    """Return which share, 0 to 1, of a part of a run is over; one without length is over from its place on.

    Args:
        progress: share of the run that is over, 0 to 1.
        first, last: shares of the run between which the part lies.
    """
    if progress >= last:
        return 1.0
    return 0.0 if progress <= first else (progress - first) / (last - first)


def share_left(steps: int, max_steps: int, progress: float) -> float:
    """Return what is left of a strength that falls to 0 over the first `steps` decisions; 0 steps: all.

    Args:
        steps: agent decisions after which nothing is left.
        max_steps: agent decisions of the run.
        progress: share of the run that is over, 0 to 1.
    """
    return max(0.0, 1 - progress * max_steps / steps) if steps else 1.0
