"""An ONNX file's network as tensors of an actor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mappo_unity.config.schema import LOG_STD_RANGE
from mappo_unity.learning.networks.actor_critic import RememberingActor
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import Encoder
from mappo_unity.learning.networks.recurrent import RecurrentActor
from mappo_unity.policies.warm_start.onnx_network import OnnxNetwork
from mappo_unity.policies.warm_start.sensors import STATE, Part

ASSUMED_COUNT = 1e6
"""Observations that a file's normaliser counts as having seen: the file does not tell. So many are moved
slowly by those of the game, and not at once, as by a normaliser that has seen none."""


_ACTIVATIONS = {"SiLU": "silu", "LeakyReLU": "leaky_relu", "ReLU": "relu"}


class Misfit(Exception):
    """Why a part of a file does not fit a network."""


def actor_tensors(
    network: OnnxNetwork, net: torch.nn.Module, sensors: Sequence[Sequence[int]]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return a file's tensors by their names in an actor's network, and why others are not among them.

    Args:
        network: of the file.
        net: `Actor`, `RecurrentActor` or `TracingActor`, of the same shape where everything is to fit.
        sensors: shapes of the behavior's sensors.
    """
    recurrent = isinstance(net, RecurrentActor)
    actor: Any = net.actor if isinstance(net, RememberingActor) else net
    prefix = "" if actor is net else "actor."
    out: dict[str, np.ndarray] = {}
    misfits: dict[str, str] = {}

    # index of a hidden layer in the network, whose activation stands behind it
    for index, layer in enumerate(network.layers):
        out[f"{prefix}net.{2 * index}.weight"] = layer.linear.weight
        out[f"{prefix}net.{2 * index}.bias"] = layer.linear.bias
        if layer.norm is not None:
            out[f"{prefix}net.{2 * index + 1}.1.weight"], out[f"{prefix}net.{2 * index + 1}.1.bias"] = (
                layer.norm
            )
    if network.side is not None:
        out[f"{prefix}net.0.side"] = network.side
    try:
        columns = _columns(network, actor.encoder, sensors)
        weight = network.layers[0].linear.weight
        placed = np.zeros((len(weight), actor.encoder.size), np.float32)
        placed[:, columns] = weight
        out[f"{prefix}net.0.weight"] = placed
        out |= {f"{prefix}encoder.{n}": v for n, v in _encoder(network, actor.encoder, columns).items()}
    except Misfit as why:
        del out[f"{prefix}net.0.weight"]
        misfits |= {f"{prefix}net.0.weight": str(why), f"{prefix}encoder.": str(why)}

    if recurrent and network.state is not None:
        out |= {f"memory.layer.{name}": values for name, values in network.state.weights.items()}
    head = "head" if recurrent else f"{prefix}net.{2 * len(network.layers)}"
    try:
        out |= {
            n.format(head=head, prefix=prefix): v for n, v in _action_tensors(network, actor.layout).items()
        }
    except Misfit as why:
        misfits |= {f"{head}.": str(why), f"{prefix}log_std": str(why)}
    return out, misfits


def _action_tensors(network: OnnxNetwork, layout: ActionLayout) -> dict[str, np.ndarray]:
    actions = network.actions
    continuous = 0 if actions.mean is None else len(actions.mean.bias)
    if continuous != layout.continuous or tuple(actions.branch_sizes) != layout.branches:
        raise Misfit(
            f"the file's actions are {continuous} continuous and branches {actions.branch_sizes}, the "
            f"behavior's {layout.continuous} and {list(layout.branches)}"
        )
    if continuous and actions.squashed != layout.squashed:
        raise Misfit("of the two only one squashes its continuous actions by tanh")
    if actions.joint != layout.joint:
        raise Misfit("of the two only one has a categorical over all combinations of the branches")

    layers = [actions.mean] if actions.mean is not None else []
    if layout.squashed and continuous:
        if actions.raw_std is None:
            raise Misfit("the file's deviations are no softplus of a layer, as those of networks here")
        layers.append(actions.raw_std)
    layers += actions.branches

    out = {
        "{head}.weight": np.concatenate([layer.weight for layer in layers]),
        "{head}.bias": np.concatenate([layer.bias for layer in layers]),
    }
    if actions.log_std is not None:
        out["{prefix}log_std"] = np.clip(actions.log_std, *LOG_STD_RANGE)
    return out


def _columns(network: OnnxNetwork, encoder: Encoder, sensors: Sequence[Sequence[int]]) -> np.ndarray:
    """Return for each feature of the file where it stands among the encoder's; raises Misfit."""
    vectors = [index for index, shape in enumerate(sensors) if len(shape) == 1]
    images = [index for index, shape in enumerate(sensors) if len(shape) == 3]
    starts = dict(zip(vectors, np.cumsum([0] + [sensors[index][0] for index in vectors]).tolist()))

    out: list[np.ndarray] = []
    for part in network.parts:
        width = part.stop - part.start
        if part.image is not None:
            place = _image_place(part, images)
            net: Any = encoder.images[place]
            if width != net.out[0].out_features:
                raise Misfit(f"{part.input} has {width} features, here {net.out[0].out_features}")
            start = _image_starts(encoder)[place]
        elif part.input == STATE:
            start = encoder.vector
            if encoder.traces is None or encoder.traces.size != width:
                raise Misfit(f"its traces are {width} numbers, here {getattr(encoder.traces, 'size', 0)}")
        else:
            start = part.start + _vector_start(network, part, sensors, starts)
        out.append(np.arange(start, start + width))
    return np.concatenate(out)


def _vector_start(
    network: OnnxNetwork, part: Part, sensors: Sequence[Sequence[int]], starts: Mapping[int, int]
) -> int:
    size = network.graph.inputs[part.input][0]
    if part.input == "vector_observation":
        total = sum(sensors[index][0] for index in starts)
        if size != total:
            raise Misfit(f"{part.input} has {size} numbers, the behavior's vector sensors {total}")
        return 0

    index = int(part.input.rpartition("_")[2])
    shape = list(sensors[index]) if index < len(sensors) else None
    if shape != [size]:
        raise Misfit(
            f"{part.input} has shape {[size]}, the behavior's sensor {index} {shape or 'is not there'}"
        )
    return starts[index]


def _image_starts(encoder: Encoder) -> list[int]:
    """Return where the features of each image begin, behind the vectors and their traces."""
    sizes = [net.out[0].out_features for net in encoder.images]  # type: ignore[union-attr, index]
    first = encoder.vector + (0 if encoder.traces is None else encoder.traces.size)
    return [first + sum(sizes[:place]) for place in range(len(sizes))]


def _image_place(part: Part, images: Sequence[int]) -> int:
    """Return which of the encoder's images a part is: obs_N counts all sensors, visual_..._N the images."""
    number = int(part.input.rpartition("_")[2])
    place = images.index(number) if part.input.startswith("obs_") and number in images else number
    if part.input.startswith("obs_") and number not in images or place >= len(images):
        raise Misfit(f"{part.input} is an image, the behavior's sensor is none")
    return place


def _encoder(network: OnnxNetwork, encoder: Encoder, columns: np.ndarray) -> dict[str, np.ndarray]:
    """Return the tensors of the normaliser and of the images' encoders; raises Misfit."""
    out: dict[str, np.ndarray] = {}
    mean, inv_std = np.zeros(encoder.vector, np.float32), np.ones(encoder.vector, np.float32)
    images = _image_starts(encoder)
    at = 0
    for part in network.parts:
        width = part.stop - part.start
        if part.mean is not None and part.inv_std is not None:
            mean[columns[at : at + width]], inv_std[columns[at : at + width]] = part.mean, part.inv_std
        at += width
        if part.image is not None:
            out |= _image_tensors(part, encoder, images.index(int(columns[at - width])))

    norm = encoder.norm[0] if isinstance(encoder.norm, torch.nn.Sequential) else encoder.norm
    name = "norm.0" if isinstance(encoder.norm, torch.nn.Sequential) else "norm"
    if network.options.get("normalize_obs"):
        steps = network.graph.metadata.get("agent_steps", "")
        var = np.maximum(inv_std.astype(float) ** -2 - getattr(norm, "epsilon", 0.0), 0)
        count = float(steps) if steps.isdigit() and int(steps) else ASSUMED_COUNT
        values = {"mean": mean, "var": var, "count": np.array(count), "inv_std": inv_std}
        out |= {f"{name}.{key}": value for key, value in values.items()}
    if network.vector_norm is not None:
        out["norm.1.weight"], out["norm.1.bias"] = network.vector_norm
    return out


def _image_tensors(part: Part, encoder: Encoder, place: int) -> dict[str, np.ndarray]:
    """Return the tensors of an image's encoder by their names in the network's; raises Misfit."""
    assert part.image is not None
    layers = {name: layer for name, layer in encoder.images[place].named_modules() if name}
    convolutions = {name: layer for name, layer in layers.items() if isinstance(layer, torch.nn.Conv2d)}
    here = {_ACTIVATIONS[kind] for layer in layers.values() if (kind := type(layer).__name__) in _ACTIVATIONS}
    sizes = [(c.out_channels, c.kernel_size[0], c.stride[0], c.padding[0]) for c in convolutions.values()]
    theirs = [layer.size for layer in part.image.convolutions]
    if sizes != theirs or here != part.image.activations:
        raise Misfit(
            f"{part.input} goes through convolutions {_show(theirs)} "
            f"({', '.join(sorted(part.image.activations))}), here through {_show(sizes)} "
            f"({', '.join(sorted(here))})"
        )

    found = zip(convolutions, [(layer.weight, layer.bias) for layer in part.image.convolutions])
    pairs = {**dict(found), "out.0": (part.image.out.weight, part.image.out.bias)}
    out: dict[str, np.ndarray] = {}
    for name, (weight, bias) in pairs.items():
        out[f"images.{place}.{name}.weight"], out[f"images.{place}.{name}.bias"] = weight, bias
    return out


def _show(sizes: Iterable[tuple[Any, ...]]) -> str:
    return " ".join("x".join(map(str, size)) for size in sizes) or "none"
