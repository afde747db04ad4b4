"""Layers, their initial weights, and options that change a network after it was built.

`apply_options` walks a network's parts, so that every actor and critic obeys ``layer_norm``,
``weight_init`` and ``obs_norm_prior`` alike; with their defaults it changes nothing.
"""

from __future__ import annotations

import torch
from torch import nn

from mappo_unity.config.schema import Activation, ModelConfig, WeightInit
from mappo_unity.learning.networks.attention import EntityEncoder
from mappo_unity.learning.networks.encoders import Encoder, RunningNorm
from mappo_unity.learning.networks.goals import HyperLinear
from mappo_unity.learning.networks.images import ImageEncoder

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    Activation.tanh: nn.Tanh,
    Activation.relu: nn.ReLU,
    Activation.silu: nn.SiLU,
    Activation.elu: nn.ELU,
}

# ML-Agents' gains of He normal weights (trainers/torch_entities: distributions.py, encoders.py)
CONTINUOUS_GAIN, BRANCH_GAIN, IMAGE_GAIN = 0.2, 0.1, 1.41


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


def apply_options(net: nn.Module, cfg: ModelConfig, continuous: int | None = None) -> nn.Module:
    """Give one network what ``layer_norm``, ``weight_init`` and ``obs_norm_prior`` ask for.

    Args:
        net: an actor or a critic of one member, its last Linear the output layer.
        cfg: the options.
        continuous: of an actor, how many of its first outputs belong to continuous actions; None: a
            critic.

    Returns:
        The same network, changed.
    """
    # before the layer norms, which bring parts of their own
    if cfg.weight_init is WeightInit.kaiming_normal and not getattr(net, "draws_own_weights", False):
        init_kaiming(net)
        init_head(_linears(net)[-1], cfg, continuous)
    if cfg.layer_norm:
        add_layer_norms(net)
    if cfg.obs_norm_prior:
        for part in net.modules():
            if isinstance(part, RunningNorm):
                part.begin_with_prior()
    return net


@torch.no_grad()
def init_head(layer: nn.Linear, cfg: ModelConfig, continuous: int | None = None) -> None:
    """Draw an output layer's weights as ``weight_init`` asks for; see `apply_options`."""
    if cfg.weight_init is not WeightInit.kaiming_normal:
        return

    if continuous is None:
        nn.init.xavier_uniform_(layer.weight)
    else:
        nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
        layer.weight[:continuous].mul_(CONTINUOUS_GAIN)
        layer.weight[continuous:].mul_(BRANCH_GAIN)


@torch.no_grad()
def init_kaiming(net: nn.Module) -> None:
    """Draw hidden weights as ML-Agents does; parts with a scheme of their own, attention too, keep it."""
    for layer in _linears(net):
        nn.init.kaiming_normal_(layer.weight, nonlinearity="linear")
        nn.init.zeros_(layer.bias)

    for part in net.modules():
        if isinstance(part, ImageEncoder):
            for layer in _linears(part):
                layer.weight.mul_(IMAGE_GAIN)


def add_layer_norms(net: nn.Module) -> None:
    """Put a LayerNorm on vector observations and behind every activation that follows a Linear."""
    activations = tuple(ACTIVATIONS.values())
    apart = _inside(net, ImageEncoder, EntityEncoder, HyperLinear)
    for parent in list(net.modules()):
        if isinstance(parent, Encoder) and parent.has_vector:
            parent.norm = nn.Sequential(parent.norm, nn.LayerNorm(parent.vector))

        width = None
        for name, part in list(parent.named_children()):
            if isinstance(part, (nn.Linear, HyperLinear)):
                width = part.out_features
            elif isinstance(part, activations) and width is not None and part not in apart:
                setattr(parent, name, nn.Sequential(part, nn.LayerNorm(width)))


def _linears(net: nn.Module) -> list[nn.Linear]:
    """The Linear layers of a network in the order in which they were made, without those of parts apart."""
    apart = _inside(net, nn.MultiheadAttention, EntityEncoder, HyperLinear)
    return [part for part in net.modules() if isinstance(part, nn.Linear) and part not in apart]


def _inside(net: nn.Module, *kinds: type[nn.Module]) -> set[nn.Module]:
    """All parts of the parts of these kinds."""
    return {inner for part in net.modules() if isinstance(part, kinds) for inner in part.modules()}
