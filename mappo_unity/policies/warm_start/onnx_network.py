"""The policy network in an ONNX file of ML-Agents (formats 2 and 3) or of ours, found by its structure.

The graph is read backwards from the actions: their linear layers, the memory, the hidden layers, what is
made of each sensor. Names decide only what ML-Agents fixes: those of inputs and outputs.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mappo_unity.config.schema import MirrorConfig
from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_graph import MIRROR
from mappo_unity.policies.warm_start.actions import Actions, read_actions
from mappo_unity.policies.warm_start.graph import Linear, OnnxGraph
from mappo_unity.policies.warm_start.sensors import Part, read_convolutions, read_parts
from mappo_unity.policies.warm_start.state import State, read_state

Scale = tuple[np.ndarray, np.ndarray]
"""Weight and bias of a layer normalisation."""


class Hidden(NamedTuple):
    """A hidden layer."""

    linear: Linear
    activation: str
    norm: Scale | None  # behind the activation
    output: str


@dataclass(frozen=True)
class OnnxNetwork:
    """What an ONNX file holds of a policy.

    Attributes: `graph`; `actions`, their layers; `state`, the memory; `layers`, the hidden ones, first to
    last; `parts`, what the first of them takes, in its order; `vector_norm`, of all vector observations;
    `mirror`, the options of a network of ours that mirrors, of another one the empty ones; `side`, by which
    the first hidden layer of one that prefers a side tells both apart (`handed.HandedLinear`).
    """

    graph: OnnxGraph
    actions: Actions
    state: State | None
    layers: list[Hidden]
    parts: list[Part]
    vector_norm: Scale | None
    mirror: dict[str, Any]
    side: np.ndarray | None = None

    @property
    def options(self) -> dict[str, Any]:
        """The model options of a network of ours of this shape, as plain values."""
        out: dict[str, Any] = {
            "hidden": [len(layer.linear.bias) for layer in self.layers],
            "activation": self.layers[0].activation,
            "layer_norm": self.layers[0].norm is not None,
            "memory": "none",
            "mirror": self.mirror,
        }
        out |= {} if self.state is None else self.state.options

        # the rest only where the file has what it is about, in the order in which it is shown
        if any(part.image is None for part in self.parts):
            out["normalize_obs"] = any(part.mean is not None for part in self.parts)
        if self.actions.mean is not None:
            out["action_distribution"] = "tanh_normal" if self.actions.squashed else "gaussian"

        kinds = {part.image.kind for part in self.parts if part.image is not None}
        if len(kinds) == 1 and "" not in kinds:
            out["image_encoder"] = kinds.pop()

        if self.actions.init_log_std is not None:
            out["init_log_std"] = self.actions.init_log_std
        if len(self.actions.branch_sizes) > 1:
            out["flatten_branches"] = self.actions.joint
        return out


@lru_cache(maxsize=16)
def read_network(path: Path) -> OnnxNetwork:
    """Read the policy network of an ONNX file.

    Raises:
        ConfigError: it is no ONNX model of ML-Agents, or its network is of another kind than ours.
        ExportError: the package onnx is missing.
    """
    graph = OnnxGraph(path)
    try:
        return _read_network(graph)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        # other programs write operators in other ways
        raise ConfigError(f"{path}: its network is of a kind that cannot be read ({error!r})") from error


def _read_network(graph: OnnxGraph) -> OnnxNetwork:
    path = graph.path
    actions = read_actions(graph)
    mirror, image = asdict(MirrorConfig()), None
    if MIRROR in graph.metadata:
        mirror |= json.loads(graph.metadata[MIRROR])
        actions, image = _seen_directly(graph, actions)
    state = read_state(graph, actions.hidden)
    layers, features = _hidden_layers(graph, actions.hidden if state is None else state.features)

    # where there is nothing but one image, the first layer found is that of its encoder
    if layers and read_convolutions(graph, features) is not None:
        features = layers.pop(0).output
    if not layers:
        raise ConfigError(
            f"{path}: its network has no hidden layer that can be read: its actions come from "
            f"{graph.op(graph.through(features)) or 'its inputs'}; linear layers with an activation can be "
            "read, goal conditioning cannot"
        )

    kinds = {(layer.activation, layer.norm is not None) for layer in layers}
    if len(kinds) > 1:
        raise ConfigError(
            f"{path}: its hidden layers differ in their kind ({', '.join(sorted(map(str, kinds)))}); those "
            "of a network here are all alike"
        )
    side = None
    if mirror["handed"] and image is not None:
        layers, side = _apart(layers, _hidden_layers(graph, image)[0][-len(layers) :])
    return OnnxNetwork(graph, actions, state, layers, *read_parts(graph, features), mirror, side)


def _apart(layers: list[Hidden], image: list[Hidden]) -> tuple[list[Hidden], np.ndarray]:
    """Return the layers with the bias that both sides share, and what tells these apart."""
    (first, *rest), other = layers, image[0]
    own, theirs = first.linear.bias, other.linear.bias
    shared = first._replace(linear=first.linear._replace(bias=(own + theirs) / 2))
    return [shared, *rest], (own - theirs) / 2


def _seen_directly(graph: OnnxGraph, actions: Actions) -> tuple[Actions, str]:
    """Return the actions of a mirrored network as its own layers give them (`onnx_sensors.mirrored_head`).

    Those of the file take the features of a situation and, behind them, of its mirror image, whose name is
    returned, too.
    """
    features, image = graph.node(graph.through(actions.hidden)).input

    def half(layer: Linear) -> Linear:
        return layer._replace(x=features, weight=2 * layer.weight[:, : layer.weight.shape[1] // 2])

    mean = None if actions.mean is None else half(actions.mean)
    raw_std = None if actions.raw_std is None else half(actions.raw_std)
    branches = [half(layer) for layer in actions.branches]
    return replace(actions, mean=mean, raw_std=raw_std, branches=branches, hidden=features), image


def _hidden_layers(graph: OnnxGraph, name: str) -> tuple[list[Hidden], str]:
    """Return the hidden layers before a name, first to last, and what the first one takes."""
    layers: list[Hidden] = []
    while True:
        at = graph.through(name)
        normed = graph.layer_norm(at)
        active = graph.activation(graph.through(normed[0]) if normed else at)
        linear = graph.linear(active[0]) if active is not None else None
        if active is None or linear is None:
            return layers[::-1], name
        layers.append(Hidden(linear, active[1], normed[1:] if normed else None, at))
        name = linear.x
