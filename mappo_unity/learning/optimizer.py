"""The optimizer of an actor and a critic: its groups, gradients, older states, a critic's warm-up."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from mappo_unity import keys
from mappo_unity.config.schema import Optimizer, PPOConfig
from mappo_unity.learning.advantage import scheduled
from mappo_unity.learning.reduction import ALONE, Reduction

STEER = 1.5  # what a rate is multiplied or divided by after an update
SCALES = 0.01, 10.0  # between which a steered rate stays, in units of the scheduled one


def make_optimizer(actor: nn.Module, critic: nn.Module, cfg: PPOConfig) -> torch.optim.Optimizer:
    """Build the optimizer, with a group for the actor and one for the critic.

    Its fused form makes one pass over all parameters.
    """
    groups = [{"params": list(net.parameters())} for net in (actor, critic)]
    return kind_of(cfg)(groups, lr=cfg.lr, weight_decay=cfg.weight_decay, eps=cfg.optimizer_eps, fused=True)


def load_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, Any]) -> None:
    """Restore an optimizer's moments; rates and all else that options say stay as they are now."""
    options = [{name: v for name, v in group.items() if name != "params"} for group in optimizer.param_groups]
    optimizer.load_state_dict(state)
    for group, own in zip(optimizer.param_groups, options, strict=True):
        group.update(own)


def kind_of(cfg: PPOConfig) -> type[torch.optim.Adam]:
    """Return the class that ppo.optimizer names."""
    return torch.optim.AdamW if cfg.optimizer is Optimizer.adamw else torch.optim.Adam


class LearningRates:
    """The learning rates of both groups: their schedule, steered by how far updates move the policy.

    Steering is that of rsl_rl (`PPO.update`, schedule "adaptive"; Schulman et al., arXiv 1707.06347, section
    4, has the same rule for a penalty), here once an update.

    Args:
        optimizer: of `make_optimizer`.
        cfg: the learner's options.

    Attributes: `scale`, what the scheduled rates are multiplied by; 1 without steering.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, cfg: PPOConfig) -> None:
        self._optimizer, self._cfg, self.scale = optimizer, cfg, 1.0

    def begin(self, progress: float) -> float:
        """Set the rates after a share of the run, 0 to 1; return the actor's."""
        cfg = self._cfg
        starts = cfg.lr, cfg.lr if cfg.critic_lr is None else cfg.critic_lr
        rates = [self.scale * scheduled(cfg.lr_schedule, start, cfg.lr_final, progress) for start in starts]

        for group, rate in zip(self._optimizer.param_groups, rates):
            group["lr"] = rate
        return rates[0]

    def steer(self, kl: float) -> None:
        """Take note of how far an update moved the policy; of one that failed `kl` is infinite."""
        target = self._cfg.lr_target_kl
        if target is None:
            return
        if kl > 2 * target:
            self.scale = max(self.scale / STEER, SCALES[0])
        elif kl < target / 2:
            self.scale = min(self.scale * STEER, SCALES[1])


def cloned(state: Any) -> Any:
    """Return a state dict with tensors of its own; `copy.deepcopy` takes several times as long."""
    if isinstance(state, Tensor):
        return state.detach().clone()
    if isinstance(state, dict):
        return {key: cloned(value) for key, value in state.items()}
    return [cloned(value) for value in state] if isinstance(state, list) else state


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
    # that of a group without gradients, an actor's while its critic warms up, is a number on the CPU
    return norms[0] if len(norms) == 1 else torch.stack([norm.to(norms[-1].device) for norm in norms]).norm()


class CriticWarmup:
    """Let the critic learn alone until so many decisions were collected: a new one beside a trained actor.

    Args:
        steps: agent decisions; 0: never.
        actor: what stands still until then, its normaliser too.

    Attributes: `decisions`, collected so far; `active`, whether the critic alone learns the newest batch;
    `reduction`, of several learners, whose decisions count together.
    """

    def __init__(self, steps: int, actor: nn.Module) -> None:
        self.steps, self.decisions, self.active = steps, 0, False
        self.reduction: Reduction = ALONE
        self._still = set(actor.modules())

    def begin(self, batch: TensorDictBase) -> dict[str, float]:
        """Take note of a batch that is about to be learnt; return a metric, where there is a warm-up."""
        self.active = self.decisions < self.steps
        self.decisions += self.reduction.total(int(batch.get(keys.ACTING).sum()))
        return {"critic_warmup": float(self.active)} if self.steps else {}

    def free(self, norms: list[Any]) -> list[Any]:
        """Return those of the actor's normalisers that may move with the next batch."""
        return [] if self.decisions < self.steps else norms

    def total(self, losses: Mapping[str, Tensor]) -> Tensor:
        """Return what is minimised now."""
        if self.active:
            return losses["loss_critic"]
        return losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]

    def moving(self, norms: Iterable[nn.Module]) -> list[Any]:
        """Return the normalisers that move now."""
        return [norm for norm in norms if not (self.active and norm in self._still)]
