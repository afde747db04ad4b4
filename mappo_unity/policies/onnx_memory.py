"""A memory as ONNX nodes, with the inputs and outputs by which Unity hands it on from decision to decision.

    inputs   recurrent_in   float32 [batch, 1, M]
    outputs  recurrent_out  float32 [batch, 1, M]

An LSTM is one operator, and its state lies as in ML-Agents' files: the hidden state, then the cell state.
A GRU, which Unity's inference does not import, is made of operators that it does; so are traces.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mappo_unity.learning.networks.encoders import OBS_CLIP, Encoder, RunningNorm, running_norms
from mappo_unity.learning.networks.recurrent import Memory
from mappo_unity.learning.networks.traces import ObservationTraces

TRACES = "traces"
"""The name of what a network takes of its traces; in the metadata: their decays and columns, as JSON."""
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


def add_traces(graph: Any, encoder: Encoder, vectors: str, batch: str) -> str:
    """Add an encoder's traces to a graph; return the name of those after this decision ``[batch, M]``.

    Args:
        graph: an `onnx_graph.Graph`.
        encoder: the module, which has traces.
        vectors: the name of all vector observations ``[batch, O]``, as they are seen.
        batch: the name of the batch dimension.
    """
    net = encoder.traces
    assert net is not None
    state = graph.node("Squeeze", [graph.input("recurrent_in", [1, net.size])], axes=[1])
    width = len(net.columns)

    # (1 - decay) * [x, 1], of each decay: the column that stands for the 1 is taken times 0
    given = net.decays.new_ones(len(net.decays), width + 1) - net.decays
    scale, shift = given.clone(), torch.zeros_like(given)
    scale[:, -1], shift[:, -1] = 0.0, given[:, -1]
    columns = torch.cat([net.columns, net.columns[:1]]).repeat(len(net.decays))

    def row(name: str, values: Tensor) -> str:
        return graph.constant(f"traces.{name}", values.reshape(1, -1))

    seen = graph.node("Gather", [vectors, graph.constant("traces.columns", columns, np.int64)], axis=1)
    seen = graph.node("Add", [graph.node("Mul", [seen, row("scale", scale)]), row("shift", shift)])
    kept = graph.node("Mul", [state, row("decay", net.decays.expand_as(given))])
    after = graph.node("Add", [kept, seen], f"{TRACES}.after" if running_norms(encoder.norm) else TRACES)
    graph.node("Unsqueeze", [after], "recurrent_out", axes=[1])
    graph.output("recurrent_out", [batch, 1, net.size])
    return after


def read_traces(graph: Any, encoder: Encoder, traces: str, name: str) -> str:
    """Add what the network takes of traces, under a name; return the name of it, ``[batch, M]``."""
    assert encoder.traces is not None
    for norm in running_norms(encoder.norm):
        return _normalised_traces(graph, norm, encoder.traces, traces, name)
    return traces


def _normalised_traces(graph: Any, norm: RunningNorm, net: ObservationTraces, after: str, name: str) -> str:
    """Add `ObservationTraces.forward`, clipped, decay by decay."""
    width, parts = len(net.columns), []
    mean = graph.constant(f"{name}.mean", norm.mean[net.columns].unsqueeze(0))
    inv_std = graph.constant(f"{name}.inv_std", norm.inv_std[net.columns].unsqueeze(0))

    def cut(first: int, end: int) -> str:
        return graph.node("Slice", [after], axes=[1], starts=[first], ends=[end])

    for first in range(0, net.size, width + 1):
        share = cut(first + width, first + width + 1)
        shifted = graph.node("Sub", [cut(first, first + width), graph.node("Mul", [share, mean])])
        parts += [graph.node("Mul", [shifted, inv_std]), share]
    return graph.node("Clip", [graph.node("Concat", parts, axis=1)], name, min=-OBS_CLIP, max=OBS_CLIP)
