"""The proximal policy: the one that an update begins with, beside the older one that collected the batch.

The two differ where a batch is collected while the one before is learnt from (``collect.overlap``), in
decisions that were pending when the batch before ended, and where normalisers moved while it was collected.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from mappo_unity import keys
from mappo_unity.config.schema import AdvantageKind, ObjectiveKind, PPOConfig
from mappo_unity.learning.advantage import approximate_kl
from mappo_unity.learning.decisions import DecisionView
from mappo_unity.learning.loss import ACTOR_LEARNS, PROXIMAL, MaskedClipPPOLoss
from mappo_unity.learning.reduction import ALONE, Reduction
from mappo_unity.learning.rows import SequenceRows, TeamRows

MOST_RATIO = 1.0  # rho-bar and c-bar of V-trace (Espeholt et al., arXiv 1802.01561)


@torch.no_grad()
def enter_proximal(
    rounds: TensorDict, view: DecisionView, rows: TeamRows | SequenceRows, loss: MaskedClipPPOLoss
) -> None:
    """Set the log-probabilities that the policy, as it is now, gives what is learnt.

    They are read row by row, or with a memory sequence by sequence, as the loss is going to read them: before
    the first step of the optimizer all ratios are 1.

    Args:
        rounds: ``[R, ..., A]`` with `ACTOR_LEARNS` and the critic's states; `PROXIMAL` is set.
        view: of the rounds.
        rows: what the update is going to draw its minibatches from.
        loss: reads the policy.
    """
    if bool(rounds.get(ACTOR_LEARNS).any()):
        rows.fill(rounds, view, PROXIMAL, loss.log_probs)


def stale_kl(rounds: TensorDict, reduction: Reduction = ALONE) -> float:
    """Return the approximate KL between the policy that collected the batch and the proximal one."""
    log_ratio = joint_log_ratio(rounds)
    kl = approximate_kl(log_ratio, log_ratio.exp(), rounds.get(ACTOR_LEARNS), reduction)
    return float(reduction.whole(kl))


def needs_proximal(cfg: PPOConfig) -> bool:
    """Return whether the options ask for what the proximal policy says."""
    return cfg.objective is ObjectiveKind.decoupled or cfg.advantage is AdvantageKind.vtrace


def truncated_ratio(rounds: TensorDict) -> Tensor:
    """Return min(1, pi_proximal / pi_behavior) ``[R, ..., A, 1]`` of whole actions, 1 where nobody learns.

    Of each agent's own action: what its mates chose otherwise is not corrected.
    """
    return joint_log_ratio(rounds).exp().clamp_max(MOST_RATIO)


def joint_log_ratio(rounds: TensorDict) -> Tensor:
    """Return log pi_proximal - log pi_behavior of whole actions ``[R, ..., A, 1]``, 0 where nobody learns."""
    learns, behavior = rounds.get(ACTOR_LEARNS), rounds.get(keys.LOG_PROB).unsqueeze(-1)
    if PROXIMAL not in rounds.keys():
        return torch.zeros_like(behavior)
    log_ratio = rounds.get(PROXIMAL).sum(-1, keepdim=True) - behavior
    return torch.where(learns, log_ratio, 0.0)
