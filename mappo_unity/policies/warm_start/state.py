"""The memory in an ONNX file: an LSTM, as ML-Agents and we write it, or our GRU and traces."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.policies.onnx_memory import TRACES
from mappo_unity.policies.warm_start.graph import OnnxGraph


class State(NamedTuple):
    """A memory.

    Attributes: `options`, what makes one of its kind and size; `weights`, those of torch's layer, by their
    names there; `features`, what goes into it, or, of traces, the last hidden layer's output.
    """

    options: dict[str, Any]
    weights: dict[str, np.ndarray]
    features: str


def read_state(graph: OnnxGraph, hidden: str) -> State | None:
    """Return the memory that made what the action layers take; None where there is none.

    Raises:
        ConfigError: it has one that cannot be read.
    """
    hidden = graph.through(hidden)
    if graph.op(hidden) == "LSTM":
        return _lstm(graph, graph.node(hidden))
    if "recurrent_in" not in graph.inputs:
        return None
    if TRACES in graph.metadata:
        own = json.loads(graph.metadata[TRACES])
        options = {"memory": "traces", "memory_traces": own["decays"], "memory_traced": own["columns"]}
        return State(options, {}, hidden)

    gru = _gru(graph, hidden)
    if gru is None:
        raise ConfigError(
            f"{graph.path}: its memory comes from {graph.op(hidden) or 'nothing'}; an LSTM before the action "
            "layers can be read, and a GRU or traces as mappo-export writes them"
        )
    return gru


def _lstm(graph: OnnxGraph, node: Any) -> State:
    values = [value for name in node.input[1:4] if (value := graph.constant(name)) is not None]
    size = int(graph.attributes(node)["hidden_size"])
    if len(values) != 3 or values[0].shape[0] != 1:
        raise ConfigError(f"{graph.path}: its LSTM is of two directions, or its weights are no constants")

    given, kept, biases = (value[0] for value in values)
    names = ("weight_ih_l0", "weight_hh_l0", "bias_ih_l0", "bias_hh_l0")
    arrays = (given, kept, biases[: 4 * size], biases[4 * size :])
    weights = {name: _ifco(array, size) for name, array in zip(names, arrays)}
    return State({"memory": "lstm", "memory_size": 2 * size}, weights, node.input[0])


def _ifco(values: np.ndarray, size: int) -> np.ndarray:
    """Order gates as torch does (input, forget, cell, output); ONNX has input, output, forget, cell."""
    i, o, f, c = (values[k * size : (k + 1) * size] for k in range(4))
    return np.concatenate([i, f, c, o]).astype(np.float32)


def _gru(graph: OnnxGraph, hidden: str) -> State | None:
    """Read the operators of `onnx_memory`: h' = n + z (h - n), each gate of an input and a state layer."""
    if graph.op(hidden) != "Add":
        return None
    new, kept_part = graph.node(hidden).input
    if graph.op(new) != "Tanh" or graph.op(kept_part) != "Mul":
        return None

    update = graph.node(kept_part).input[0]
    new_sum = graph.node(new).input[0]  # of the input's part, and of reset times the state's
    if graph.op(update) != "Sigmoid" or graph.op(new_sum) != "Add":
        return None
    of_input, scaled = graph.node(new_sum).input
    if graph.op(scaled) != "Mul" or graph.op(graph.node(scaled).input[0]) != "Sigmoid":
        return None

    reset, of_state = graph.node(scaled).input
    sums = [list(graph.node(graph.node(gate).input[0]).input) for gate in (reset, update)]
    names = [*sums, [of_input, of_state]]
    pairs = [[layer for name in pair if (layer := graph.linear(name)) is not None] for pair in names]
    if any(len(pair) != 2 for pair in pairs):
        return None

    weights = {
        f"{kind}_{side}_l0": np.concatenate([getattr(pair[column], kind) for pair in pairs])
        for column, side in enumerate(("ih", "hh"))
        for kind in ("weight", "bias")
    }
    size = weights["weight_hh_l0"].shape[1]
    return State({"memory": "gru", "memory_size": size}, weights, pairs[0][0].x)
