"""The loss of PPO over slots of which not all act: TorchRL's ClipPPOLoss with masks."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from mappo_unity import keys
from mappo_unity.config.schema import PPOConfig, ValueLoss
from mappo_unity.learning.advantage import masked_mean

ACTOR_LEARNS = "actor_learns"  # bool [rows, A, 1]: the slot acted and the outcome is known
CRITIC_LEARNS = "critic_learns"  # bool [rows, A, 1]: the same, or its agent departed while a team mate acted


class MaskedClipPPOLoss(ClipPPOLoss):
    """ClipPPOLoss over the slots that acted, with a Huber threshold of choice.

    TorchRL's smooth_l1 has its knee at 1: dividing prediction and target by delta and multiplying
    the loss by delta**2 gives the Huber loss with its knee at delta.
    """

    def __init__(self, actor: ProbabilisticActor, critic: TensorDictModule, cfg: PPOConfig) -> None:
        self.huber_delta = cfg.huber_delta if cfg.value_loss is ValueLoss.huber else 1.0
        super().__init__(
            actor,
            critic,
            clip_epsilon=cfg.clip_epsilon,
            entropy_coeff=cfg.entropy_coef,
            critic_coeff=cfg.value_coef * self.huber_delta**2,
            loss_critic_type="smooth_l1" if cfg.value_loss is ValueLoss.huber else "l2",
            # `PolicyLearner` normalises over the batch, this would do so over a minibatch
            normalize_advantage=False,
            # values are divided by delta before they are clipped, see `_critic_loss_inputs`
            clip_value=cfg.clip_epsilon / self.huber_delta if cfg.clip_value else None,
            functional=False,
        )
        self.log_explained_variance = False
        self.loss_mask_key = ACTOR_LEARNS
        self.set_keys(value=keys.VALUE, sample_log_prob=keys.LOG_PROB, action=keys.ACTION)
        self.log_ratio = self.entropy = torch.zeros(())

    def _get_entropy(self, dist: Any, adv_shape: torch.Size) -> Tensor:
        # TorchRL's own falls back to sampling when a number is not finite; here that is for `_update` to see
        entropy = dist.entropy().unsqueeze(-1)
        self.entropy = entropy.detach()
        return entropy

    def loss_critic(self, tensordict: TensorDictBase) -> Any:
        """Return the critic's loss over all slots with a value, in a shape that the mask of actions keeps."""
        loss, *rest = super().loss_critic(tensordict)
        return masked_mean(loss, tensordict.get(CRITIC_LEARNS)).expand(loss.shape), *rest

    def _log_weight(self, tensordict: TensorDictBase, adv_shape: torch.Size) -> Any:
        out = super()._log_weight(tensordict, adv_shape)
        self.log_ratio = out[0].detach()
        return out

    def _critic_loss_inputs(
        self, target_return: Tensor, state_value: Tensor, old_state_value: Tensor | None
    ) -> Any:
        delta = self.huber_delta
        old = None if old_state_value is None else old_state_value / delta
        return target_return / delta, state_value / delta, old
