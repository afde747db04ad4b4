"""What an ONNX file makes of its sensors: vectors, normalised or not, and convolved images."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.encoders import OBS_CLIP
from mappo_unity.policies.onnx_memory import TRACES
from mappo_unity.policies.warm_start.graph import SAME_NUMBERS, Linear, OnnxGraph

STATE = "recurrent_in"
_COPIES = ("Identity", "Dropout", "Cast")
_OF_IMAGES = (*SAME_NUMBERS, "Conv", "MaxPool", "Add", "Mul", "Sigmoid", "Relu", "LeakyRelu")
"""Operators between an image and its linear layer."""
_KINDS = {
    (): "dense",
    ((16, 8, 4, 0), (32, 4, 2, 0)): "simple",
    ((32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)): "nature",
    ((35, 3, 1, 0), (144, 3, 1, 0)): "match3",
}
"""Encoders of ML-Agents (trainers/torch_entities/encoders.py) by their convolutions."""
_GRID = ((16, 5, 3, 0), (32, 3, 1, 0))
"""The one of ours that has a name; all others with Swish are `auto`."""
RESNET_CONVOLUTIONS = 3 * (1 + 2 * 2)  # of each stack one, and two blocks of two


class Convolution(NamedTuple):
    """A convolution."""

    weight: np.ndarray  # [out, in, height, width]
    bias: np.ndarray
    stride: int
    padding: int

    @property
    def size(self) -> tuple[int, int, int, int]:
        """Channels out, side of the kernel, stride and padding."""
        return (len(self.weight), self.weight.shape[-1], self.stride, self.padding)


class Image(NamedTuple):
    """The encoder of an image: convolutions, first to last, then a linear layer with an activation."""

    convolutions: list[Convolution]
    out: Linear
    activations: frozenset[str]

    @property
    def kind(self) -> str:
        """What `model.image_encoder` calls it; "" for one that it does not know."""
        sizes = tuple(convolution.size for convolution in self.convolutions)
        if self.activations == {"silu"}:
            return "grid" if sizes == _GRID else "auto"
        if len(self.convolutions) == RESNET_CONVOLUTIONS and "silu" in self.activations:
            return "resnet"
        return _KINDS.get(sizes, "") if self.activations == {"leaky_relu"} else ""


class Part(NamedTuple):
    """Columns of what the first hidden layer takes: some of an input's, an image's features, or traces."""

    input: str
    start: int
    stop: int
    mean: np.ndarray | None = None
    inv_std: np.ndarray | None = None
    image: Image | None = None


def read_parts(graph: OnnxGraph, name: str) -> tuple[list[Part], tuple[np.ndarray, np.ndarray] | None]:
    """Return the parts of features, in their order, and the layer normalisation of the vectors.

    Raises:
        ConfigError: sensors go through something that networks here do not have.
    """
    name = graph.through(name, _COPIES)
    if name == TRACES and TRACES in graph.metadata:
        return [Part(STATE, 0, graph.inputs[STATE][-1])], None

    normed = graph.layer_norm(name)
    if normed is not None:
        return read_parts(graph, normed[0])[0], normed[1:]

    if graph.op(name) == "Concat":
        parts, norm = [], None
        for entry in graph.node(name).input:
            some, own = read_parts(graph, entry)
            parts += some
            norm = own or norm
        return parts, norm

    if graph.op(name) == "Clip":
        return _normalised(graph, name), None

    image = _image(graph, name)
    return [image if image is not None else _columns(graph, name)], None


def _columns(graph: OnnxGraph, name: str) -> Part:
    if len(graph.inputs.get(name, ())) == 1:
        return Part(name, 0, graph.inputs[name][0])

    node, op = graph.node(name), graph.op(name)
    source = graph.through(node.input[0], _COPIES) if node is not None else ""
    if op in ("Slice", "Split") and len(graph.inputs.get(source, ())) == 1:
        size = graph.inputs[source][0]
        start, stop = _bounds(graph, name, size)
        return Part(source, start, min(stop, size))

    raise ConfigError(
        f"{graph.path}: what it sees goes through {op or 'an input of another shape'} ({name}), which "
        "is not understood: vectors, normalised or not, and convolved images can be read, attention over "
        "entities cannot"
    )


def _bounds(graph: OnnxGraph, name: str, size: int) -> tuple[int, int]:
    """Return the columns that a Slice or one output of a Split takes."""
    node = graph.node(name)
    attributes = graph.attributes(node)
    more: list[Any] = [graph.constant(entry) for entry in node.input[1:]]
    if node.op_type == "Split":
        given = attributes.get("split", more[0] if more else None)
        count = len(node.output)
        sizes = [size // count] * count if given is None else [int(width) for width in given]
        start = sum(sizes[: list(node.output).index(name)])
        return start, start + sizes[list(node.output).index(name)]

    # before opset 10 the bounds are attributes
    starts, ends = (attributes["starts"], attributes["ends"]) if "starts" in attributes else more[:2]
    return int(starts[0]), int(ends[0])


def _normalised(graph: OnnxGraph, name: str) -> list[Part]:
    """Return the parts behind ``clip((x - mean) / std, +-5)``."""
    scaled = graph.node(name).input[0]
    if graph.op(scaled) == "Div":
        centred, std = graph.node(scaled).input[0], graph.constant(graph.node(scaled).input[1])
        inv_std = None if std is None else 1.0 / std
    else:
        product = graph.with_constant(scaled, "Mul")
        centred, inv_std = product if product is not None else ("", None)

    shift = graph.with_constant(centred, "Sub")
    if inv_std is None or shift is None or graph.limits(name) != (-OBS_CLIP, OBS_CLIP):
        raise ConfigError(
            f"{graph.path}: what it sees is clipped otherwise than by a normaliser, "
            f"clip((x - mean) / std, +-{OBS_CLIP:g}), which is what can be read"
        )

    parts, at = [], 0
    for part in read_parts(graph, shift[0])[0]:
        end = at + part.stop - part.start
        mean, scale = (values.reshape(-1)[at:end].astype(np.float32) for values in (shift[1], inv_std))
        parts.append(part._replace(mean=mean, inv_std=scale))
        at = end
    return parts


def _image(graph: OnnxGraph, name: str) -> Part | None:
    active = graph.activation(name)
    out = graph.linear(active[0]) if active is not None else None
    found = read_convolutions(graph, out.x) if out is not None else None
    if active is None or out is None or found is None:
        return None
    source, convolutions, activations = found
    return Part(source, 0, len(out.bias), image=Image(convolutions, out, activations | {active[1]}))


def read_convolutions(graph: OnnxGraph, name: str) -> tuple[str, list[Convolution], frozenset[str]] | None:
    """Return the image, the convolutions (first to last) and the activations that made a name; None: others.

    Where convolutions are added to what they were given (ResNet) they stand in the order of the file.
    """
    way = set(graph.behind(name, lambda at: False))
    images = [at for at in way if len(graph.inputs.get(at, ())) == 3]
    nodes = [node for node in graph.model.graph.node if way & set(node.output) and node.op_type != "Constant"]
    if len(images) != 1 or way & set(graph.inputs) != set(images):
        return None
    if any(node.op_type not in _OF_IMAGES for node in nodes):
        return None

    convolutions = []
    for node in nodes:
        weight = graph.constant(node.input[1]) if node.op_type == "Conv" else None
        if weight is None:
            continue
        bias = graph.constant(node.input[2]) if len(node.input) > 2 else None
        sizes = {"strides": [1], "pads": [0]} | graph.attributes(node)
        bias = np.zeros(len(weight), np.float32) if bias is None else bias
        convolutions.append(Convolution(weight, bias, int(sizes["strides"][0]), int(sizes["pads"][0])))

    active = [graph.activation(output) for node in nodes for output in node.output]
    return images[0], convolutions, frozenset(kind for _, kind in filter(None, active))
