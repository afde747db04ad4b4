"""First layers of networks that mirror, by which these may be left- or right-handed.

A network whose output is mirrored wherever its input is cannot decide where both sides look alike: what it
does there is its own mirror image, and an agent that must turn turns left as often as right, decision after
decision (Kaba and Ravanbakhsh, arXiv 2312.09016). A first layer that tells a situation from its mirror image
lets it prefer a side, and shares all other weights between both.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mappo_unity.config.schema import MirrorConfig


class HandedLinear(nn.Linear):
    """A linear layer over a situation and its mirror image, ``[2, ..., in_features]``.

    Its parameter `side` ``[out_features]`` is added for the first and subtracted for the second; it begins
    with zeros, so that a network begins with no side that it prefers.
    """

    def __init__(self, layer: nn.Linear) -> None:
        super().__init__(layer.in_features, layer.out_features)
        self.weight, self.bias = layer.weight, layer.bias
        self.side = nn.Parameter(torch.zeros(layer.out_features))

    def bias_of(self, image: bool) -> Tensor:
        """Return the bias ``[out_features]`` for a situation, or for its mirror image."""
        return self.bias - self.side if image else self.bias + self.side

    def forward(self, x: Tensor) -> Tensor:
        """Return ``[2, ..., out_features]``."""
        both = super().forward(x)
        return torch.stack([both[0] + self.side, both[1] - self.side])


def make_handed(net: nn.Module, first_layer: str, cfg: MirrorConfig) -> None:
    """Let a network's first layer behind its encoder tell both sides apart, where the options say so.

    Args:
        net: an actor or a critic, built and not yet changed by other options.
        first_layer: path of that layer in the network, such as ``net.0``.
        cfg: the options.
    """
    if not (cfg.is_used and cfg.handed):
        return

    layer = net.get_submodule(first_layer)
    assert isinstance(layer, nn.Linear)
    parent, _, name = first_layer.rpartition(".")
    setattr(net.get_submodule(parent), name, HandedLinear(layer))
