"""What an ONNX file makes of its sensors: vectors, normalised or not, and convolved images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.encoders import OBS_CLIP
from mappo_unity.policies.warm_start.graph import Linear, OnnxGraph

_COPIES = ("Identity", "Dropout", "Cast")


class Convolution(NamedTuple):
    """A convolution and the activation behind it."""

    weight: np.ndarray  # [out, in, height, width]
    bias: np.ndarray
    strides: tuple[int, ...]
    pads: tuple[int, ...]
    activation: str


class Image(NamedTuple):
    """The encoder of an image: convolutions, then a linear layer with an activation."""

    convolutions: list[Convolution]
    out: Linear
    activation: str


class Part(NamedTuple):
    """Columns of what the first hidden layer takes: some of an input's, or an image's features."""

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
        "networks here do not have: vectors, normalised or not, and convolved images can be read"
    )


def _bounds(graph: OnnxGraph, name: str, size: int) -> tuple[int, int]:
    """Return the columns that a Slice or one output of a Split takes."""
    node = graph.node(name)
    attributes = graph.attributes(node)
    more = [graph.constant(entry) for entry in node.input[1:]]
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
    return Part(found[0], 0, len(out.bias), image=Image(found[1], out, active[1]))


def read_convolutions(graph: OnnxGraph, name: str) -> tuple[str, list[Convolution]] | None:
    """Return the input and the convolutions, first to last, that a name was made by; None: by others."""
    convolutions: list[Convolution] = []
    while True:
        name = graph.through(name)
        active = graph.activation(name)
        node = graph.node(active[0]) if active is not None else None
        if active is None or node is None or node.op_type != "Conv":
            break

        weight = graph.constant(node.input[1])
        if weight is None:
            break
        bias = graph.constant(node.input[2]) if len(node.input) > 2 else None
        sizes = {"strides": [1, 1], "pads": [0, 0, 0, 0]} | graph.attributes(node)
        strides, pads = tuple(sizes["strides"]), tuple(sizes["pads"])
        bias = np.zeros(len(weight), np.float32) if bias is None else bias
        convolutions.append(Convolution(weight, bias, strides, pads, active[1]))
        name = node.input[0]

    if not convolutions or len(graph.inputs.get(name, ())) != 3:
        return None
    return name, convolutions[::-1]
