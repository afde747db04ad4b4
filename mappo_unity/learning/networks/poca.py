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

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from mappo_unity.config.schema import ModelConfig
from mappo_unity.learning.networks.attention import (
    EMBEDDING_GAIN,
    HEADS,
    ResidualSelfAttention,
    embedding,
)
from mappo_unity.learning.networks.critics import seen_features
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout
from mappo_unity.learning.networks.mlp import ACTIVATIONS

Read = tuple[Tensor, ...]
"""What `ResidualSelfAttention.read` returns of a team's members."""


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
        widths = list(cfg.critic_hidden or cfg.hidden)
        self.encoder = Encoder(obs, cfg.normalize_obs, cfg.image_encoder, widths[0])

        width = widths[0] + -widths[0] % HEADS
        actions = layout.continuous + sum(layout.branches)
        activation = ACTIVATIONS[cfg.activation]

        self.observed = nn.Sequential(embedding(self.encoder.size, width), activation())
        self.acted = nn.Sequential(embedding(self.encoder.size + actions, width), activation())
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
        return self.value_and_baseline(*inputs)[1]

    def value_and_baseline(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return `value` and `baseline` of the same entries; what both read is computed once.

        Args:
            *inputs: as in `baseline`.
        """
        value, baseline = self.both_features(*inputs)
        return self.head(value), self.head(baseline)

    def features(self, *inputs: Tensor) -> Tensor:
        """Return what `head` makes the value of: ``[..., A, size + 1]``, the last column the count.

        ML-Agents puts its memory over all columns but the last.
        """
        features, seen = seen_features(self.encoder, inputs)
        return self._of_team(self._observed(features), seen)

    def both_features(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `head` makes value and baselines of, each as `features` says."""
        *entries, action = inputs
        features, seen = seen_features(self.encoder, tuple(entries))
        observed, acted = self._observed(features), self._acted(features, seen, action)
        return self._of_team(observed, seen), self._of_mates(observed, acted, seen)

    def _observed(self, features: Tensor) -> Read:
        """Return what attention reads of members by their observations alone."""
        return self.attention.read(self.observed(features))

    def _acted(self, features: Tensor, seen: Tensor, action: Tensor) -> Read:
        """Return what attention reads of members by observation and action."""
        actions = flat_actions(action, self.layout) * seen
        return self.attention.read(self.acted(torch.cat([features, actions], -1)))

    def _of_team(self, observed: Read, seen: Tensor) -> Tensor:
        """Return the value's features, the same for each member."""
        out = self._pool(observed, seen.squeeze(-1))
        return out.unsqueeze(-2).expand(*seen.shape[:-1], self.size + 1)

    def _of_mates(self, observed: Read, acted: Read, seen: Tensor) -> Tensor:
        """Return the baselines' features: of the entities that judge a member its own shows no action."""
        # [A, A, 1]: of the team that judges row a, entity a
        own = torch.eye(seen.shape[-2], dtype=torch.bool, device=seen.device).unsqueeze(-1)
        entities = [torch.where(own, a.unsqueeze(-3), b.unsqueeze(-3)) for a, b in zip(observed, acted)]
        there = seen.squeeze(-1).unsqueeze(-2).expand(entities[0].shape[:-1])
        return self._pool(entities, there)

    def _pool(self, entities: Iterable[Tensor], seen: Tensor) -> Tensor:
        """Turn what was read of entities, with flags ``[..., A]``, into features ``[..., size + 1]``."""
        hidden = self.trunk(self.attention.attend(entities, seen))
        # -1 for nobody, 1 for a full team
        count = 2.0 * seen.sum(-1, keepdim=True) / self.team_size - 1.0
        return torch.cat([hidden, count], -1)


def flat_actions(action: Tensor, layout: ActionLayout) -> Tensor:
    """Return actions ``[..., C + K]`` as floats ``[..., C + sum of branches]``: each branch one-hot."""
    parts = [action[..., : layout.continuous].to(torch.get_default_dtype())]
    for column, size in enumerate(layout.branches, layout.continuous):
        parts.append(one_hot(action[..., column].long(), size).to(parts[0].dtype))
    return torch.cat(parts, -1)


def _trunk_layer(size: int, outputs: int, width: int) -> nn.Linear:
    layer = nn.Linear(size, outputs)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
    with torch.no_grad():
        layer.weight.mul_((EMBEDDING_GAIN / width) ** 0.5)
    nn.init.zeros_(layer.bias)
    return layer
