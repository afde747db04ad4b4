"""Random network distillation: what a predictor has not seen yet (Burda et al., arXiv 1810.12894).

A predictor learns what a random network, which never changes, says of observations. Where agents have often
been its error is small; elsewhere it is the reward. The next observation counts, as in the paper.
"""

from __future__ import annotations

from torch import Tensor, nn

from mappo_unity.config.schema import Activation, ImageKind, RNDConfig
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.mlp import make_mlp
from mappo_unity.learning.transitions import Transitions


class RandomNetwork(nn.Module):
    """The error of a predictor about a random network.

    Args:
        obs: the observation entries of an agent.
        layout: not looked at.
        cfg: the stream's options.
        images: their encoder.
    """

    def __init__(
        self, obs: ObsLayout, layout: ActionLayout, cfg: RNDConfig, images: ImageKind = ImageKind.auto
    ) -> None:
        super().__init__()
        self.target = _Network(obs, list(cfg.hidden), images)
        self.predictor = _Network(obs, list(cfg.hidden), images)
        self.target.requires_grad_(False)

    def rewards(self, decisions: Transitions) -> Tensor:
        """Return the squared error of the predictor on the next observations, float32 ``[D]``."""
        obs = decisions.next_obs
        return ((self.predictor(obs) - self.target(obs)) ** 2).sum(-1)

    def loss(self, decisions: Transitions) -> Tensor:
        """Return the predictor's mean squared error, a scalar."""
        return self.rewards(decisions).mean()


class _Network(nn.Module):
    def __init__(self, obs: ObsLayout, hidden: list[int], images: ImageKind) -> None:
        super().__init__()
        self.encoder = Encoder(obs, normalize=True, kind=images)
        self.net = make_mlp(self.encoder.size, hidden, hidden[-1], Activation.silu, last_gain=2**0.5)

    def forward(self, obs: list[Tensor]) -> Tensor:
        """Return the network's outputs ``[D, hidden[-1]]``."""
        return self.net(self.encoder(*obs))
