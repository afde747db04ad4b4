"""Self-attention over entities: those of variable-length sensors, or the members of a team.

Built as ML-Agents builds it (trainers/torch_entities/attention.py): weights from a normal distribution of
variance 0.125 / width (T-Fixup), four heads, layer norms without weights.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, silu

HEADS = 4
ABSENT = -1e6  # score of an entity that is not there; finite, so that nobody at all gives numbers
EMBEDDING_GAIN = 0.125  # initial weights have variance 0.125 / width (T-Fixup, as ML-Agents)
ENTITY_FEATURES = 128  # ML-Agents' width of attention over sensors, whatever the networks' widths


class ResidualSelfAttention(nn.Module):
    """Entities ``[..., N, h]`` that attend to each other, to their mean ``[..., h]``.

    Layer norms have no weights; scores are divided by the root of the whole width, not of a head's.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.width = width
        self.query, self.key = embedding(width, width), embedding(width, width)
        self.content, self.out = embedding(width, width), embedding(width, width)

    def forward(self, entities: Tensor, seen: Tensor) -> Tensor:
        """Return the mean over the entities that are there; ``seen`` ``[..., N]`` is 1 for them, else 0."""
        return self.attend(self.read(entities), seen)

    def read(self, entities: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the normalised entities, and of each its query, its key and its content, ``[..., N, h]``.

        Whoever puts them together anew for `attend` need not compute them anew.
        """
        x = layer_norm(entities, (self.width,))
        return x, self.query(x), self.key(x), self.content(x)

    def attend(self, read: Iterable[Tensor], seen: Tensor) -> Tensor:
        """Return what `forward` returns, from what `read` returned."""
        x, *projected = read
        query, key, content = (self._heads(part) for part in projected)

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


class EntityEmbedding(nn.Module):
    """Entities ``[..., N, F]``, each beside what the agent itself is, to ``[..., N, width]``.

    Args:
        own: width of what the agent itself is; 0: entities stand alone.
        features: F of an entity.
        width: of the embedding.
    """

    def __init__(self, own: int, features: int, width: int) -> None:
        super().__init__()
        self.own = own
        self.layer = embedding(own + features, width)

    def forward(self, entities: Tensor, own: Tensor | None) -> Tensor:
        """Return the embedded entities; ``own`` ``[..., own]`` stands before each one's features."""
        weight = self.layer.weight
        # what all entities have before them is multiplied once
        out = entities @ weight[:, self.own :].T + self.layer.bias
        return silu(out if own is None else out + (own @ weight[:, : self.own].T).unsqueeze(-2))


class EntityEncoder(nn.Module):
    """Entities of all variable-length sensors to one code ``[..., 128]``, whatever their order.

    An entity whose features are all 0 is not there: Unity fills a sensor up with such rows.

    Args:
        sizes: the features of an entity, for each sensor.
        own: features of all other sensors, beside which each entity is seen; 0: there are none.
    """

    def __init__(self, sizes: Sequence[int], own: int) -> None:
        super().__init__()
        width = ENTITY_FEATURES
        self.own = nn.Sequential(embedding(own, width), nn.SiLU()) if own else None
        self.entities = nn.ModuleList([EntityEmbedding(width if own else 0, size, width) for size in sizes])
        self.attention = ResidualSelfAttention(width)

    def forward(self, own: Tensor | None, sets: Sequence[Tensor]) -> Tensor:
        """Return the code of sets ``[..., N_i, F_i]``, beside ``own`` ``[..., own]`` where there is any."""
        around = None if self.own is None else self.own(own)
        rows = [net(entities, around) for net, entities in zip(self.entities, sets)]
        seen = torch.cat([(entities != 0).any(-1) for entities in sets], -1).to(rows[0].dtype)
        return self.attention(torch.cat(rows, -2), seen)


def embedding(size: int, width: int) -> nn.Linear:
    """Build a linear layer with the initial weights of this module, zero biases."""
    layer = nn.Linear(size, width)
    nn.init.normal_(layer.weight, std=(EMBEDDING_GAIN / width) ** 0.5)
    nn.init.zeros_(layer.bias)
    return layer
