"""GAIL: reward for what looks as if an expert had done it (Ho and Ermon, arXiv 1606.03476).

A discriminator learns to tell a policy's decisions from demonstrations; the policy earns what it takes for
the demonstrations'. With a bottleneck (VAIL, Peng et al., arXiv 1810.00821) it sees noisy features only.
Losses and constants are ML-Agents' (trainers/torch_entities/components/reward_providers/
gail_reward_provider.py), but for the gradient penalty, which there looks at the first sensor alone and here
at all features.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from mappo_unity.config.schema import Activation, GAILConfig, ImageKind
from mappo_unity.learning.imitation.expert import Expert
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.mlp import ACTIVATIONS, make_mlp
from mappo_unity.learning.transitions import Transitions, env_actions

PENALTY = 10.0  # of gradients whose norm is not 1 (Gulrajani et al., arXiv 1704.00028)
BOTTLENECK, INFORMATION, BETA_STEP = 128, 0.5, 5e-4  # VAIL: width, nats that may pass, step of its price


class Discriminator(nn.Module):
    """Tells the expert's decisions from the policy's.

    Args:
        obs: the observation entries of an agent.
        layout: the sizes of its action.
        cfg: the stream's options.
        expert: the demonstrations; None: it has only a shape.
        images: their encoder.
    """

    beta: Tensor

    def __init__(
        self,
        obs: ObsLayout,
        layout: ActionLayout,
        cfg: GAILConfig,
        expert: Expert | None,
        images: ImageKind = ImageKind.auto,
    ) -> None:
        super().__init__()
        self.layout, self.cfg, self.expert = layout, cfg, expert
        self.encoder = Encoder(obs, normalize=True, kind=images)
        # ends stand beside actions, as in ML-Agents
        extra = layout.continuous + sum(layout.branches) + 1 if cfg.use_actions else 0
        *hidden, width = list(cfg.hidden)
        self.body = nn.Sequential(
            make_mlp(self.encoder.size + extra, hidden, width, Activation.silu, last_gain=2**0.5),
            ACTIVATIONS[Activation.silu](),
        )
        self.register_buffer("beta", torch.zeros(()))
        if cfg.use_vail:
            self.mean = nn.Linear(width, BOTTLENECK)
            self.log_var = nn.Parameter(torch.zeros(BOTTLENECK))
        self.head = nn.Linear(BOTTLENECK if cfg.use_vail else width, 1)

    def rewards(self, decisions: Transitions) -> Tensor:
        """Return ``-log(1 - D)``, float32 ``[D]``."""
        logits, _ = self._judge(self._features(decisions))
        return softplus(logits)

    def loss(self, decisions: Transitions) -> Tensor:
        """Return the discriminator's loss beside as many of the expert's decisions, a scalar."""
        assert self.expert is not None
        device = decisions.at.device
        drawn = torch.randint(len(self.expert), (len(decisions),)).to(device)
        theirs, ours = self._features(self.expert.steps[drawn]), self._features(decisions)

        expert, expert_mean = self._judge(theirs, noisy=True)
        policy, policy_mean = self._judge(ours, noisy=True)
        # -log D of the expert's, -log(1 - D) of the policy's
        loss = softplus(-expert).mean() + softplus(policy).mean() + PENALTY * self._penalty(theirs, ours)
        if not self.cfg.use_vail:
            return loss

        information = self._information(expert_mean) + self._information(policy_mean)  # ML-Agents' sum
        price = self.beta.clone()
        self.beta.add_(BETA_STEP * (information.detach() - INFORMATION)).clamp_(min=0.0)
        return loss + price * (information - INFORMATION)

    def _features(self, decisions: Transitions) -> Tensor:
        features = self.encoder(*decisions.obs)
        if not self.cfg.use_actions:
            return features
        ended = decisions.ended.unsqueeze(-1).to(features.dtype)
        return torch.cat([features, env_actions(decisions.action, self.layout), ended], -1)

    def _judge(self, features: Tensor, noisy: bool = False) -> tuple[Tensor, Tensor]:
        """Return logits ``[D]`` that these are the expert's, and what the bottleneck holds."""
        hidden = self.body(features)
        if not self.cfg.use_vail:
            return self.head(hidden).squeeze(-1), hidden
        mean = self.mean(hidden)
        seen = mean + torch.exp(0.5 * self.log_var) * torch.randn_like(mean) if noisy else mean
        return self.head(seen).squeeze(-1), mean

    def _information(self, mean: Tensor) -> Tensor:
        """Return the mean KL divergence of the bottleneck from a standard normal, in nats."""
        return 0.5 * (mean**2 + self.log_var.exp() - 1 - self.log_var).sum(-1).mean()

    def _penalty(self, theirs: Tensor, ours: Tensor) -> Tensor:
        """Return how far norms of the judgement's gradient between both kinds are from 1."""
        share = torch.rand(len(ours), 1, device=ours.device)
        between = (share * theirs + (1 - share) * ours).detach().requires_grad_()
        judged = torch.sigmoid(self._judge(between)[0])
        (gradient,) = torch.autograd.grad(judged.sum(), between, create_graph=True)
        # the root of 0 has no gradient
        norm = (gradient.pow(2).sum(-1) + 1e-12).sqrt()
        return ((norm - 1) ** 2).mean()
