"""An ONNX graph read backwards: what a name was made of, operator by operator.

Exporters write the same network with different operators (Gemm, or MatMul and Add; Clip with numbers as
attributes or as inputs); here each comes out as one thing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mappo_unity.config.packages import import_package
from mappo_unity.errors import ConfigError

SAME_NUMBERS = ("Identity", "Dropout", "Cast", "Reshape", "Flatten", "Squeeze", "Unsqueeze", "Transpose")
"""Operators that hand numbers on as they are, in another shape at most."""
_SIMPLE = {"Tanh": "tanh", "Relu": "relu", "Elu": "elu", "LeakyRelu": "leaky_relu"}


class Linear(NamedTuple):
    """``x @ weight.T + bias``."""

    x: str
    weight: np.ndarray  # [out, in]
    bias: np.ndarray  # [out]
    output: str


class OnnxGraph:
    """The nodes of a file by what they produce.

    Args:
        path: the file.

    Attributes: `model`, the ModelProto; `inputs`, shapes without the batch by name; `outputs`, names;
    `constants`, arrays by name.

    Raises:
        ConfigError: it is no ONNX model.
        ExportError: the package onnx is missing.
    """

    def __init__(self, path: Path) -> None:
        onnx = import_package("onnx")
        self.path = path
        try:
            self.model = onnx.load(str(path))
        except Exception as error:  # protobuf's error, or an OSError
            reason = str(error).strip().splitlines()[0][:200]
            raise ConfigError(f"{path} is no ONNX model that can be read: {reason}") from error
        if not self.model.graph.node:
            raise ConfigError(f"{path} is no ONNX model that can be read: it is empty")

        graph = self.model.graph
        self._attribute = onnx.helper.get_attribute_value
        self._array = onnx.numpy_helper.to_array
        self.made_by = {name: node for node in graph.node for name in node.output if name}
        self.constants = {tensor.name: self._array(tensor) for tensor in graph.initializer}
        for node in graph.node:
            if node.op_type == "Constant":
                self.constants[node.output[0]] = self._constant(self.attributes(node))
        self.inputs = {
            entry.name: [dim.dim_value for dim in entry.type.tensor_type.shape.dim[1:]]
            for entry in graph.input
            if entry.name not in self.constants
        }
        self.outputs = [entry.name for entry in graph.output]
        self.metadata = {entry.key: entry.value for entry in self.model.metadata_props}

    def _constant(self, attributes: dict[str, Any]) -> Any:
        """Return what a Constant holds: a tensor, or numbers (value_float, value_ints ...)."""
        if "value" in attributes:
            return self._array(attributes["value"])
        return np.array(next(iter(attributes.values()), []))

    def node(self, name: str) -> Any:
        """Return the node that made a name; None for an input or a constant."""
        return self.made_by.get(name)

    def op(self, name: str) -> str:
        """Return the operator that made a name; "" for an input or a constant."""
        return self.made_by[name].op_type if name in self.made_by else ""

    def attributes(self, node: Any) -> dict[str, Any]:
        """Return a node's attributes by name."""
        return {entry.name: self._attribute(entry) for entry in node.attribute}

    def constant(self, name: str) -> np.ndarray | None:
        """Return the array that a name always holds, None where it depends on the inputs."""
        while self.op(name) == "Identity":
            name = self.node(name).input[0]
        return self.constants.get(name)

    def through(self, name: str, ops: tuple[str, ...] = SAME_NUMBERS) -> str:
        """Return the name behind operators of these kinds."""
        while self.op(name) in ops:
            name = self.node(name).input[0]
        return name

    def linear(self, name: str) -> Linear | None:
        """Return the linear layer that made a name, if one did."""
        node = self.node(name)
        if node is None:
            return None
        if node.op_type == "Gemm":
            weight = self.constant(node.input[1])
            attributes = {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 0} | self.attributes(node)
            if weight is None or attributes["transA"]:
                return None
            weight = attributes["alpha"] * (weight if attributes["transB"] else weight.T)
            bias = self.constant(node.input[2]) if len(node.input) > 2 else np.zeros(len(weight))
            if bias is None:
                return None
            bias = attributes["beta"] * np.broadcast_to(bias.reshape(-1), len(weight))
            return Linear(node.input[0], _float(weight), _float(bias), name)

        if node.op_type == "MatMul":
            weight = self.constant(node.input[1])
            if weight is None or weight.ndim != 2:
                return None
            return Linear(node.input[0], _float(weight.T), _float(np.zeros(weight.shape[1])), name)

        product = self.with_constant(name, "Add")
        inner = None if product is None or self.op(product[0]) != "MatMul" else self.linear(product[0])
        if product is None or inner is None or product[1].size != len(inner.bias):
            return None
        return inner._replace(bias=_float(inner.bias + product[1].reshape(-1)), output=name)

    def with_constant(self, name: str, op: str) -> tuple[str, np.ndarray] | None:
        """Return what an operator of two inputs took beside a constant, and the constant."""
        if self.op(name) != op:
            return None
        first, second = self.node(name).input
        for other, candidate in ((first, second), (second, first)):
            value = self.constant(candidate)
            if value is not None and self.constant(other) is None:
                return other, value
        return None

    def activation(self, name: str) -> tuple[str, str] | None:
        """Return what an activation took, and its kind: tanh, relu, silu, elu or leaky_relu."""
        op = self.op(name)
        if op in _SIMPLE:
            return self.node(name).input[0], _SIMPLE[op]
        if op == "Mul":
            first, second = self.node(name).input
            for x, gate in ((first, second), (second, first)):
                if self.op(gate) == "Sigmoid" and self.node(gate).input[0] == x:
                    return x, "silu"
        return None

    def layer_norm(self, name: str) -> tuple[str, np.ndarray, np.ndarray] | None:
        """Return what a layer normalisation (ours, of single operators) took, its weight and its bias."""
        shifted = self.with_constant(name, "Add")
        scaled = self.with_constant(shifted[0], "Mul") if shifted else None
        if shifted is None or scaled is None or self.op(scaled[0]) != "Div":
            return None
        centred = self.node(scaled[0]).input[0]
        if self.op(centred) != "Sub" or self.op(self.node(centred).input[1]) != "ReduceMean":
            return None
        return self.node(centred).input[0], _float(scaled[1].reshape(-1)), _float(shifted[1].reshape(-1))

    def limits(self, name: str) -> tuple[float, float]:
        """Return the bounds of a Clip, which are attributes before opset 11, and inputs since."""
        node = self.node(name)
        attributes = self.attributes(node)
        if len(node.input) == 1:
            return attributes.get("min", -np.inf), attributes.get("max", np.inf)
        bounds = [self.constant(bound) for bound in node.input[1:]]
        low, high = (float(bound) if bound is not None else np.nan for bound in bounds)
        return low, high

    def behind(self, name: str, stops: Callable[[str], bool]) -> Iterator[str]:
        """Yield the names that one was made of, in the order of inputs, not going beyond those that stop."""
        seen: set[str] = set()
        waiting = [name]
        while waiting:
            at = waiting.pop()
            if at in seen or not at:
                continue
            seen.add(at)
            yield at
            if at in self.made_by and not stops(at):
                waiting.extend(reversed(self.made_by[at].input))


def _float(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
