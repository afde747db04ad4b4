"""Curiosity: what a model of the environment does not foresee (ICM, Pathak et al., arXiv 1705.05363).

Observations become features phi. An inverse model tells the action from phi and the next phi, so that
features hold what actions change; a forward model foresees the next phi from phi and the action. Its error
is the reward. Sizes and weights of the losses are ML-Agents' (trainers/torch_entities/components/
reward_providers/curiosity_reward_provider.py).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from mappo_unity.config.schema import Activation, CuriosityConfig, ImageKind
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.mlp import ACTIVATIONS, make_mlp
from mappo_unity.learning.transitions import Transitions, env_actions

MODEL_WIDTH = 256  # of the hidden layer of both models
FORWARD_WEIGHT, INVERSE_WEIGHT = 2.0, 8.0  # 10 * (0.2 * forward + 0.8 * inverse)


class Curiosity(nn.Module):
    """The error of a forward model in features that an inverse model shapes.

    Args:
        obs: the observation entries of an agent.
        layout: the sizes of its action.
        cfg: the stream's options.
        images: their encoder.
    """

    def __init__(
        self,
        obs: ObsLayout,
        layout: ActionLayout,
        cfg: CuriosityConfig,
        images: ImageKind = ImageKind.auto,
    ) -> None:
        super().__init__()
        self.layout = layout
        *hidden, width = list(cfg.hidden)
        actions = layout.continuous + sum(layout.branches)

        self.encoder = Encoder(obs, normalize=True, kind=images)
        self.body = nn.Sequential(
            make_mlp(self.encoder.size, hidden, width, Activation.silu, last_gain=2**0.5),
            ACTIVATIONS[Activation.silu](),
        )
        self.inverse = make_mlp(2 * width, [MODEL_WIDTH], actions, Activation.silu, last_gain=0.01)
        self.foresight = make_mlp(width + actions, [MODEL_WIDTH], width, Activation.silu, last_gain=1.0)

    def rewards(self, decisions: Transitions) -> Tensor:
        """Return half the squared error of the forward model, float32 ``[D]``."""
        before, after = self._features(decisions.obs), self._features(decisions.next_obs)
        return self._error(before, after, env_actions(decisions.action, self.layout))

    def loss(self, decisions: Transitions) -> Tensor:
        """Return the weighted loss of both models, a scalar."""
        before, after = self._features(decisions.obs), self._features(decisions.next_obs)
        action = env_actions(decisions.action, self.layout)

        told = self.inverse(torch.cat([before, after], -1))
        parts = list(told.split([self.layout.continuous, *self.layout.branches], -1))
        continuous = parts.pop(0)
        inverse = ((continuous - action[:, : self.layout.continuous]) ** 2).sum(-1).mean()
        for column, logits in enumerate(parts, self.layout.continuous):
            inverse = inverse + cross_entropy(logits, decisions.action[:, column].long())

        return FORWARD_WEIGHT * self._error(before, after, action).mean() + INVERSE_WEIGHT * inverse

    def _features(self, obs: list[Tensor]) -> Tensor:
        return self.body(self.encoder(*obs))

    def _error(self, before: Tensor, after: Tensor, action: Tensor) -> Tensor:
        foreseen = self.foresight(torch.cat([before, action], -1))
        return 0.5 * ((after - foreseen) ** 2).sum(-1)
