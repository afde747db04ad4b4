"""Observations of one agent to features: normalised vectors, encoded images, entities that attend.

Vectors ``[..., O]``, images ``[..., C, H, W]`` and sets of entities ``[..., N, F]`` become features
``[..., F]``. Normalisation, of vectors only, is part of the module, so that it is saved and exported with the
network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mlagents_envs.base_env import ObservationSpec
from tensordict import TensorDictBase
from torch import Tensor, nn

from mappo_unity import keys
from mappo_unity.config.schema import ImageKind
from mappo_unity.errors import ConfigError
from mappo_unity.learning.networks.attention import ENTITY_FEATURES, EntityEncoder
from mappo_unity.learning.networks.images import IMAGE_FEATURES, ImageEncoder
from mappo_unity.learning.networks.traces import ObservationTraces
from mappo_unity.learning.reduction import ALONE, Reduction
from mappo_unity.scenes.contract.images import FIRST, channel_dim, guessed_channel_dim
from mappo_unity.scenes.contract.sensors import is_goal, is_set

OBS_CLIP = 5.0  # ML-Agents clips normalised observations to +-5


@dataclass(frozen=True)
class ObsLayout:
    """Sizes of an agent's observation: all vectors in one, every image (or grid) and set by itself.

    `channel_dims`: of each image the dimension of its channels, 0 or 2; none given: 0 of all of them.
    `sets`: sensors of variable length, ``[N, F]``: up to N entities of F features.
    `goal_vectors`: which columns of the vectors are goal signals, as pairs of first and behind the last.
    `goal_keys`: which images and sets are.
    `traces`, `traced`: decays of a network's `ObservationTraces`, and the vectors' columns that it traces.
    """

    vector: int
    images: tuple[tuple[str, tuple[int, ...]], ...] = ()
    channel_dims: tuple[int, ...] = ()
    sets: tuple[tuple[str, tuple[int, ...]], ...] = ()
    goal_vectors: tuple[tuple[int, int], ...] = ()
    goal_keys: tuple[str, ...] = ()
    traces: tuple[float, ...] = ()
    traced: tuple[int, ...] = ()

    @classmethod
    def from_shapes(
        cls,
        shapes: Sequence[Sequence[int]],
        channel_dims: Sequence[int | None] | None = None,
        goals: Sequence[bool] | None = None,
    ) -> ObsLayout:
        """Read the layout from the sensors' shapes, in their order.

        Args:
            shapes: of all sensors.
            channel_dims: for each sensor, as `channel_dim` returns it; None: they are guessed from the
                shapes, as for older checkpoints, which do not tell.
            goals: for each sensor, whether it is a goal signal; None: none is.

        Raises:
            ConfigError: a sensor is neither a vector, nor a set, nor an image.
        """
        entries = [(keys.SENSOR.format(i), tuple(shape)) for i, shape in enumerate(shapes)]
        for key, shape in entries:
            if len(shape) not in (1, 2, 3):
                raise ConfigError(
                    f"sensor {key} has shape {shape}; vectors (1 dimension), entities of varying number (2) "
                    "and images or grids (3) can be learned from"
                )
        goal_keys = [key for (key, _), goal in zip(entries, goals or ()) if goal]

        vector = 0
        goal_vectors: list[tuple[int, int]] = []
        for key, (size, *rest) in entries:
            if not rest:
                goal_vectors += [(vector, vector + size)] if key in goal_keys else []
                vector += size

        images, sets = (tuple(entry for entry in entries if len(entry[1]) == n) for n in (3, 2))
        dims = [guessed_channel_dim(tuple(s)) for s in shapes] if channel_dims is None else channel_dims
        return cls(
            vector,
            images,
            tuple(dim for dim in dims if dim is not None),
            sets,
            tuple(goal_vectors),
            tuple(key for key, _ in (*images, *sets) if key in goal_keys),
        )

    @classmethod
    def from_specs(cls, specs: Sequence[ObservationSpec]) -> ObsLayout:
        """Read the layout from observation specs.

        Raises:
            ConfigError: as `from_shapes`; rows are not marked as of varying number.
        """
        for index, spec in enumerate(specs):
            if len(spec.shape) == 2 and not is_set(spec):
                raise ConfigError(
                    f"sensor obs_{index} ({spec.name}) has shape {tuple(spec.shape)}, but does not say that "
                    "its rows are entities of varying number, as dimension_property=(VARIABLE_SIZE, NONE) "
                    "does (in Unity: a BufferSensor); a table of fixed size must be sent as a vector"
                )
        goals = [is_goal(spec) for spec in specs]
        return cls.from_shapes([spec.shape for spec in specs], [channel_dim(spec) for spec in specs], goals)

    @property
    def keys(self) -> list[str]:
        """Entries that networks read, in the order of `Encoder.forward`'s arguments."""
        vectors = ([keys.OBS] if self.vector else []) + ([keys.TRACES] if self.traced else [])
        return vectors + [key for key, _ in (*self.images, *self.sets)]

    @property
    def team_dims(self) -> list[int]:
        """Where the members of a team stand in each of these entries, counted from the end."""
        vectors = [-2] * (bool(self.vector) + bool(self.traced))
        return vectors + [-1 - len(shape) for _, shape in (*self.images, *self.sets)]


class RunningNorm(nn.Module):
    """Normalise features by running mean and variance: ``clip((x - mean) / std, +-5)``.

    Statistics move only in `update`, never in `forward`, so that they stand still during an update, and, with
    `ppo.obs_norm_update=batch`, while a batch is collected: its first minibatch then has ratio 1.
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    inv_std: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("inv_std", torch.ones(size))
        self.epsilon = 1e-6  # added to the variance

    def begin_with_prior(self) -> None:
        """Count one pseudo-observation of mean 0 and variance 1 (ML-Agents' Normalizer).

        It keeps the variance of a feature that never changes above 0, so nothing is added to it.
        """
        self.count.fill_(1.0)
        self.epsilon = 0.0

    def forward(self, x: Tensor) -> Tensor:
        """Return ``x`` ``[..., size]``, normalised."""
        return ((x - self.mean) * self.inv_std).clamp(-OBS_CLIP, OBS_CLIP)

    @torch.no_grad()
    def update(self, rows: Tensor, reduction: Reduction = ALONE) -> None:
        """Take ``rows`` ``[n, size]`` of all learners into the statistics (Chan et al., pairwise update)."""
        if not reduction.total(len(rows)):
            return
        new, mean, new_var = reduction.moments(rows)
        count = self.count + new

        weight = float(new / count)
        delta = mean - self.mean
        var = self.var * (1 - weight) + new_var * weight

        self.var.copy_(var + delta**2 * weight * (1 - weight))
        self.mean.add_(delta * weight)
        self.count.copy_(count)
        self.inv_std.copy_(1.0 / torch.sqrt(self.var + self.epsilon))


def running_norms(net: nn.Module) -> list[RunningNorm]:
    """Return all normalisers of a network."""
    return [part for part in net.modules() if isinstance(part, RunningNorm)]


def update_norms(norms: Sequence[RunningNorm], entries: TensorDictBase, reduction: Reduction = ALONE) -> None:
    """Take the observations of who acts, in entries ``[..., A]`` of one policy name, into the statistics."""
    if norms:
        rows = entries.get(keys.OBS)[entries.get(keys.ACTING).squeeze(-1)]
        for norm in norms:
            norm.update(rows, reduction)


class Encoder(nn.Module):
    """Observation entries of an agent to its features ``[..., F]``: vectors, traces, images, entities.

    Args:
        layout: the entries.
        normalize: whether vectors are normalised.
        kind: the encoder of images.
        width: features of an image where ML-Agents' encoders encode it: those of the first hidden layer.

    Attributes: `size`, F; `goal_columns`, those of the F that are goal signals; `channels_first`, the entries
    that are images ``[..., C, H, W]``.
    """

    def __init__(
        self,
        layout: ObsLayout,
        normalize: bool,
        kind: ImageKind = ImageKind.auto,
        width: int = IMAGE_FEATURES,
    ) -> None:
        super().__init__()
        self.norm: nn.Module = RunningNorm(layout.vector) if normalize and layout.vector else nn.Identity()
        self.traces = ObservationTraces(layout.traces, layout.traced) if layout.traced else None
        dims = layout.channel_dims or (FIRST,) * len(layout.images)
        images = [ImageEncoder(s, dim, kind, width) for (_, s), dim in zip(layout.images, dims)]
        self.images = nn.ModuleList(images)
        self.channels_first = [key for (key, _), dim in zip(layout.images, dims) if dim == FIRST]
        self.vector, self.has_vector = layout.vector, layout.vector > 0

        widths = [(key, net.size) for (key, _), net in zip(layout.images, images)]
        vectors = layout.vector + (self.traces.size if self.traces is not None else 0)
        around = vectors + sum(size for _, size in widths)
        sizes = [shape[1] for _, shape in layout.sets]
        self.sets = EntityEncoder(sizes, around) if sizes else None
        self.size = around + (ENTITY_FEATURES if sizes else 0)
        self.goal_columns = _goal_columns(layout, widths, vectors)

    def forward(self, *obs: Tensor) -> Tensor:
        """Return features; the arguments come in the order of `ObsLayout.keys`."""
        if not len(self.images) and self.sets is None and self.traces is None:
            return self.norm(obs[0])

        first = int(self.has_vector) + (self.traces is not None)
        behind = first + len(self.images)
        parts = [self.norm(obs[0])] if self.has_vector else []
        parts += [self._traced(self.traces, obs[1])] if self.traces is not None else []
        parts += [net(in_floats(image)) for net, image in zip(self.images, obs[first:behind])]
        if self.sets is not None:
            around = torch.cat(parts, -1) if parts else None
            parts.append(self.sets(around, obs[behind:]))
        return torch.cat(parts, -1)

    def _traced(self, net: ObservationTraces, traces: Tensor) -> Tensor:
        """Return what traces of the observations, as `norm` gives them, would be."""
        for norm in running_norms(self.norm):
            return net(traces, norm.mean, norm.inv_std).clamp(-OBS_CLIP, OBS_CLIP)
        return traces


def channels_first(net: nn.Module) -> list[str]:
    """Return the entries that a network reads as images ``[..., C, H, W]``."""
    encoders = (module for module in net.modules() if isinstance(module, Encoder))
    return next((encoder.channels_first for encoder in encoders), [])


def in_floats(image: Tensor) -> Tensor:
    """Return an image's float32 numbers, of bytes ``k / 255``; other tensors as they are."""
    if image.dtype != torch.uint8:
        return image
    # by a tensor: on a GPU a division by a number is a multiplication, whose last bit may differ
    return image.float().div_(torch.full((), 255.0, device=image.device))


def in_type(image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an image's numbers as bytes (uint8), or in floats."""
    return in_floats(image) if dtype != torch.uint8 else (image * 255).round().to(dtype)


def _goal_columns(layout: ObsLayout, images: list[tuple[str, int]], start: int) -> list[int]:
    """Return the columns of features that are goals; entities share their columns.

    Args:
        layout: the entries.
        images: key and features of each.
        start: the first column behind the vectors and their traces.
    """
    columns = [column for begin, end in layout.goal_vectors for column in range(begin, end)]
    for key, size in images:
        columns += range(start, start + size) if key in layout.goal_keys else []
        start += size
    if any(key in layout.goal_keys for key, _ in layout.sets):
        columns += range(start, start + ENTITY_FEATURES)
    return columns
