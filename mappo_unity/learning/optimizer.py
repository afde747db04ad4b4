"""The optimizer of an actor and a critic: its groups, its gradients, older states of it."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from mappo_unity.config.schema import Optimizer, PPOConfig


def make_optimizer(actor: nn.Module, critic: nn.Module, cfg: PPOConfig) -> torch.optim.Optimizer:
    """Build the optimizer, with a group for the actor and one for the critic.

    Its fused form makes one pass over all parameters.
    """
    kind = torch.optim.AdamW if cfg.optimizer is Optimizer.adamw else torch.optim.Adam
    groups = [{"params": list(net.parameters())} for net in (actor, critic)]
    return kind(groups, lr=cfg.lr, weight_decay=cfg.weight_decay, eps=cfg.optimizer_eps, fused=True)


def in_two_groups(state: dict[str, Any], actor_size: int) -> dict[str, Any]:
    """Return an optimizer's state with the actor's parameters in one group and the critic's in another.

    Before 0.3 there was one group for all, the actor's first.
    """
    if len(state["param_groups"]) != 1:
        return state
    (group,) = state["param_groups"]
    parts = group["params"][:actor_size], group["params"][actor_size:]
    return state | {"param_groups": [group | {"params": list(part)} for part in parts]}


def clip_gradients(optimizer: torch.optim.Optimizer, cfg: PPOConfig) -> Tensor:
    """Scale gradients down to `max_grad_norm`, of all parameters or of each group; return their norm."""
    limit = math.inf if cfg.max_grad_norm is None else cfg.max_grad_norm
    groups = [group["params"] for group in optimizer.param_groups]
    if not cfg.separate_optimizers:
        groups = [[parameter for group in groups for parameter in group]]

    norms = [nn.utils.clip_grad_norm_(group, limit, foreach=True) for group in groups]
    return norms[0] if len(norms) == 1 else torch.stack(norms).norm()
