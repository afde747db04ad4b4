"""Critics of a team: what its members' values, in the space of `ValueNorm`, are computed from.

`LocalCritic` sees the member alone (IPPO). `CentralCritic` sees all observations of the team side by
side, flags of who is there, and which member it judges: the agent-specific global state of the MAPPO paper
(arXiv 2103.01955, section 4). `PooledCritic` sees the member, the pooled others and their count, for teams
whose size varies. Members that are not there count as zeros.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mappo_unity.config.schema import CriticKind, ModelConfig
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.goals import condition_on_goals
from mappo_unity.learning.networks.handed import make_handed
from mappo_unity.learning.networks.mlp import ACTIVATIONS, linear, make_mlp

ATTENTION_HEADS = 4
CRITIC_GAIN = 0.01  # first values near 0: whatever the scale of returns, they are no noise to be unlearned


class Critic(nn.Module):
    """A network that ends in the linear layer `head`, whose outputs are values."""

    net: nn.Sequential

    @property
    def head(self) -> nn.Linear:
        """Return the layer that gives values, which PopArt rescales."""
        head = self.net[-1]
        assert isinstance(head, nn.Linear)
        return head


class LocalCritic(Critic):
    """Observation entries ``[..., A, *]`` to values ``[..., A, V]``, each member by itself."""

    def __init__(self, obs: ObsLayout, cfg: ModelConfig, streams: int = 1) -> None:
        super().__init__()
        hidden = list(cfg.critic_hidden or cfg.hidden)
        self.encoder = Encoder(obs, cfg.normalize_obs, cfg.image_encoder, hidden[0])
        self.net = make_mlp(self.encoder.size, hidden, streams, cfg.activation, last_gain=CRITIC_GAIN)
        condition_on_goals(self, cfg)
        make_handed(self, "net.0", cfg.mirror)

    def forward(self, *obs: Tensor) -> Tensor:
        """Return values."""
        return self.net(self.encoder(*obs))


class CentralCritic(Critic):
    """The whole team's observations, who is there and whom it judges, to values ``[..., A, V]``.

    The judged member enters as a one-hot index; its columns of the first layer are `member`, so that
    what all members have in common is computed once.
    """

    def __init__(self, obs: ObsLayout, team_size: int, cfg: ModelConfig, streams: int = 1) -> None:
        super().__init__()
        first, *rest = list(cfg.critic_hidden or cfg.hidden)
        self.encoder = Encoder(obs, cfg.normalize_obs, cfg.image_encoder, first)
        self.joint = linear(team_size * (self.encoder.size + 1), first, 2**0.5)
        self.member = nn.Parameter(torch.randn(team_size, first) * 0.1)
        self.activation = ACTIVATIONS[cfg.activation]()
        self.net = make_mlp(first, rest, streams, cfg.activation, last_gain=CRITIC_GAIN)
        make_handed(self, "joint", cfg.mirror)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return values; the arguments are the observation entries, ``present`` and ``departed``."""
        features, seen = seen_features(self.encoder, inputs)
        joint = self.joint(torch.cat([features.flatten(-2), seen.flatten(-2)], -1))
        # [..., 1, first] + [A, first]: a one-hot index selects one row of weights
        return self.net(self.activation(joint.unsqueeze(-2) + self.member))


class PooledCritic(Critic):
    """A member's own features, its team's pooled and how many there are, to values ``[..., A, V]``."""

    def __init__(self, obs: ObsLayout, team_size: int, cfg: ModelConfig, streams: int = 1) -> None:
        super().__init__()
        first, *rest = list(cfg.critic_hidden or cfg.hidden)
        self.encoder = Encoder(obs, cfg.normalize_obs, cfg.image_encoder, first)

        # attention wants a width that its heads divide
        first += -first % ATTENTION_HEADS
        self.team_size = team_size

        self.token = nn.Sequential(
            linear(self.encoder.size + 1, first, 2**0.5), ACTIVATIONS[cfg.activation]()
        )

        self.attention = (
            nn.MultiheadAttention(first, ATTENTION_HEADS, batch_first=True)
            if cfg.critic is CriticKind.attention
            else None
        )

        self.net = make_mlp(2 * first + 1, rest or [first], streams, cfg.activation, last_gain=CRITIC_GAIN)
        make_handed(self, "token.0", cfg.mirror)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return values; the arguments are the observation entries, ``present`` and ``departed``."""
        features, seen = seen_features(self.encoder, inputs)
        tokens = self.token(torch.cat([features, seen], -1))
        count = seen.sum(-2, keepdim=True)

        if self.attention is None:
            pooled = ((tokens * seen).sum(-2, keepdim=True) / count.clamp_min(1.0)).expand_as(tokens)
        else:
            pooled = self._attend(tokens, seen)

        # the pooled mean does not tell how many there are
        share = (count / self.team_size).expand(*tokens.shape[:-1], 1)
        return self.net(torch.cat([tokens, pooled, share], -1))

    def _attend(self, tokens: Tensor, seen: Tensor) -> Tensor:
        assert self.attention is not None
        # attention takes a single batch dimension
        rows = tokens.flatten(0, -3)
        hidden = seen.flatten(0, -3).squeeze(-1) == 0
        hidden = hidden & ~hidden.all(-1, keepdim=True)  # a team of nobody attends to zeros, not to nothing

        out, _ = self.attention(rows, rows, rows, key_padding_mask=hidden, need_weights=False)
        return out.view_as(tokens)


def seen_features(encoder: Encoder, inputs: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Return features ``[..., A, F]`` with zeros for who is not there, and flags ``[..., A, 1]``."""
    *obs, present, departed = inputs
    seen = (present & ~departed).to(torch.get_default_dtype())
    return encoder(*obs) * seen, seen
