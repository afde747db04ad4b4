"""An actor as the ONNX graph that Unity's Agent plays: ML-Agents model format 3.

It is built node by node, not traced: it has the operators, names and shapes of the files that ML-Agents
itself writes (opset 9, which Sentis and the Inference Engine import), whatever torch's own exporter does.

    inputs   obs_0 ... obs_n  float32 [batch, size], [batch, C, H, W] or [batch, entities, features], in
                              the order of the sensors
             action_masks     float32 [batch, sum of branches], 1 = allowed; only with branches
             recurrent_in     only with a memory, see `onnx_memory`
    outputs  version_number, memory_size                   float32 [1]: 3; 0 or M
             continuous_actions, deterministic_..._actions float32 [batch, C], in [-1, 1]
             continuous_action_output_shape                float32 [1]: C
             discrete_actions, deterministic_..._actions   int64 [batch, K], branch indices
             discrete_action_output_shape                  float32 [1, K]: sizes of the branches
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor, nn

from mappo_unity import __version__
from mappo_unity.config.option_table import with_article
from mappo_unity.config.packages import PER_MEMBER, ExportError, import_package
from mappo_unity.learning.networks.actor_critic import Actor, PerMember, RememberingActor
from mappo_unity.learning.networks.encoders import OBS_CLIP
from mappo_unity.learning.networks.handed import HandedLinear
from mappo_unity.learning.networks.recurrent import RecurrentActor
from mappo_unity.policies.onnx_actions import BATCH, add_actions
from mappo_unity.policies.onnx_memory import TRACES, add_memory
from mappo_unity.policies.onnx_sensors import add_sensors, mirrored_head

FORMAT = 3.0  # ML-Agents' ModelApiVersion.MLAgents2_0: an input for each sensor, actions drawn in the graph
MIRROR = "mirror"  # metadata: the options of a mirrored network, as JSON
OPSET, IR_VERSION = 9, 4  # those of the files that ML-Agents writes


def build_model(
    actor: nn.Module, sensors: Sequence[Sequence[int]], name: str, metadata: dict[str, str] | None = None
) -> Any:
    """Build the graph of an actor.

    Args:
        actor: the network (`actor_critic.Actor`); it takes all vector sensors in one, then images, then sets.
        sensors: shape of every sensor, without the batch.
        name: the behavior's name, which the graph bears.
        metadata: what else the file tells of itself.

    Returns:
        An onnx ModelProto.

    Raises:
        ExportError: the onnx package is missing, or the actor has a part that cannot be exported.
    """
    onnx = import_package("onnx")
    memory = actor if isinstance(actor, RememberingActor) else None
    network = _check_network(actor if memory is None else memory.actor)
    graph = Graph(onnx)
    graph.tell("version_number", [FORMAT], [1])
    graph.tell("memory_size", [float(0 if memory is None else memory.state_size)], [1])

    # The last layer gives all actions at once; the graph has one of its own for each kind.
    *body, head = [*network.net, actor.head] if isinstance(actor, RecurrentActor) else network.net
    if not isinstance(head, nn.Linear):
        raise ExportError(f"the policy network ends in {with_article(type(head).__name__)}, not in a Linear")
    hidden, head = _add_hidden(graph, network, body, head, sensors)
    if isinstance(actor, RecurrentActor):
        hidden = add_memory(graph, actor.memory, hidden, BATCH)
    add_actions(graph, hidden, head, network)

    model = onnx.helper.make_model(
        onnx.helper.make_graph(graph.nodes, name, graph.inputs, graph.outputs, graph.weights),
        producer_name="mappo-unity",
        producer_version=__version__,
        ir_version=IR_VERSION,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
    )
    onnx.helper.set_model_props(model, {"behavior_name": name, **(metadata or {}), **_own_parts(network)})
    onnx.checker.check_model(model, full_check=True)

    return model


def _own_parts(network: Actor) -> dict[str, str]:
    """Return what the metadata tells of parts that ML-Agents' networks do not have."""
    parts: dict[str, Any] = {} if network.mirror is None else {MIRROR: network.mirror.options}
    if network.encoder.traces is not None:
        parts[TRACES] = network.encoder.traces.options
    return {name: json.dumps(part) for name, part in parts.items()}


def _add_hidden(
    graph: Graph, network: Actor, body: Sequence[nn.Module], head: nn.Linear, sensors: Sequence[Sequence[int]]
) -> tuple[str, nn.Linear]:
    """Add the sensors and the hidden layers; return the name of their features, and the layer behind them.

    With a mirror these are the features of what is seen, and behind them those of its mirror image.
    """
    features = add_sensors(graph, network.encoder, sensors, network.mirror)
    if network.mirror is None:
        return graph.layers(body, features[0], "net"), head

    first, *rest = body
    hidden = []
    for x, image in zip(features, (False, True)):
        if isinstance(first, HandedLinear):
            bias_name = "net.0.image.bias" if image else None
            x = graph.gemm(x, first.weight, first.bias_of(image), "net.0", bias_name)
        else:
            x = graph.layer(first, x, "net.0")
        hidden.append(graph.layers(rest, x, "net", start=1))
    return graph.node("Concat", hidden, axis=1), mirrored_head(network.mirror, head)


class Graph:
    """Nodes, weights, inputs and outputs as they are added; names what nobody named."""

    def __init__(self, onnx: Any) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.weights: list[Any] = []
        self.inputs: list[Any] = []
        self.outputs: list[Any] = []

    def node(self, op: str, inputs: list[str], output: str | None = None, **attributes: Any) -> str:
        """Add an operator; return the name of its output."""
        output = output or f"{op.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(op, inputs, [output], name=f"/{output}", **attributes))
        return output

    def node_of_several(self, op: str, inputs: list[str], outputs: list[str], **attributes: Any) -> None:
        """Add an operator with several outputs."""
        node = self.onnx.helper.make_node(op, inputs, outputs, name=f"/{outputs[0]}", **attributes)
        self.nodes.append(node)

    def constant(self, name: str, values: Any, dtype: type = np.float32) -> str:
        """Add a weight; return its name. A layer that is used twice has its weights once."""
        if any(weight.name == name for weight in self.weights):
            return name
        array: np.ndarray = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype)
        self.weights.append(self.onnx.numpy_helper.from_array(array, name))
        return name

    def input(self, name: str, shape: Sequence[int]) -> str:
        """Add an input ``[batch, *shape]``; return its name."""
        kind = self.onnx.TensorProto.FLOAT
        self.inputs.append(self.onnx.helper.make_tensor_value_info(name, kind, [BATCH, *shape]))
        return name

    def output(self, name: str, shape: Sequence[int | str], integer: bool = False) -> None:
        """Make a node's output one of the graph."""
        kind = self.onnx.TensorProto.INT64 if integer else self.onnx.TensorProto.FLOAT
        self.outputs.append(self.onnx.helper.make_tensor_value_info(name, kind, list(shape)))

    def tell(self, name: str, values: Any, shape: Sequence[int]) -> None:
        """Add an output that always holds the same numbers."""
        self.node("Identity", [self.constant(f"{name}_vector", values)], name)
        self.output(name, shape)

    def gemm(self, x: str, weight: Tensor, bias: Tensor, name: str, bias_name: str | None = None) -> str:
        """Add ``x @ weight.T + bias``; layers that share weights alone have names for their biases."""
        offset = self.constant(bias_name or f"{name}.bias", bias)
        inputs = [x, self.constant(f"{name}.weight", weight), offset]
        return self.node("Gemm", inputs, alpha=1.0, beta=1.0, transB=1)

    def norm_rows(self, x: str, eps: float, axis: int, name: str) -> str:
        """Add a layer norm without weights over an axis, of operators that opset 9 has."""
        centred = self.node("Sub", [x, self.node("ReduceMean", [x], axes=[axis], keepdims=1)])
        square = self.node("Mul", [centred, centred])
        var = self.node("ReduceMean", [square], axes=[axis], keepdims=1)
        std = self.node("Sqrt", [self.node("Add", [var, self.constant(f"{name}.eps", eps)])])
        return self.node("Div", [centred, std])

    def layers(self, layers: Sequence[nn.Module], x: str, name: str, start: int = 0) -> str:
        """Add layers one after the other; their names count from `start`."""
        for index, layer in enumerate(layers, start):
            x = self.layer(layer, x, f"{name}.{index}")
        return x

    def layer(self, layer: nn.Module, x: str, name: str) -> str:
        """Add a layer.

        Raises:
            ExportError: nobody knows how.
        """
        kind = type(layer).__name__
        if kind not in _LAYERS:
            raise ExportError(
                f"layer {name} of the policy network is {with_article(kind)}, which cannot be exported yet; "
                f"these can: {', '.join(sorted(_LAYERS))}"
            )
        return _LAYERS[kind](self, layer, x, name)


# --- layers


def _norm(graph: Graph, layer: Any, x: str, name: str) -> str:
    centred = graph.node("Sub", [x, graph.constant(f"{name}.mean", layer.mean)])
    scaled = graph.node("Mul", [centred, graph.constant(f"{name}.inv_std", layer.inv_std)])
    return graph.node("Clip", [scaled], min=-OBS_CLIP, max=OBS_CLIP)


def _conv(graph: Graph, layer: Any, x: str, name: str) -> str:
    if layer.groups != 1 or layer.padding_mode != "zeros" or isinstance(layer.padding, str):
        raise ExportError(f"layer {name}: only plain convolutions (one group, zero padding) can be exported")
    inputs = [x, graph.constant(f"{name}.weight", layer.weight), graph.constant(f"{name}.bias", layer.bias)]
    sizes = {"kernel_shape": layer.kernel_size, "strides": layer.stride, "dilations": layer.dilation}
    return graph.node("Conv", inputs, pads=[*layer.padding, *layer.padding], group=1, **sizes)  # begins, ends


def _max_pool(graph: Graph, layer: Any, x: str, name: str) -> str:
    size, stride = layer.kernel_size, layer.stride
    return graph.node("MaxPool", [x], kernel_shape=[size, size], strides=[stride, stride])


def _layer_norm(graph: Graph, layer: Any, x: str, name: str) -> str:
    normed = graph.norm_rows(x, layer.eps, 1, name)
    if layer.weight is None:
        return normed
    scaled = graph.node("Mul", [normed, graph.constant(f"{name}.weight", layer.weight)])
    return graph.node("Add", [scaled, graph.constant(f"{name}.bias", layer.bias)])


def _residual(graph: Graph, layer: Any, x: str, name: str) -> str:
    return graph.node("Add", [x, graph.layer(layer.layers, x, name)])


def _conditioned(graph: Graph, layer: Any, x: str, name: str) -> str:
    columns = graph.constant(f"{name}.columns", layer.columns, np.int64)
    goal = graph.node("Gather", [x, columns], axis=1)
    hyper = layer.hyper
    flat = graph.layer(hyper.weights, goal, f"{name}.weights")
    shape = graph.constant(f"{name}.shape", [0, hyper.size, hyper.out_features], np.int64)
    weights = graph.node("Reshape", [flat, shape])

    before = graph.layer(layer.before, x, f"{name}.before")
    row = graph.node("Unsqueeze", [before], axes=[1])
    product = graph.node("Squeeze", [graph.node("MatMul", [row, weights])], axes=[1])
    out = graph.node("Add", [product, graph.constant(f"{name}.bias", hyper.bias)])
    return graph.layer(layer.activation, out, f"{name}.activation")


_LAYERS: dict[str, Callable[[Graph, Any, str, str], str]] = {
    "Identity": lambda graph, layer, x, name: x,
    "RunningNorm": _norm,
    "LayerNorm": _layer_norm,
    "Sequential": lambda graph, layer, x, name: graph.layers(list(layer), x, name),
    "Linear": lambda graph, layer, x, name: graph.gemm(x, layer.weight, layer.bias, name),
    "Conv2d": _conv,
    "MaxPool2d": _max_pool,
    "ResidualBlock": _residual,
    "GoalConditioned": _conditioned,
    "Flatten": lambda graph, layer, x, name: graph.node("Flatten", [x], axis=1),
    "Tanh": lambda graph, layer, x, name: graph.node("Tanh", [x]),
    "ReLU": lambda graph, layer, x, name: graph.node("Relu", [x]),
    "LeakyReLU": lambda graph, layer, x, name: graph.node("LeakyRelu", [x], alpha=layer.negative_slope),
    "SiLU": lambda graph, layer, x, name: graph.node("Mul", [x, graph.node("Sigmoid", [x])]),
    "ELU": lambda graph, layer, x, name: graph.node("Elu", [x], alpha=float(layer.alpha)),
}


def _check_network(actor: nn.Module) -> Actor:
    """Return an actor all parts of which the graph can hold; anything else is refused."""
    if isinstance(actor, PerMember):
        raise ExportError(PER_MEMBER)
    parts = {name: type(part).__name__ for name, part in actor.named_children()}
    parts.pop("mirror", None)
    if type(actor) is not Actor or parts != {"encoder": "Encoder", "net": "Sequential"}:
        raise ExportError(
            f"a policy network {type(actor).__name__} of the parts {parts} cannot be exported yet; "
            "an encoder followed by an MLP can"
        )
    return actor
