"""Goal signals that condition a network: a hypernetwork makes the last hidden layer's weights of them.

As ML-Agents' ``goal_conditioning_type: hyper`` (trainers/torch_entities/conditioning.py, ConditionalEncoder).
The goal stays among the network's inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mappo_unity.config.schema import GoalKind, ModelConfig


class HyperLinear(nn.Module):
    """A linear layer whose weights another network makes of a goal; its bias is its own.

    Args:
        goal: features of the goal.
        size: inputs of the layer.
        out_features: outputs of the layer, and the width of the network that makes its weights.
    """

    def __init__(self, goal: int, size: int, out_features: int) -> None:
        super().__init__()
        self.size, self.out_features = size, out_features
        flat = nn.Linear(out_features, size * out_features)
        bound = (out_features * size) ** -0.5
        nn.init.uniform_(flat.weight, -bound, bound)
        nn.init.zeros_(flat.bias)

        self.weights = nn.Sequential(
            *(_hidden(goal, out_features), nn.SiLU()),
            *(_hidden(out_features, out_features), nn.SiLU()),
            nn.LayerNorm(out_features, elementwise_affine=False),
            flat,
        )
        self.bias = nn.Parameter(torch.zeros(out_features))

    def forward(self, x: Tensor, goal: Tensor) -> Tensor:
        """Return ``[..., out_features]`` of ``x`` ``[..., size]`` under goals ``[..., goal]``."""
        weights = self.weights(goal).unflatten(-1, (self.size, self.out_features))
        return (x.unsqueeze(-2) @ weights).squeeze(-2) + self.bias


class GoalConditioned(nn.Module):
    """The hidden layers of an MLP, of which goals among its inputs make the last one.

    Args:
        columns: of the inputs, those that are goals.
        before: the layers before the last hidden one; may be none.
        hyper: the last hidden layer.
        activation: what follows it.
    """

    columns: Tensor

    def __init__(
        self, columns: Sequence[int], before: nn.Sequential, hyper: HyperLinear, activation: nn.Module
    ) -> None:
        super().__init__()
        self.register_buffer("columns", torch.tensor(columns), persistent=False)
        self.before, self.hyper, self.activation = before, hyper, activation

    def forward(self, features: Tensor) -> Tensor:
        """Return ``[..., h]`` of features ``[..., F]``."""
        goal = features.index_select(-1, self.columns)
        return self.activation(self.hyper(self.before(features), goal))


def condition_on_goals(network: Any, cfg: ModelConfig) -> None:
    """Let goals make the last hidden layer of ``network.net``, where the options say so and there are any.

    Args:
        network: has an `encoder` and `net`, an MLP from `make_mlp`.
        cfg: the options.
    """
    columns = network.encoder.goal_columns
    if cfg.goal_conditioning is GoalKind.none or not columns:
        return

    *before, last, activation, head = network.net
    hyper = HyperLinear(len(columns), last.in_features, last.out_features)
    hidden = GoalConditioned(columns, nn.Sequential(*before), hyper, activation)
    network.net = nn.Sequential(hidden, head)


def _hidden(size: int, width: int) -> nn.Linear:
    layer = nn.Linear(size, width)
    nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
    nn.init.zeros_(layer.bias)
    return layer
