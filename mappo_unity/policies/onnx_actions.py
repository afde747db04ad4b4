"""The actions of an actor as operators of an ONNX graph: draws, and what is played without chance.

In: a graph under construction, an actor's last layer. Out: nodes and outputs, as ML-Agents names them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor, nn

from mappo_unity.config.schema import LOG_STD_RANGE
from mappo_unity.learning.networks.actor_critic import Actor
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionLayout, scale_shift

if TYPE_CHECKING:
    from mappo_unity.policies.onnx_graph import Graph

BATCH = "batch"
FORBIDDEN = 1e8  # what ML-Agents takes off the logit of a forbidden action


def add_actions(graph: Graph, hidden: str, head: nn.Linear, network: Actor) -> None:
    """Add the outputs of an actor's actions.

    Args:
        graph: what is added to.
        hidden: name of what `head` takes.
        head: the actor's last layer, whose outputs stand in the order of an action's parameters.
        network: the actor.
    """
    layout = network.layout
    if layout.squashed:
        _squashed_head(graph, hidden, head, network.init_log_std, layout.continuous)
    elif layout.continuous:
        log_std = network.log_std.detach().clamp(*LOG_STD_RANGE)
        _continuous_head(graph, hidden, head, network.mirrored_log_std(log_std), layout.continuous)
    if layout.branches:
        _discrete_heads(graph, hidden, head, layout)


def _continuous_head(graph: Graph, hidden: str, head: nn.Linear, log_std: Tensor, size: int) -> None:
    """Add ``clip(mean + std * N(0, 1), +-3) / 3``, and the same without the noise."""
    mean = graph.gemm(hidden, head.weight[:size], head.bias[:size], "mean")
    std = graph.constant("std", log_std.exp()[None])
    limit = graph.constant("limit", CONTINUOUS_LIMIT)

    def scaled(value: str, name: str) -> None:
        clipped = graph.node("Clip", [value], min=-CONTINUOUS_LIMIT, max=CONTINUOUS_LIMIT)
        graph.node("Div", [clipped, limit], name)

    _outputs(graph, mean, std, size, scaled)


def _squashed_head(graph: Graph, hidden: str, head: nn.Linear, init_log_std: float, size: int) -> None:
    """Add ``tanh(mean + std * N(0, 1))``, the std an output of the network, and the same without noise."""
    mean = graph.gemm(hidden, head.weight[:size], head.bias[:size], "mean")
    raw = graph.gemm(hidden, head.weight[size : 2 * size], head.bias[size : 2 * size], "raw_std")

    shift, least = scale_shift(init_log_std)
    shifted = graph.node("Add", [raw, graph.constant("std_shift", shift)])
    std = graph.node("Add", [graph.node("Softplus", [shifted]), graph.constant("least_std", least)])

    _outputs(graph, mean, std, size, lambda value, name: graph.node("Tanh", [value], name))


def _outputs(graph: Graph, mean: str, std: str, size: int, limited: Callable[[str, str], object]) -> None:
    """Add a draw and the middle of a Gaussian as outputs, each brought into [-1, 1] by ``limited``."""
    noise = graph.node("RandomNormalLike", [mean], dtype=1)  # float32
    sample = graph.node("Add", [mean, graph.node("Mul", [noise, std])])

    limited(sample, "continuous_actions")
    graph.output("continuous_actions", [BATCH, size])
    graph.tell("continuous_action_output_shape", [float(size)], [1])
    limited(mean, "deterministic_continuous_actions")
    graph.output("deterministic_continuous_actions", [BATCH, size])


def _discrete_heads(graph: Graph, hidden: str, head: nn.Linear, layout: ActionLayout) -> None:
    """Add a draw and the mode of every branch."""
    masks = graph.input("action_masks", [sum(layout.branches)])
    # `_categorical` takes these by name, for every branch.
    graph.constant("one", 1.0)
    graph.constant("forbidden", FORBIDDEN)
    start = head.out_features - layout.num_logits
    weight, bias = head.weight[start:], head.bias[start:]
    if layout.joint:
        draw, mode = _joint_categorical(graph, graph.gemm(hidden, weight, bias, "branches"), masks, layout)
    else:
        draw, mode = _branch_categoricals(graph, hidden, weight, bias, masks, layout)
    count = len(layout.branches)
    graph.output(draw, [BATCH, count], integer=True)
    graph.tell("discrete_action_output_shape", [[float(size) for size in layout.branches]], [1, count])
    graph.output(mode, [BATCH, count], integer=True)


def _branch_categoricals(
    graph: Graph, hidden: str, weight: Tensor, bias: Tensor, masks: str, layout: ActionLayout
) -> tuple[str, str]:
    """Add a categorical for each branch."""
    draws, modes, start = [], [], 0
    for branch, size in enumerate(layout.branches):
        end = start + size
        logits = graph.gemm(hidden, weight[start:end], bias[start:end], f"branches.{branch}")
        mask = graph.node("Slice", [masks], axes=[1], starts=[start], ends=[end])
        draw, mode = _categorical(graph, logits, mask)
        draws.append(draw)
        modes.append(mode)
        start = end
    draw = graph.node("Concat", draws, "discrete_actions", axis=1)
    return draw, graph.node("Concat", modes, "deterministic_discrete_actions", axis=1)


def _joint_categorical(graph: Graph, logits: str, masks: str, layout: ActionLayout) -> tuple[str, str]:
    """Add one categorical over all combinations of the branches, in the order of `ActionLayout`."""
    combinations = np.stack(np.unravel_index(np.arange(layout.num_logits), layout.branches), 1)
    offsets = np.cumsum([0, *layout.branches[:-1]])
    parts = [
        graph.node("Gather", [masks, graph.constant(f"columns.{k}", column, np.int64)], axis=1)
        for k, column in enumerate((combinations + offsets).T)
    ]

    # A combination is allowed where all of its branches are: the product of their masks.
    mask = parts[0]
    for part in parts[1:]:
        mask = graph.node("Mul", [mask, part])

    table = graph.constant("combinations", combinations, np.int64)
    draw, mode = _categorical(graph, logits, mask)
    names = (draw, "discrete_actions"), (mode, "deterministic_discrete_actions")
    chosen = [
        graph.node("Squeeze", [graph.node("Gather", [table, index], axis=0)], name, axes=[1])
        for index, name in names
    ]
    return chosen[0], chosen[1]


def _categorical(graph: Graph, logits: str, mask: str) -> tuple[str, str]:
    """Add a draw and the mode, int64 ``[batch, 1]``, of ``softmax(logit * mask - 1e8 * (1 - mask))``."""
    penalty = graph.node("Mul", [graph.node("Sub", ["one", mask]), "forbidden"])
    masked = graph.node("Sub", [graph.node("Mul", [logits, mask]), penalty])
    probs = graph.node("Softmax", [masked], axis=1)
    draw = graph.node("Multinomial", [graph.node("Log", [probs])], dtype=7, sample_size=1)  # int64
    return draw, graph.node("ArgMax", [probs], axis=1, keepdims=1)
