"""Whether an actor plays as the ONNX file does that it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mappo_unity.config.packages import import_package
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.actor_critic import RememberingActor
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionLayout
from mappo_unity.learning.torch_settings import exact_products
from mappo_unity.policies.onnx_policy import fit_image, open_session
from mappo_unity.policies.warm_start.onnx_network import OnnxNetwork

CHECKED_ROWS = 64
TOLERANCE = 1e-5  # of means / 3, of log-probabilities (of larger ones: of their size), of the memory


@torch.no_grad()
def check_agreement(network: OnnxNetwork, net: Any, sensors: Sequence[Sequence[int]]) -> float:
    """Play the file and the network on random observations; return the largest difference of their actions.

    Compared are the means of continuous actions, as they are clipped or squashed, and the log-probabilities
    of every branch, without masks, and the memory.

    Raises:
        ConfigError: they differ by more than `TOLERANCE`: the file was misread.
    """
    rng = np.random.default_rng(0)
    remembers = isinstance(net, RememberingActor)
    actor: Any = net.actor if remembers else net
    feed, inputs = _random_inputs(network, actor.encoder, sensors, rng)
    if remembers:
        feed["recurrent_in"] = rng.normal(0, 0.5, (CHECKED_ROWS, 1, net.state_size)).astype(np.float32)
        inputs.append(torch.from_numpy(feed["recurrent_in"][:, 0]))

    device = next(net.parameters()).device
    with exact_products():
        out = net(*(value.to(device) for value in inputs))
    params = (out[0] if remembers else out).cpu()
    found = _run(network, feed)

    errors = []
    if remembers:
        errors.append(float(np.abs(found.pop().reshape(CHECKED_ROWS, -1) - out[1].cpu().numpy()).max()))
    error = max(errors + _differences(found, params, actor.layout))
    if not error <= TOLERANCE:  # so that nan does not pass
        raise ConfigError(
            f"{network.graph.path} plays otherwise than the network made of it: their actions differ by "
            f"{error:.3g}, more than {TOLERANCE:g}; it holds something that was misread"
        )
    return error


def _run(network: OnnxNetwork, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return what the file's action layers give, which are outputs of a copy of it."""
    onnx, actions = import_package("onnx"), network.actions
    names = [layer.output for layer in ([actions.mean] if actions.mean else []) + actions.branches]
    names += ["recurrent_out"] if network.state is not None else []
    copy = onnx.ModelProto()
    copy.CopyFrom(network.graph.model)
    for name in names:
        if name not in network.graph.outputs:
            copy.graph.output.append(onnx.ValueInfoProto(name=name))
    session = open_session(copy.SerializeToString(), str(network.graph.path))
    wanted = {entry.name for entry in session.get_inputs()}
    return session.run(names, {name: value for name, value in feed.items() if name in wanted})


def _random_inputs(
    network: OnnxNetwork, encoder: Any, sensors: Sequence[Sequence[int]], rng: np.random.Generator
) -> tuple[dict[str, np.ndarray], list[Tensor]]:
    """Return observations for the file, and the same for the network."""
    wide = [rng.normal(size=(CHECKED_ROWS, *shape)).astype(np.float32) for shape in sensors]
    vectors = [values for values in wide if values.ndim == 2]
    joined = np.concatenate(vectors, 1) if vectors else np.zeros((CHECKED_ROWS, 0), np.float32)
    norm: Any = encoder.norm[0] if isinstance(encoder.norm, torch.nn.Sequential) else encoder.norm
    if hasattr(norm, "inv_std"):  # as the normaliser expects them
        joined = joined / norm.inv_std.cpu().numpy() + norm.mean.cpu().numpy()

    feed, inputs, at, place = {"vector_observation": joined}, [torch.from_numpy(joined)], 0, 0
    for index, values in enumerate(wide):
        if values.ndim == 2:
            feed[f"obs_{index}"] = np.ascontiguousarray(joined[:, at : at + values.shape[1]])
            at += values.shape[1]
            continue

        last = bool(encoder.images[place].channels_last)
        inputs.append(torch.from_numpy(values))
        for name in (f"obs_{index}", f"visual_observation_{place}"):
            shape = [0, *network.graph.inputs.get(name, ())]
            feed[name] = np.ascontiguousarray(fit_image(values, shape, last))
        place += 1
    if network.actions.branches:
        sizes = network.actions.branch_sizes
        feed["action_masks"] = np.ones((CHECKED_ROWS, sum(sizes)), np.float32)
    return feed, inputs if vectors else inputs[1:]


def _differences(found: list[np.ndarray], params: Tensor, layout: ActionLayout) -> list[float]:
    size, out = layout.continuous, []
    theirs = [torch.from_numpy(np.asarray(values)) for values in found]
    if size:
        limited = [
            value.tanh() if layout.squashed else value.clamp(-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT) / 3
            for value in (theirs.pop(0), params[:, :size])
        ]
        out.append(float((limited[0] - limited[1]).abs().max()))

    for values, own in zip(theirs, params[:, 2 * size :].split(list(layout.categoricals), -1)):
        # log-probabilities may be large; what counts is their relative error then
        wanted, given = values.log_softmax(-1), own.log_softmax(-1)
        out.append(float(((wanted - given).abs() / wanted.abs().clamp_min(1.0)).max()))
    return out
