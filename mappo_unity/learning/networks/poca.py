"""The critic of MA-POCA (arXiv 2111.05992): a team's value, and a baseline for each member's action.

Built as ML-Agents builds it (trainers/torch_entities/networks.py, MultiAgentNetworkBody). Members are
entities: an embedding of the observation alone, or of observation and action. Self-attention over the
entities that are there, their mean and an MLP give features, to which how many there are is appended;
one linear head makes a value of them. Value and baseline are two readings of the same weights:

    value       entities of all members' observations
    baseline a  the entity of a's observation, entities of its mates' observations and actions

So the baseline of a member does not depend on its own action, and a team may change its size.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, one_hot

from mappo_unity.config.schema import ModelConfig
from mappo_unity.learning.networks.critics import seen_features
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.mlp import ACTIVATIONS

HEADS = 4
ABSENT = -1e6  # score of an entity that is not there; finite, so that a team of nobody gives numbers
EMBEDDING_GAIN = 0.125  # initial weights have variance 0.125 / width (T-Fixup, as ML-Agents)


class PocaCritic(nn.Module):
    """Team value and members' baselines ``[..., A, V]`` from the entries of a team.

    Args:
        obs: the observation entries of a member.
        layout: the sizes of its action.
        team_size: slots A of a team.
        cfg: widths are ``critic_hidden`` (or ``hidden``); entities have the first one, rounded up to a
            multiple of 4.
        head_size: what `head` takes beside the count, where a memory of another width stands before
            it; None: the last width.
        streams: V, reward streams that have a value each.
    """

    draws_own_weights = True  # whatever model.weight_init says

    def __init__(
        self,
        obs: ObsLayout,
        layout: ActionLayout,
        team_size: int,
        cfg: ModelConfig,
        head_size: int | None = None,
        streams: int = 1,
    ) -> None:
        super().__init__()
        self.layout, self.team_size = layout, team_size
        self.encoder = Encoder(obs, cfg.normalize_obs)

        widths = list(cfg.critic_hidden or cfg.hidden)
        width = widths[0] + -widths[0] % HEADS
        actions = layout.continuous + sum(layout.branches)
        activation = ACTIVATIONS[cfg.activation]

        self.observed = nn.Sequential(_embedding(self.encoder.size, width), activation())
        self.acted = nn.Sequential(_embedding(self.encoder.size + actions, width), activation())
        self.attention = ResidualSelfAttention(width)

        layers: list[nn.Module] = []
        size = width
        for outputs in widths:
            layers += [_trunk_layer(size, outputs, width), activation()]
            size = outputs
        self.trunk = nn.Sequential(*layers)

        self.size = size  # of the features, without the count
        self.head = nn.Linear(size + 1 if head_size is None else head_size + 1, streams)
        nn.init.xavier_uniform_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the team's value, as `value`: what a critic in a TensorDictModule is asked for."""
        return self.value(*inputs)

    def value(self, *inputs: Tensor) -> Tensor:
        """Return the team's value ``[..., A, V]``, the same for every member.

        Args:
            *inputs: the observation entries ``[..., A, *]``, then bool ``present`` and ``departed``
                ``[..., A, 1]``.
        """
        return self.head(self.features(*inputs))

    def baseline(self, *inputs: Tensor) -> Tensor:
        """Return every member's baseline ``[..., A, V]``: the value without knowing its own action.

        Args:
            *inputs: as in `value`, then actions ``[..., A, C + K]`` as `ActionDistribution` draws them.
        """
        return self.head(self.baseline_features(*inputs))

    def features(self, *inputs: Tensor) -> Tensor:
        """Return what `head` makes the value of: ``[..., A, size + 1]``, the last column the count.

        ML-Agents puts its memory over all columns but the last.
        """
        features, seen = seen_features(self.encoder, inputs)
        out = self._pool(self.observed(features), seen.squeeze(-1))
        return out.unsqueeze(-2).expand(*features.shape[:-1], self.size + 1)

    def baseline_features(self, *inputs: Tensor) -> Tensor:
        """Return what `head` makes the baselines of: ``[..., A, size + 1]``, as in `features`."""
        *entries, action = inputs
        features, seen = seen_features(self.encoder, tuple(entries))
        actions = flat_actions(action, self.layout) * seen

        observed = self.observed(features).unsqueeze(-3)  # [..., 1, A, h]
        acted = self.acted(torch.cat([features, actions], -1)).unsqueeze(-3)

        # [A, A, 1]: of the team that judges row a, only entity a shows no action
        own = torch.eye(features.shape[-2], dtype=torch.bool, device=features.device).unsqueeze(-1)
        entities = torch.where(own, observed, acted)  # [..., A, A, h]

        there = seen.squeeze(-1).unsqueeze(-2).expand(entities.shape[:-1])
        return self._pool(entities, there)

    def _pool(self, entities: Tensor, seen: Tensor) -> Tensor:
        """Turn entities ``[..., A, h]`` with flags ``[..., A]`` into features ``[..., size + 1]``."""
        hidden = self.trunk(self.attention(entities, seen))
        # -1 for nobody, 1 for a full team
        count = 2.0 * seen.sum(-1, keepdim=True) / self.team_size - 1.0
        return torch.cat([hidden, count], -1)


class ResidualSelfAttention(nn.Module):
    """Entities ``[..., N, h]`` that attend to each other, to their mean ``[..., h]``.

    Layer norms have no weights; scores are divided by the root of the whole width, not of a head's.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.query, self.key = _embedding(width, width), _embedding(width, width)
        self.content, self.out = _embedding(width, width), _embedding(width, width)

    def forward(self, entities: Tensor, seen: Tensor) -> Tensor:
        """Return the mean over the entities that are there; ``seen`` ``[..., N]`` is 1 for them, else 0."""
        x = layer_norm(entities, (self.width,))
        query, key, content = (self._heads(net(x)) for net in (self.query, self.key, self.content))

        scores = query @ key.transpose(-1, -2) / self.width**0.5  # [..., heads, N, N]
        absent = (seen == 0).unsqueeze(-2).unsqueeze(-2)
        weights = scores.masked_fill(absent, ABSENT).softmax(-1)
        attended = (weights @ content).transpose(-2, -3).flatten(-2)

        out = layer_norm(self.out(attended) + x, (self.width,))
        total = (out * seen.unsqueeze(-1)).sum(-2)
        return total / seen.sum(-1, keepdim=True).clamp_min(1.0)

    def _heads(self, x: Tensor) -> Tensor:
        """Turn ``[..., N, h]`` into ``[..., heads, N, h / heads]``."""
        return x.unflatten(-1, (HEADS, self.width // HEADS)).transpose(-2, -3)


def flat_actions(action: Tensor, layout: ActionLayout) -> Tensor:
    """Return actions ``[..., C + K]`` as floats ``[..., C + sum of branches]``: each branch one-hot."""
    parts = [action[..., : layout.continuous].to(torch.get_default_dtype())]
    for column, size in enumerate(layout.branches, layout.continuous):
        parts.append(one_hot(action[..., column].long(), size).to(parts[0].dtype))
    return torch.cat(parts, -1)


def _embedding(size: int, width: int) -> nn.Linear:
    layer = nn.Linear(size, width)
    nn.init.normal_(layer.weight, std=(EMBEDDING_GAIN / width) ** 0.5)
    nn.init.zeros_(layer.bias)
    return layer


def _trunk_layer(size: int, outputs: int, width: int) -> nn.Linear:
    layer = nn.Linear(size, outputs)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
    with torch.no_grad():
        layer.weight.mul_((EMBEDDING_GAIN / width) ** 0.5)
    nn.init.zeros_(layer.bias)
    return layer
