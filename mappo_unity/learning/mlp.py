"""Layers and their initial weights."""

from __future__ import annotations

from torch import nn

from mappo_unity.config.schema import Activation

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    Activation.tanh: nn.Tanh,
    Activation.relu: nn.ReLU,
    Activation.silu: nn.SiLU,
    Activation.elu: nn.ELU,
}


def make_mlp(
    size: int, hidden: list[int], outputs: int, activation: Activation, last_gain: float
) -> nn.Sequential:
    """Build an MLP with orthogonal weights (hidden gain sqrt 2, last layer `last_gain`), zero biases."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [linear(size, width, 2**0.5), ACTIVATIONS[activation]()]
        size = width
    return nn.Sequential(*layers, linear(size, outputs, last_gain))


def linear(size: int, outputs: int, gain: float) -> nn.Linear:
    """Build a linear layer with orthogonal weights of that gain and zero biases."""
    layer = nn.Linear(size, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
