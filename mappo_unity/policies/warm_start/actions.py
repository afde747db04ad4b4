"""The action layers in an ONNX file: the means of continuous actions, the logits of branches."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.distributions import LEAST_SCALE
from mappo_unity.policies.warm_start.graph import Linear, OnnxGraph

CONTINUOUS, DISCRETE, SHAPE = "continuous_actions", "discrete_actions", "discrete_action_output_shape"


@dataclass(frozen=True)
class Actions:
    """The layers that give actions.

    Attributes: `mean` of continuous actions; `log_std` ``[C]`` where it does not depend on what is seen,
    `raw_std` the layer that gives our squashed actions' deviations, and `init_log_std` what these were at
    first; `squashed`, whether the mean goes through tanh; `branches`, the logits of each, or of all
    combinations (`joint`); `branch_sizes`; `hidden`, the name that all of them take.
    """

    mean: Linear | None
    log_std: np.ndarray | None
    raw_std: Linear | None
    init_log_std: float | None
    squashed: bool
    branches: list[Linear]
    branch_sizes: list[int]
    joint: bool
    hidden: str


def read_actions(graph: OnnxGraph) -> Actions:
    """Read the action layers of a file.

    Raises:
        ConfigError: it has no actions of ML-Agents, or they come from something else than linear layers.
    """
    found = [name for name in (CONTINUOUS, DISCRETE) if name in graph.outputs]
    if not found:
        raise ConfigError(
            f"{graph.path} is no ML-Agents model of format 2 or 3: its outputs are "
            f"{', '.join(graph.outputs) or 'none'}, none of {CONTINUOUS}, {DISCRETE}"
        )

    mean = log_std = raw_std = init_log_std = None
    squashed, branches = False, []
    if CONTINUOUS in found:
        mean, squashed = _mean(graph)
        std = _deviation(graph, mean)
        log_std = None if std is None else _log_std(graph, std, len(mean.bias))
        raw_std, init_log_std = (None, None) if std is None else _softplus_layer(graph, std)
    if DISCRETE in found:
        branches = _layers_behind(graph, _best_output(graph, DISCRETE))
    if not (mean or branches):
        raise ConfigError(f"{graph.path}: its actions come from no linear layer")

    inputs = {graph.through(layer.x) for layer in ([mean] if mean else []) + branches}
    if len(inputs) > 1:
        raise ConfigError(
            f"{graph.path}: its action layers take different things ({', '.join(sorted(inputs))}); those of "
            "a network here take the last hidden layer"
        )
    sizes = _branch_sizes(graph, branches)
    joint = len(sizes) > 1 and [len(layer.bias) for layer in branches] == [math.prod(sizes)]
    return Actions(mean, log_std, raw_std, init_log_std, squashed, branches, sizes, joint, inputs.pop())


def _best_output(graph: OnnxGraph, name: str) -> str:
    twin = f"deterministic_{name}"
    return twin if twin in graph.outputs else name


def _layers_behind(graph: OnnxGraph, name: str) -> list[Linear]:
    """Return the linear layers that an output comes from, in the order of its parts."""
    layers = (graph.linear(at) for at in graph.behind(name, lambda at: graph.linear(at) is not None))
    return [layer for layer in layers if layer is not None]


def _mean(graph: OnnxGraph) -> tuple[Linear, bool]:
    """Return the layer of the means, and whether they go through tanh."""
    # what noise is drawn for is the mean; without noise it is the only layer
    name = _best_output(graph, CONTINUOUS)
    stops = {layer.output for layer in _layers_behind(graph, name)}
    way = list(graph.behind(name, lambda at: at in stops))
    noise = [graph.node(at).input[0] for at in way if graph.op(at) == "RandomNormalLike"]
    layers = [graph.linear(at) for at in way if at in stops and (not noise or at in noise)]
    if len(layers) != 1 or layers[0] is None:
        raise ConfigError(
            f"{graph.path}: the means of its continuous actions come from {len(layers)} layers, not from one"
        )
    return layers[0], any(graph.op(at) == "Tanh" for at in way)


def _deviation(graph: OnnxGraph, mean: Linear) -> str | None:
    """Return the name of the deviations: what noise is multiplied by."""
    names = {mean.output}
    for at in graph.behind(CONTINUOUS, lambda at: at in names):
        if graph.op(at) != "Mul":
            continue
        first, second = graph.node(at).input
        for noise, std in ((first, second), (second, first)):
            if graph.op(noise) == "RandomNormalLike":
                return std
    return None


def _log_std(graph: OnnxGraph, std: str, size: int) -> np.ndarray | None:
    value = graph.constant(std)
    if value is not None:
        return np.log(np.broadcast_to(value.reshape(-1), size)).astype(np.float32)
    if graph.op(std) != "Exp":
        return None

    # ML-Agents: exp(mean * 0 + log_sigma)
    inner = graph.through(graph.node(std).input[0], ("Identity", "Expand"))
    value = graph.constant(inner)
    added = graph.with_constant(inner, "Add")
    if value is None and added is not None and graph.op(added[0]) == "Mul":
        zero = graph.with_constant(added[0], "Mul")
        value = added[1] if zero is not None and not np.any(zero[1]) else None
    return None if value is None else np.broadcast_to(value.reshape(-1), size).astype(np.float32)


def _softplus_layer(graph: OnnxGraph, std: str) -> tuple[Linear | None, float | None]:
    """Return the layer of ``softplus(raw + shift) + least``, and the first log deviation (`scale_shift`)."""
    added = graph.with_constant(std, "Add")
    if added is None or graph.op(added[0]) != "Softplus":
        return None, None
    shifted = graph.with_constant(graph.node(added[0]).input[0], "Add")
    if shifted is None:
        return None, None
    return graph.linear(shifted[0]), round(math.log(float(added[1]) / LEAST_SCALE), 5)


def _branch_sizes(graph: OnnxGraph, branches: list[Linear]) -> list[int]:
    told = graph.constant(SHAPE) if SHAPE in graph.outputs and branches else None
    if told is None:
        return [len(layer.bias) for layer in branches]
    return [int(size) for size in told.reshape(-1)]
