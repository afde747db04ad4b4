"""Networks for which left and right are the same game: what they do is mirrored where what they see is.

A mirror image is an exchange of columns and of signs that undoes itself. With M for that of observations and
N for that of a network's outputs, a network f becomes

    g(x) = (f(x) + N f(M x)) / 2,    so that    g(M x) = N g(x)

the average over a group of two (networks that keep a game's symmetry: van der Pol et al., arXiv 2006.16908).
A first layer that tells both apart (`handed`) loosens that where the options say so.
Unlike learning from mirrored copies of a batch (Mittal et al., arXiv 2403.04359), it leaves PPO's ratios what
they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mappo_unity.config.schema import MirrorConfig, show_numbers
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.distributions import ActionLayout
from mappo_unity.learning.networks.encoders import ObsLayout
from mappo_unity.scenes.contract.images import FIRST


class Mirror(nn.Module):
    """The mirror images of an agent's observations and of an actor's outputs ``[..., P]``.

    Args:
        columns, signs: of vectors ``[..., O]`` column i of the image is ``signs[i] * x[columns[i]]``; none
            where there are no vectors.
        trace_columns, trace_signs: the same of the traces that the network reads; none where it reads none.
        widths: of each image the dimension of its columns, counted from the end.
        out_columns, out_signs: the same of the outputs.
        continuous: of the outputs, how many of the first ones are means.
        options: what it was made from, as plain values.
    """

    columns: Tensor
    signs: Tensor
    trace_columns: Tensor
    trace_signs: Tensor
    out_columns: Tensor
    out_signs: Tensor

    def __init__(
        self,
        columns: np.ndarray,
        signs: np.ndarray,
        trace_columns: np.ndarray,
        trace_signs: np.ndarray,
        widths: Sequence[int],
        out_columns: np.ndarray,
        out_signs: np.ndarray,
        continuous: int,
        options: dict[str, Any],
    ) -> None:
        super().__init__()
        for name, values, dtype in (
            ("columns", columns, torch.int64),
            ("signs", signs, torch.float32),
            ("trace_columns", trace_columns, torch.int64),
            ("trace_signs", trace_signs, torch.float32),
            ("out_columns", out_columns, torch.int64),
            ("out_signs", out_signs, torch.float32),
        ):
            # they follow from the options, which a checkpoint holds
            self.register_buffer(name, torch.tensor(values.tolist(), dtype=dtype), persistent=False)
        self.widths, self.continuous, self.options = list(widths), continuous, options

    @property
    def num_entries(self) -> int:
        """How many observation entries have an image: vectors, traces, images."""
        return bool(len(self.columns)) + bool(len(self.trace_columns)) + len(self.widths)

    def both(self, *obs: Tensor) -> list[Tensor]:
        """Return each of an agent's observations ``[..., *]`` and its mirror image, ``[2, ..., *]``.

        Args:
            obs: the entries in the order of `ObsLayout.keys`.
        """
        images = list(obs)
        out = []
        for columns, signs in ((self.columns, self.signs), (self.trace_columns, self.trace_signs)):
            if len(columns):
                vector = images.pop(0)
                out.append(torch.stack([vector, vector.index_select(-1, columns) * signs]))
        return out + [torch.stack([x, x.flip(dim)]) for x, dim in zip(images, self.widths, strict=True)]

    def image(self, out: Tensor) -> Tensor:
        """Return the mirror image of outputs ``[..., P]``."""
        return out.index_select(-1, self.out_columns) * self.out_signs

    def mean(self, out: Tensor) -> Tensor:
        """Return ``[..., P]``, the mean of outputs ``[2, ..., P]`` for both, seen from the first's side."""
        return (out[0] + self.image(out[1])) / 2

    def mean_deviation(self, log_std: Tensor) -> Tensor:
        """Return logarithms of deviations ``[C]``, the same for an action and its mirror image."""
        return (log_std + log_std[self.out_columns[: self.continuous]]) / 2


class MirroredCritic(nn.Module):
    """A critic whose values of a situation and of its mirror image are the same: the mean of both.

    Args:
        critic: takes an agent's observations, then whatever has no sides.
        mirror: of the observations.
    """

    def __init__(self, critic: nn.Module, mirror: Mirror) -> None:
        super().__init__()
        self.critic, self.mirror = critic, mirror

    @property
    def head(self) -> nn.Linear:
        """Return the layer that gives values, which PopArt rescales."""
        head = self.critic.head
        assert isinstance(head, nn.Linear)
        return head

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return values ``[..., A, V]``."""
        count = self.mirror.num_entries
        flags = [torch.stack([flag, flag]) for flag in inputs[count:]]
        values: Tensor = self.critic(*self.mirror.both(*inputs[:count]), *flags)
        return values.mean(0)


def make_mirror(cfg: MirrorConfig, obs: ObsLayout, layout: ActionLayout) -> Mirror | None:
    """Return the mirror of a policy name; None where the options describe none.

    Raises:
        ConfigError: they do not fit its observations or actions, or two images are not the original.
    """
    if not cfg.is_used:
        if cfg.use and cfg.handed:
            raise ConfigError("model.mirror.handed=true has no effect: no mirror image is described")
        return None
    if obs.sets:
        raise ConfigError(
            "model.mirror has no mirror image of entities of varying number, and some are there"
        )
    if bool(obs.images) != cfg.flip_images:
        raise ConfigError(
            "model.mirror.flip_images=true has no effect: there are no images or grids"
            if cfg.flip_images
            else "model.mirror needs model.mirror.flip_images=true, since there are images or grids, too"
        )

    columns, signs = _observations(cfg, obs.vector)
    traces = _traces(obs, columns, signs)
    actions, action_signs = _continuous(cfg, layout.continuous)
    logits = _logits(cfg, layout.branches)

    # squashed actions have deviations that are outputs, behind the means
    size, deviations = layout.continuous, layout.continuous if layout.squashed else 0
    out_columns = np.concatenate([actions, size + actions[:deviations], size + deviations + logits])
    out_signs = np.concatenate([action_signs, np.ones(deviations + len(logits))])
    dims = obs.channel_dims or (FIRST,) * len(obs.images)
    widths = [-1 if dim == FIRST else -2 for dim in dims]
    return Mirror(columns, signs, *traces, widths, out_columns, out_signs, size, asdict(cfg))


def _observations(cfg: MirrorConfig, size: int) -> tuple[np.ndarray, np.ndarray]:
    columns = np.arange(size)
    times = np.zeros(size, int)  # that each column changes places

    for first, rays, numbers, frames in _groups(cfg.rays, 4):
        run = np.arange(first, first + rays * numbers * frames)
        _check_within("rays", cfg.rays, run, size, "columns")
        if rays % 2 == 0:
            raise ConfigError(
                f"model.mirror.rays={show_numbers(cfg.rays)} has a sensor of {rays} rays; Unity's have one "
                "ahead, and as many on the right as on the left"
            )

        # ahead, then right and left in turn
        other = [0] + [ray + 1 if ray % 2 else ray - 1 for ray in range(1, rays)]
        columns[run] = run.reshape(frames, rays, numbers)[:, other].ravel()
        times[run] += 1

    for one, another, length in _groups(cfg.swap, 3):
        left, right = np.arange(one, one + length), np.arange(another, another + length)
        both = np.concatenate([left, right])
        _check_within("swap", cfg.swap, both, size, "columns")
        columns[left], columns[right] = right, left
        np.add.at(times, both, 1)

    if (times > 1).any():
        raise ConfigError(
            f"model.mirror.rays and swap name column {(times > 1).argmax()} twice: it changes places once"
        )
    return columns, _signs("negate", cfg.negate, columns, "columns")


def _traces(obs: ObsLayout, columns: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image of traces ``[..., K * (n + 1)]``: averages of images are images of averages."""
    traced = list(obs.traced)
    if not traced:
        return columns[:0], signs[:0]

    for column, image in zip(traced, columns[traced]):
        if image not in traced:
            raise ConfigError(
                f"model.mirror lets columns {column} and {image} change places, of which traces keep "
                f"{column} alone: name both in model.memory_traced or model.critic_traced, or neither"
            )

    # behind the columns of each decay stands the share of the average that is filled
    own = np.array([*(traced.index(image) for image in columns[traced]), len(traced)])
    starts = np.arange(len(obs.traces)) * len(own)
    return (starts[:, None] + own).ravel(), np.tile([*signs[traced], 1.0], len(obs.traces))


def _continuous(cfg: MirrorConfig, size: int) -> tuple[np.ndarray, np.ndarray]:
    what = "continuous actions"
    named = np.array(cfg.swap_actions, int)
    _check_within("swap_actions", cfg.swap_actions, named, size, what)
    if len(set(cfg.swap_actions)) < len(named):
        raise ConfigError(f"model.mirror.swap_actions={show_numbers(cfg.swap_actions)} names an action twice")

    actions = np.arange(size)
    actions[named[::2]], actions[named[1::2]] = named[1::2], named[::2]
    return actions, _signs("negate_actions", cfg.negate_actions, actions, what)


def _logits(cfg: MirrorConfig, sizes: Sequence[int]) -> np.ndarray:
    """Return for each logit the one that takes its place."""
    if not cfg.branches:
        return np.arange(sum(sizes))

    shown = f"model.mirror.branches={show_numbers(cfg.branches)}"
    if len(cfg.branches) != sum(sizes):
        raise ConfigError(
            f"{shown} holds {len(cfg.branches)} numbers; the branches have {list(sizes)} actions, and each "
            "of them has one"
        )

    logits, start = [], 0
    for size in sizes:
        own = np.array(cfg.branches[start : start + size])
        if (own >= size).any() or (own[own] != np.arange(size)).any():
            raise ConfigError(
                f"{shown}: {own.tolist()} is no mirror image of a branch of {size} actions, in which two "
                "change places or one stays"
            )
        logits.append(start + own)
        start += size
    return np.concatenate(logits)


def _groups(numbers: Sequence[int], size: int) -> list[Sequence[int]]:
    return [numbers[i : i + size] for i in range(0, len(numbers), size)]


def _signs(name: str, numbers: list[int], columns: np.ndarray, what: str) -> np.ndarray:
    """Return -1 at the numbers and 1 elsewhere; both of two that change places have the same."""
    _check_within(name, numbers, np.array(numbers, int), len(columns), what)
    signs = np.ones(len(columns), np.float32)
    signs[numbers] = -1

    alone = np.flatnonzero(signs != signs[columns])
    if len(alone):
        raise ConfigError(
            f"model.mirror.{name}={show_numbers(numbers)} holds one of {alone[0]} and {columns[alone[0]]}, "
            "which change places: give both or neither"
        )
    return signs


def _check_within(name: str, numbers: list[int], found: np.ndarray, size: int, what: str) -> None:
    if len(found) and found.max() >= size:
        raise ConfigError(
            f"model.mirror.{name}={show_numbers(numbers)} reaches to number {found.max()}; there are {size} "
            f"{what}, counted from 0"
        )
