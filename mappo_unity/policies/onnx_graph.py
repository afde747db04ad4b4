"""An actor as the ONNX graph that Unity's Agent plays: ML-Agents model format 3.

It is built node by node, not traced: it has the operators, names and shapes of the files that ML-Agents
itself writes (opset 9, which Sentis and the Inference Engine import), whatever torch's own exporter does.

    inputs   obs_0 ... obs_n  float32 [batch, size] or [batch, C, H, W], in the order of the sensors
             action_masks     float32 [batch, sum of branches], 1 = allowed; only with branches
             recurrent_in     only with a memory, see `onnx_memory`
    outputs  version_number, memory_size                   float32 [1]: 3; 0 or M
             continuous_actions, deterministic_..._actions float32 [batch, C], in [-1, 1]
             continuous_action_output_shape                float32 [1]: C
             discrete_actions, deterministic_..._actions   int64 [batch, K], branch indices
             discrete_action_output_shape                  float32 [1, K]: sizes of the branches
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor, nn

from mappo_unity import __version__
from mappo_unity.config.option_table import with_article
from mappo_unity.config.packages import PER_MEMBER, ExportError, import_package
from mappo_unity.learning.actor_critic import LOG_STD_RANGE, Actor, PerMember
from mappo_unity.learning.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.encoders import OBS_CLIP, Encoder
from mappo_unity.learning.recurrent import RecurrentActor
from mappo_unity.policies.onnx_memory import add_memory

FORMAT = 3.0  # ML-Agents' ModelApiVersion.MLAgents2_0: an input for each sensor, actions drawn in the graph
OPSET, IR_VERSION = 9, 4  # those of the files that ML-Agents writes
FORBIDDEN = 1e8  # what ML-Agents takes off the logit of a forbidden action
BATCH = "batch"


def build_model(
    actor: nn.Module, sensors: Sequence[Sequence[int]], name: str, metadata: dict[str, str] | None = None
) -> Any:
    """Build the graph of an actor.

    Args:
        actor: the network (`models.Actor`); it takes all vector sensors in one, then every image.
        sensors: shape of every sensor, without the batch.
        name: the behavior's name, which the graph bears.
        metadata: what else the file tells of itself.

    Returns:
        An onnx ModelProto.

    Raises:
        ExportError: the onnx package is missing, or the actor has a part that cannot be exported.
    """
    onnx = import_package("onnx")
    memory = actor.memory if isinstance(actor, RecurrentActor) else None
    network = _check_network(actor.actor if isinstance(actor, RecurrentActor) else actor)
    graph = _Graph(onnx)
    graph.tell("version_number", [FORMAT], [1])
    graph.tell("memory_size", [float(memory.state_size if memory is not None else 0)], [1])

    # The last layer gives all actions at once; the graph has one of its own for each kind.
    *body, head = [*network.net, actor.head] if isinstance(actor, RecurrentActor) else network.net
    if not isinstance(head, nn.Linear):
        raise ExportError(f"the policy network ends in {with_article(type(head).__name__)}, not in a Linear")
    hidden = graph.layers(body, _features(graph, network.encoder, sensors), "net")
    if memory is not None:
        hidden = add_memory(graph, memory, hidden, BATCH)
    if network.layout.continuous:
        _continuous_head(graph, hidden, head, network.log_std, network.layout.continuous)
    if network.layout.branches:
        _discrete_heads(graph, hidden, head, network.layout)

    model = onnx.helper.make_model(
        onnx.helper.make_graph(graph.nodes, name, graph.inputs, graph.outputs, graph.weights),
        producer_name="mappo-unity",
        producer_version=__version__,
        ir_version=IR_VERSION,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
    )
    onnx.helper.set_model_props(model, {"behavior_name": name, **(metadata or {})})
    onnx.checker.check_model(model, full_check=True)

    return model


class _Graph:
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
        """Add a weight; return its name."""
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

    def gemm(self, x: str, weight: Tensor, bias: Tensor, name: str) -> str:
        """Add ``x @ weight.T + bias``."""
        inputs = [x, self.constant(f"{name}.weight", weight), self.constant(f"{name}.bias", bias)]
        return self.node("Gemm", inputs, alpha=1.0, beta=1.0, transB=1)

    def layers(self, layers: Sequence[nn.Module], x: str, name: str) -> str:
        """Add layers one after the other."""
        for index, layer in enumerate(layers):
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


def _norm(graph: _Graph, layer: Any, x: str, name: str) -> str:
    centred = graph.node("Sub", [x, graph.constant(f"{name}.mean", layer.mean)])
    scaled = graph.node("Mul", [centred, graph.constant(f"{name}.inv_std", layer.inv_std)])
    return graph.node("Clip", [scaled], min=-OBS_CLIP, max=OBS_CLIP)


def _conv(graph: _Graph, layer: Any, x: str, name: str) -> str:
    if layer.groups != 1 or layer.padding_mode != "zeros" or isinstance(layer.padding, str):
        raise ExportError(f"layer {name}: only plain convolutions (one group, zero padding) can be exported")
    inputs = [x, graph.constant(f"{name}.weight", layer.weight), graph.constant(f"{name}.bias", layer.bias)]
    sizes = {"kernel_shape": layer.kernel_size, "strides": layer.stride, "dilations": layer.dilation}
    return graph.node("Conv", inputs, pads=[*layer.padding, *layer.padding], group=1, **sizes)  # begins, ends


_LAYERS: dict[str, Callable[[_Graph, Any, str, str], str]] = {
    "Identity": lambda graph, layer, x, name: x,
    "RunningNorm": _norm,
    "Sequential": lambda graph, layer, x, name: graph.layers(list(layer), x, name),
    "Linear": lambda graph, layer, x, name: graph.gemm(x, layer.weight, layer.bias, name),
    "Conv2d": _conv,
    "Flatten": lambda graph, layer, x, name: graph.node("Flatten", [x], axis=1),
    "Tanh": lambda graph, layer, x, name: graph.node("Tanh", [x]),
    "ReLU": lambda graph, layer, x, name: graph.node("Relu", [x]),
    "SiLU": lambda graph, layer, x, name: graph.node("Mul", [x, graph.node("Sigmoid", [x])]),
    "ELU": lambda graph, layer, x, name: graph.node("Elu", [x], alpha=float(layer.alpha)),
}


def _check_network(actor: nn.Module) -> Actor:
    """Return an actor all parts of which the graph can hold; anything else is refused."""
    if isinstance(actor, PerMember):
        raise ExportError(PER_MEMBER)
    parts = {name: type(part).__name__ for name, part in actor.named_children()}
    if type(actor) is not Actor or parts != {"encoder": "Encoder", "net": "Sequential"}:
        raise ExportError(
            f"a policy network {type(actor).__name__} of the parts {parts} cannot be exported yet; "
            "an encoder followed by an MLP can"
        )
    return actor


def _features(graph: _Graph, encoder: Encoder, sensors: Sequence[Sequence[int]]) -> str:
    """Add the inputs and what encodes them; return what the MLP takes."""
    vectors, features = [], []
    images = iter(encoder.images)
    for index, shape in enumerate(sensors):
        name = f"obs_{index}"
        if len(shape) == 1:
            vectors.append(graph.input(name, shape))
            continue
        image: Any = next(images)
        x = graph.input(name, channels_first(shape) if image.channels_last else shape)
        x = graph.layer(image.conv, x, f"{name}.conv")
        features.append(graph.layer(image.out, x, f"{name}.out"))

    # The MLP takes the vectors first, wherever their sensors stand.
    if vectors:
        features.insert(0, graph.layer(encoder.norm, graph.node("Concat", vectors, axis=1), "norm"))
    return graph.node("Concat", features, axis=1) if len(features) > 1 else features[0]


def channels_first(shape: Sequence[int]) -> tuple[int, ...]:
    """Turn the shape ``H, W, C`` of an image into ``C, H, W``, as Unity's models take it."""
    height, width, channels = shape
    return channels, height, width


# --- actions


def _continuous_head(graph: _Graph, hidden: str, head: nn.Linear, log_std: Tensor, size: int) -> None:
    """Add ``clip(mean + std * N(0, 1), +-3) / 3``, and the same without the noise."""
    mean = graph.gemm(hidden, head.weight[:size], head.bias[:size], "mean")
    std = log_std.detach().clamp(*LOG_STD_RANGE).exp()[None]
    noise = graph.node("RandomNormalLike", [mean], dtype=1)  # float32
    sample = graph.node("Add", [mean, graph.node("Mul", [noise, graph.constant("std", std)])])
    limit = graph.constant("limit", CONTINUOUS_LIMIT)

    def scaled(value: str, name: str) -> None:
        clipped = graph.node("Clip", [value], min=-CONTINUOUS_LIMIT, max=CONTINUOUS_LIMIT)
        graph.output(graph.node("Div", [clipped, limit], name), [BATCH, size])

    scaled(sample, "continuous_actions")
    graph.tell("continuous_action_output_shape", [float(size)], [1])
    scaled(mean, "deterministic_continuous_actions")


def _discrete_heads(graph: _Graph, hidden: str, head: nn.Linear, layout: ActionLayout) -> None:
    """Add a draw and the mode of every branch."""
    masks = graph.input("action_masks", [sum(layout.branches)])
    # `_categorical` takes these by name, for every branch.
    graph.constant("one", 1.0)
    graph.constant("forbidden", FORBIDDEN)
    weight, bias = head.weight[layout.continuous :], head.bias[layout.continuous :]
    if layout.joint:
        draw, mode = _joint_categorical(graph, graph.gemm(hidden, weight, bias, "branches"), masks, layout)
    else:
        draw, mode = _branch_categoricals(graph, hidden, weight, bias, masks, layout)
    count = len(layout.branches)
    graph.output(draw, [BATCH, count], integer=True)
    graph.tell("discrete_action_output_shape", [[float(size) for size in layout.branches]], [1, count])
    graph.output(mode, [BATCH, count], integer=True)


def _branch_categoricals(
    graph: _Graph, hidden: str, weight: Tensor, bias: Tensor, masks: str, layout: ActionLayout
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


def _joint_categorical(graph: _Graph, logits: str, masks: str, layout: ActionLayout) -> tuple[str, str]:
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


def _categorical(graph: _Graph, logits: str, mask: str) -> tuple[str, str]:
    """Add a draw and the mode, int64 ``[batch, 1]``, of ``softmax(logit * mask - 1e8 * (1 - mask))``."""
    penalty = graph.node("Mul", [graph.node("Sub", ["one", mask]), "forbidden"])
    masked = graph.node("Sub", [graph.node("Mul", [logits, mask]), penalty])
    probs = graph.node("Softmax", [masked], axis=1)
    draw = graph.node("Multinomial", [graph.node("Log", [probs])], dtype=7, sample_size=1)  # int64
    return draw, graph.node("ArgMax", [probs], axis=1, keepdims=1)
