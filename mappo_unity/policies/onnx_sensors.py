"""The inputs of a graph, one a sensor, and the nodes that encode them: vectors, images, entities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from mappo_unity.learning.networks.attention import ABSENT, HEADS, EntityEncoder, ResidualSelfAttention
from mappo_unity.learning.networks.encoders import Encoder
from mappo_unity.learning.networks.mirror import Mirror
from mappo_unity.policies.onnx_actions import BATCH
from mappo_unity.policies.onnx_memory import TRACES, add_traces, read_traces


def add_sensors(
    graph: Any, encoder: Encoder, sensors: Sequence[Sequence[int]], mirror: Mirror | None = None
) -> list[str]:
    """Add the inputs and what encodes them.

    Args:
        graph: an `onnx_graph.Graph`.
        encoder: the module.
        sensors: shape of every sensor, without the batch.
        mirror: of the observations, among which there are no entities then.

    Returns:
        The names of the features ``[batch, F]`` of what is seen and, with a mirror, of its image.
    """
    vectors, sets = [], []
    sides: list[list[str]] = [[]] if mirror is None else [[], []]
    images = iter(encoder.images)
    for index, shape in enumerate(sensors):
        name = f"obs_{index}"
        if len(shape) == 1:
            vectors.append(graph.input(name, shape))
        elif len(shape) == 2:
            sets.append((graph.input(name, shape), shape))
        else:
            image: Any = next(images)
            shape = channels_first(shape) if image.channels_last else shape
            views = [graph.input(name, shape)]
            if mirror is not None:
                reverse = graph.constant(f"mirror.{name}", np.arange(shape[2])[::-1], np.int64)
                views.append(graph.node("Gather", [views[0], reverse], axis=3))
            for features, view in zip(sides, views):
                x = graph.layer(image.conv, view, f"{name}.conv")
                features.append(graph.layer(image.out, x, f"{name}.out"))

    # The MLP takes the vectors first, wherever their sensors stand.
    if vectors:
        views = [graph.node("Concat", vectors, axis=1)]
        if mirror is not None:
            views.append(_image_of(graph, views[0], mirror.columns, mirror.signs, "mirror"))
        for features, view in zip(sides, views):
            features.insert(0, graph.layer(encoder.norm, view, "norm"))
        if encoder.traces is not None:
            views = [add_traces(graph, encoder, views[0], BATCH)]
            if mirror is not None:
                own = mirror.trace_columns, mirror.trace_signs
                views.append(_image_of(graph, views[0], *own, "mirror.traces"))
            for features, view, name in zip(sides, views, (TRACES, f"{TRACES}.image")):
                features.insert(1, read_traces(graph, encoder, view, name))

    return [_with_entities(graph, encoder, _joined(graph, features), sets) for features in sides]


def _image_of(graph: Any, x: str, columns: torch.Tensor, signs: torch.Tensor, name: str) -> str:
    """Add the mirror image of vectors or traces ``[batch, *]``."""
    places = graph.constant(f"{name}.columns", columns, np.int64)
    return graph.node(
        "Mul", [graph.node("Gather", [x, places], axis=1), graph.constant(f"{name}.signs", signs[None])]
    )


def _with_entities(
    graph: Any, encoder: Encoder, joined: str | None, sets: Sequence[tuple[str, Sequence[int]]]
) -> str:
    if encoder.sets is None:
        assert joined is not None, "a behavior has sensors"
        return joined

    code = _entities(graph, encoder.sets, joined, sets)
    return code if joined is None else graph.node("Concat", [joined, code], axis=1)


def mirrored_head(mirror: Mirror, head: nn.Linear) -> nn.Linear:
    """Return the layer over the hidden features of both, side by side, whose output is `Mirror.mean`.

    With N for the mirror image of outputs, (W h + b + N (W h' + b)) / 2 is one layer of twice the width.
    """
    with torch.no_grad():
        weight = torch.cat([head.weight, mirror.image(head.weight.T).T], 1) / 2
        bias = (head.bias + mirror.image(head.bias)) / 2
        joined = nn.Linear(weight.shape[1], weight.shape[0])
        joined.weight.copy_(weight)
        joined.bias.copy_(bias)
    return joined


def channels_first(shape: Sequence[int]) -> tuple[int, ...]:
    """Turn the shape ``H, W, C`` of an image into ``C, H, W``, as Unity's models take it."""
    height, width, channels = shape
    return channels, height, width


def _joined(graph: Any, features: list[str]) -> str | None:
    if len(features) > 1:
        return graph.node("Concat", features, axis=1)
    return features[0] if features else None


def _entities(
    graph: Any, encoder: EntityEncoder, own: str | None, sets: Sequence[tuple[str, Sequence[int]]]
) -> str:
    """Add attention over sets, given as name and shape ``[N, F]``; return their code ``[batch, 128]``."""
    around = None
    if encoder.own is not None:
        around = graph.layer(encoder.own, own, "entities.own")

    rows, seen = [], []
    for index, (x, _) in enumerate(sets):
        net: Any = encoder.entities[index]
        name = f"entities.{index}"
        weight = net.layer.weight.detach()
        out = _rows(graph, x, weight[:, net.own :], net.layer.bias, name)
        if around is not None:
            # what all entities have before them is multiplied once
            shared = graph.constant(f"{name}.own", weight[:, : net.own].T)
            shared = graph.node("MatMul", [around, shared])
            out = graph.node("Add", [out, graph.node("Unsqueeze", [shared], axes=[1])])
        rows.append(graph.node("Mul", [out, graph.node("Sigmoid", [out])]))
        seen.append(graph.node("ReduceMax", [graph.node("Abs", [x])], axes=[2], keepdims=1))

    # [batch, N, 1]: 1 for an entity that is there, 0 for a row of zeros
    largest = graph.node("Concat", seen, axis=1)
    there = graph.node("Greater", [largest, graph.constant("entities.zero", [0.0])])
    there = graph.node("Cast", [there], to=graph.onnx.TensorProto.FLOAT)
    count = sum(shape[0] for _, shape in sets)
    return _attention(graph, encoder.attention, graph.node("Concat", rows, axis=1), there, count)


def _attention(graph: Any, attention: ResidualSelfAttention, x: str, there: str, count: int) -> str:
    """Add attention of ``x`` ``[batch, N, h]``; return the mean ``[batch, h]`` over those that are there.

    The mask is ML-Agents' own: a score times the flag, minus 1e6 times what the flag lacks to 1.
    """
    width = attention.width
    x = graph.norm_rows(x, 1e-5, 2, "entities.norm")
    heads = graph.constant("entities.heads", [0, count, HEADS, width // HEADS], np.int64)

    def split(net: Any, name: str, perm: list[int]) -> str:
        out = _rows(graph, x, net.weight, net.bias, f"entities.{name}")
        return graph.node("Transpose", [graph.node("Reshape", [out, heads])], perm=perm)

    query = split(attention.query, "query", [0, 2, 1, 3])
    key = split(attention.key, "key", [0, 2, 3, 1])
    content = split(attention.content, "content", [0, 2, 1, 3])

    # [batch, heads, N, N]
    scores = graph.node("MatMul", [query, key])
    scores = graph.node("Mul", [scores, graph.constant("entities.scale", [width**-0.5])])
    flags = graph.node("Unsqueeze", [graph.node("Transpose", [there], perm=[0, 2, 1])], axes=[1])
    lacking = graph.node("Sub", [graph.constant("entities.one", [1.0]), flags])
    absent = graph.node("Mul", [lacking, graph.constant("entities.absent", [ABSENT])])
    scores = graph.node("Add", [graph.node("Mul", [scores, flags]), absent])

    attended = graph.node("MatMul", [graph.node("Softmax", [scores], axis=3), content])
    attended = graph.node("Transpose", [attended], perm=[0, 2, 1, 3])
    whole = graph.constant("entities.whole", [0, count, width], np.int64)
    attended = graph.node("Reshape", [attended, whole])

    out = _rows(graph, attended, attention.out.weight, attention.out.bias, "entities.out")
    out = graph.norm_rows(graph.node("Add", [out, x]), 1e-5, 2, "entities.residual")
    total = graph.node("ReduceSum", [graph.node("Mul", [out, there])], axes=[1], keepdims=0)
    number = graph.node("ReduceSum", [there], axes=[1], keepdims=0)
    return graph.node("Div", [total, graph.node("Clip", [number], min=1.0, max=float(count))])


def _rows(graph: Any, x: str, weight: Any, bias: Any, name: str) -> str:
    """Add a linear layer over the rows of ``[batch, N, *]``, which Gemm does not take."""
    product = graph.node("MatMul", [x, graph.constant(f"{name}.weight", weight.detach().T)])
    return graph.node("Add", [product, graph.constant(f"{name}.bias", bias)])
