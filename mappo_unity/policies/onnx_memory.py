"""A memory as ONNX nodes, with the inputs and outputs by which Unity hands it on from decision to decision.

    inputs   recurrent_in   float32 [batch, 1, M]
    outputs  recurrent_out  float32 [batch, 1, M]

An LSTM is one operator, and its state lies as in ML-Agents' files: the hidden state, then the cell state.
A GRU, which Unity's inference does not import, is made of operators that it does.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mappo_unity.learning.recurrent import Memory

TO_END = 2**63 - 1  # the end of a slice that goes as far as there is anything


def add_memory(graph: Any, memory: Memory, features: str, batch: str) -> str:
    """Add a memory to a graph; return the name of its output ``[batch, H]``.

    Args:
        graph: an `onnx_graph.Graph`.
        memory: the module.
        features: the name of its input ``[batch, F]``.
        batch: the name of the batch dimension.
    """
    state = graph.input("recurrent_in", [1, memory.state_size])
    out = _lstm(graph, memory, features, state) if memory.is_lstm else _gru(graph, memory, features, state)
    graph.output("recurrent_out", [batch, 1, memory.state_size])
    return out


def _lstm(graph: Any, memory: Memory, features: str, state: str) -> str:
    layer: Any = memory.layer
    size = memory.size
    # [batch, 1, 2 H] -> [1, batch, 2 H], as the operator wants states
    state = graph.node("Transpose", [state], perm=[1, 0, 2])
    hidden = graph.node("Slice", [state], axes=[2], starts=[0], ends=[size])
    cell = graph.node("Slice", [state], axes=[2], starts=[size], ends=[TO_END])

    weights = [
        graph.constant(f"memory.{name}", _iofc(values, size).unsqueeze(0))
        for name, values in (("W", layer.weight_ih_l0), ("R", layer.weight_hh_l0))
    ]
    bias = torch.cat([_iofc(layer.bias_ih_l0, size), _iofc(layer.bias_hh_l0, size)])
    bias_name = graph.constant("memory.B", bias.unsqueeze(0))

    inputs = [graph.node("Unsqueeze", [features], axes=[0]), *weights, bias_name, "", hidden, cell]
    names = ["memory.Y", "memory.Y_h", "memory.Y_c"]
    graph.node_of_several("LSTM", inputs, names, hidden_size=size)

    after = graph.node("Concat", names[1:], axis=2)
    graph.node("Transpose", [after], "recurrent_out", perm=[1, 0, 2])
    return graph.node("Squeeze", [names[1]], axes=[0])


def _iofc(values: Tensor, size: int) -> Tensor:
    """Order gates as ONNX does (input, output, forget, cell); torch has input, forget, cell, output."""
    i, f, c, o = values.detach().split(size)
    return torch.cat([i, o, f, c])


def _gru(graph: Any, memory: Memory, features: str, state: str) -> str:
    """Add r = s(Wr x + Rr h), z = s(Wz x + Rz h), n = tanh(Wn x + r (Rn h)), h' = n + z (h - n)."""
    layer: Any = memory.layer
    size = memory.size
    hidden = graph.node("Squeeze", [state], axes=[1])

    given = [weight.detach().split(size) for weight in (layer.weight_ih_l0, layer.bias_ih_l0)]
    kept = [weight.detach().split(size) for weight in (layer.weight_hh_l0, layer.bias_hh_l0)]
    gates = []
    for index, name in enumerate(("reset", "update", "new")):
        of_input = graph.gemm(features, given[0][index], given[1][index], f"memory.{name}.input")
        of_state = graph.gemm(hidden, kept[0][index], kept[1][index], f"memory.{name}.state")
        gates.append((of_input, of_state))

    reset, update = (graph.node("Sigmoid", [graph.node("Add", list(gate))]) for gate in gates[:2])
    new = graph.node("Tanh", [graph.node("Add", [gates[2][0], graph.node("Mul", [reset, gates[2][1]])])])
    kept_part = graph.node("Mul", [update, graph.node("Sub", [hidden, new])])
    after = graph.node("Add", [new, kept_part])
    graph.node("Unsqueeze", [after], "recurrent_out", axes=[1])
    return after
