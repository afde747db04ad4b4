"""An ONNX model compared with the actor that it was made from, on the same observations.

Deterministic actions must agree to 1e-5, or to what float32 rounds them by where that is more; sampled ones
in distribution.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from mappo_unity import keys
from mappo_unity.config.packages import ExportError
from mappo_unity.learning.networks.distributions import CONTINUOUS_LIMIT, ActionDistribution
from mappo_unity.learning.networks.encoders import in_floats
from mappo_unity.learning.torch_settings import exact_products
from mappo_unity.policies.onnx_policy import fit_image, open_session

TOLERANCE = 1e-5  # of deterministic actions, and of the log-probability of the branch taken
DRAWS = 8192  # sampled actions that are compared
ROUNDING = 10.0  # times the error of torch in float32, which those of onnxruntime are like
SIGMAS = 6.0  # a right model fails the comparison of its samples about once in a million times


def compare(
    data: bytes, actor: Any, sensors: Sequence[Sequence[int]], sample: dict[str, torch.Tensor]
) -> float:
    """Play a model in onnxruntime and the actor in torch on the same observations.

    Args:
        sample: the actor's inputs, ``[n, ...]``.

    Returns:
        The largest difference: of deterministic continuous actions, or by which the log-probability
        of a deterministic branch falls short of the best one's.

    Raises:
        ExportError: they play differently.
    """
    session = open_session(data, "the export")
    network = actor[0].module
    # behind a memory stands the actor that it was put into
    encoder = (network.actor if actor.has_memory else network).encoder
    feed = _feed(session, encoder, sensors, sample)
    with torch.no_grad(), exact_products():
        out = actor[0](TensorDict(sample, [len(next(iter(sample.values())))]))
    params = out.get("params")
    expected = ActionDistribution(params, actor.layout, sample.get(keys.MASK))

    found = _run(session, feed, "deterministic_", expected)
    error = max(_continuous_error(expected, found), _branch_error(expected, found))
    off = 0.0
    if actor.has_memory:
        after = torch.from_numpy(session.run(["recurrent_out"], feed)[0][:, 0])
        off = _memory_error(out.get(keys.MEMORY_AFTER), after)
    _check_errors(error, off, lambda: _rounding(actor, sample, out))

    # The graph draws one action a row: as many runs as make DRAWS actions over all rows.
    runs = math.ceil(DRAWS / len(params))
    drawn = [_run(session, feed, "", expected) for _ in range(runs)]
    _compare_continuous(expected, drawn)
    _compare_branches(expected, drawn)

    return error


def _feed(
    session: Any, encoder: Any, sensors: Sequence[Sequence[int]], sample: dict[str, torch.Tensor]
) -> dict[str, np.ndarray]:
    """Split an actor's inputs into those of the graph."""
    arrays = {key: in_floats(values).numpy() for key, values in sample.items()}
    shapes = {i.name: list(i.shape) for i in session.get_inputs()}
    images = iter(encoder.images)
    feed, start = {}, 0

    # The actor takes all vectors as one entry; each sensor has its columns of it, in their order.
    for index, shape in enumerate(sensors):
        name = f"obs_{index}"
        if len(shape) == 1:
            feed[name] = arrays[keys.OBS][:, start : start + shape[0]]
            start += shape[0]
        elif len(shape) == 2:
            feed[name] = arrays[keys.SENSOR.format(index)]
        else:
            image = arrays[keys.SENSOR.format(index)]
            feed[name] = fit_image(image, shapes[name], next(images).channels_last)

    if keys.MASK in arrays:
        feed["action_masks"] = arrays[keys.MASK]
    if keys.MEMORY in arrays:
        feed["recurrent_in"] = arrays[keys.MEMORY][:, None]

    return {name: np.ascontiguousarray(values, np.float32) for name, values in feed.items()}


def _run(
    session: Any, feed: dict[str, np.ndarray], prefix: str, expected: ActionDistribution
) -> dict[str, torch.Tensor]:
    kinds = {"continuous": expected.layout.continuous, "discrete": len(expected.layout.branches)}
    names = [kind for kind, size in kinds.items() if size]
    outputs = session.run([f"{prefix}{kind}_actions" for kind in names], feed)
    return {kind: torch.from_numpy(values) for kind, values in zip(names, outputs)}


def _check_errors(error: float, off: float, rounding: Callable[[], tuple[float, float]]) -> None:
    """Raise ExportError if actions or the memory differ by more than the tolerance and float32 explain."""
    if error <= TOLERANCE and off <= TOLERANCE:
        return

    of_actions, of_memory = (max(TOLERANCE, ROUNDING * found) for found in rounding())
    # Asked this way round because nan, which is above no tolerance, must not pass.
    if not off <= of_memory:
        raise ExportError(
            f"the export remembers otherwise than the checkpoint: its memory differs by {off:.3g}, more than "
            f"{of_memory:.3g}"
        )
    if not error <= of_actions:
        raise ExportError(
            "the export plays otherwise than the checkpoint: its deterministic actions differ by "
            f"{error:.3g}, more than {of_actions:.3g}"
        )


def _rounding(actor: Any, sample: dict[str, torch.Tensor], out: TensorDict) -> tuple[float, float]:
    """Return how far torch's actions and memory in float32 are from those in float64.

    Observations far from zero that nothing normalises cost digits, in any program. The largest error of all
    rows counts: that of one may be small by luck.
    """
    inputs = {key: in_floats(values) for key, values in sample.items()}
    inputs = {key: v.double() if v.is_floating_point() else v for key, v in inputs.items()}
    with torch.no_grad():
        found = copy.deepcopy(actor[0]).double()(TensorDict(inputs, out.batch_size))

    mask = sample.get(keys.MASK)
    rounded, exact = (ActionDistribution(o.get("params"), actor.layout, mask) for o in (out, found))
    errors = [_actions(rounded) - _actions(exact)]
    # but for forbidden branches, whose log-probabilities are no numbers to compare
    errors += [(a - b)[a.exp() > 0] for a, b in zip(rounded.log_probs, exact.log_probs)]
    of_actions = max(float(part.abs().max()) for part in errors if part.numel())
    if not actor.has_memory:
        return of_actions, 0.0
    return of_actions, _memory_error(found.get(keys.MEMORY_AFTER), out.get(keys.MEMORY_AFTER))


def _memory_error(expected: torch.Tensor, found: torch.Tensor) -> float:
    # an LSTM's cells grow without a bound, and float32 is exact to so many digits only
    return float(((found - expected).abs() / expected.abs().clamp_min(1.0)).max())


def _continuous_error(expected: ActionDistribution, found: dict[str, torch.Tensor]) -> float:
    if "continuous" not in found:
        return 0.0
    return float((found["continuous"] - _actions(expected)).abs().max())


def _actions(expected: ActionDistribution) -> torch.Tensor:
    """Return the deterministic continuous actions, as Unity gets them."""
    return expected.squash(expected.loc).clamp(-CONTINUOUS_LIMIT, CONTINUOUS_LIMIT) / CONTINUOUS_LIMIT


def _branch_error(expected: ActionDistribution, found: dict[str, torch.Tensor]) -> float:
    if "discrete" not in found:
        return 0.0

    # Equally good branches may be chosen differently: what counts is how much worse the choice is.
    chosen = expected.layout.to_categories(found["discrete"])
    shortfall = [
        log_probs.max(-1).values - log_probs.gather(-1, chosen[:, branch, None])[:, 0]
        for branch, log_probs in enumerate(expected.log_probs)
    ]
    return float(torch.stack(shortfall).max())


def _compare_continuous(expected: ActionDistribution, drawn: list[dict[str, torch.Tensor]]) -> None:
    """Compare how many draws lie below mean - std, mean and mean + std, where clipping is no matter."""
    if "continuous" not in drawn[0]:
        return

    draws = torch.stack([d["continuous"] for d in drawn]) * CONTINUOUS_LIMIT
    std = expected.log_std.exp()
    for sigmas in (-1.0, 0.0, 1.0):
        limit = expected.squash(expected.loc + sigmas * std)
        inside = limit.abs() < CONTINUOUS_LIMIT - 1e-3
        share = 0.5 * (1 + math.erf(sigmas / math.sqrt(2)))

        # The number of draws below a limit is binomial: mean n p, variance n p (1 - p).
        count = inside.sum(0) * len(draws)
        below = ((draws <= limit) & inside).sum((0, 1))
        _require(below, count * share, count * share * (1 - share), "continuous actions")


def _compare_branches(expected: ActionDistribution, drawn: list[dict[str, torch.Tensor]]) -> None:
    """Compare how often each category was drawn."""
    if "discrete" not in drawn[0]:
        return

    chosen = expected.layout.to_categories(torch.stack([d["discrete"] for d in drawn]))
    for branch, log_probs in enumerate(expected.log_probs):
        probs = log_probs.double().exp()
        counts = torch.nn.functional.one_hot(chosen[..., branch], probs.shape[-1]).sum(0)

        # Chance excuses no forbidden action, however few there are.
        if (counts[probs == 0] > 0).any():
            raise ExportError(f"the export draws forbidden actions of branch {branch}")

        mean, var = probs * len(chosen), probs * (1 - probs) * len(chosen)
        _require(counts.sum(0), mean.sum(0), var.sum(0), f"actions of branch {branch}")


def _require(counts: torch.Tensor, mean: torch.Tensor, var: torch.Tensor, what: str) -> None:
    """Raise unless counts lie within six standard deviations (and ten, for the rarest) of their means."""
    off = (counts - mean).abs()
    if (off > SIGMAS * var.sqrt() + 10).any():
        worst = int((off - SIGMAS * var.sqrt()).argmax())
        raise ExportError(
            f"the export samples other {what} than the checkpoint: in column {worst} {counts[worst]:.0f} "
            f"of a kind instead of {mean[worst]:.0f} +- {var[worst].sqrt():.0f}"
        )
