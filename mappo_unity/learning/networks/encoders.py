"""Observations of one agent to features: normalised vectors and encoded images.

Vectors ``[..., O]`` and images ``[..., C, H, W]`` become features ``[..., F]``. Normalisation is part of the
module, so that it is saved and exported with the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mlagents_envs.base_env import ObservationSpec
from tensordict import TensorDictBase
from torch import Tensor, nn

from mappo_unity import keys
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.images import FIRST, LAST, channel_dim, guessed_channel_dim

OBS_CLIP = 5.0  # ML-Agents clips normalised observations to +-5
IMAGE_FEATURES = 128


@dataclass(frozen=True)
class ObsLayout:
    """Sizes of an agent's observation: all vectors in one, every image (or grid) by itself.

    `channel_dims`: of each image the dimension of its channels, 0 or 2; none given: 0 of all of them.
    """

    vector: int
    images: tuple[tuple[str, tuple[int, ...]], ...] = ()
    channel_dims: tuple[int, ...] = ()

    @classmethod
    def from_shapes(
        cls, shapes: Sequence[Sequence[int]], channel_dims: Sequence[int | None] | None = None
    ) -> ObsLayout:
        """Read the layout from the sensors' shapes, in their order.

        Args:
            shapes: of all sensors.
            channel_dims: for each sensor, as `channel_dim` returns it; None: they are guessed from the
                shapes, as for older checkpoints, which do not tell.

        Raises:
            ConfigError: a sensor is neither a vector nor an image.
        """
        for index, shape in enumerate(shapes):
            if len(shape) not in (1, 3):
                raise ConfigError(
                    f"sensor obs_{index} has shape {tuple(shape)}; vectors (1 dimension) and images or grids "
                    "(3 dimensions) can be learned from, variable-length buffers cannot yet"
                )

        images = [(keys.SENSOR.format(i), tuple(s)) for i, s in enumerate(shapes) if len(s) == 3]
        dims = [guessed_channel_dim(tuple(s)) for s in shapes] if channel_dims is None else channel_dims
        vector = sum(s[0] for s in shapes if len(s) == 1)
        return cls(vector, tuple(images), tuple(dim for dim in dims if dim is not None))

    @classmethod
    def from_specs(cls, specs: Sequence[ObservationSpec]) -> ObsLayout:
        """Read the layout from observation specs."""
        return cls.from_shapes([spec.shape for spec in specs], [channel_dim(spec) for spec in specs])

    @property
    def keys(self) -> list[str]:
        """Entries that networks read, in the order of `Encoder.forward`'s arguments."""
        return ([keys.OBS] if self.vector else []) + [key for key, _ in self.images]

    @property
    def team_dims(self) -> list[int]:
        """Where the members of a team stand in each of these entries, counted from the end."""
        return ([-2] if self.vector else []) + [-4 for _ in self.images]


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
    def update(self, rows: Tensor) -> None:
        """Take ``rows`` ``[n, size]`` into the statistics (Chan et al., pairwise update)."""
        if not len(rows):
            return
        count = self.count + len(rows)

        weight = float(len(rows) / count)
        delta = rows.mean(0) - self.mean
        var = self.var * (1 - weight) + rows.var(0, unbiased=False) * weight

        self.var.copy_(var + delta**2 * weight * (1 - weight))
        self.mean.add_(delta * weight)
        self.count.copy_(count)
        self.inv_std.copy_(1.0 / torch.sqrt(self.var + self.epsilon))


def running_norms(net: nn.Module) -> list[RunningNorm]:
    """Return all normalisers of a network."""
    return [part for part in net.modules() if isinstance(part, RunningNorm)]


def update_norms(norms: Sequence[RunningNorm], entries: TensorDictBase) -> None:
    """Take the observations of who acts, in entries ``[..., A]`` of one policy name, into the statistics."""
    if norms:
        rows = entries.get(keys.OBS)[entries.get(keys.ACTING).squeeze(-1)]
        for norm in norms:
            norm.update(rows)


class Encoder(nn.Module):
    """Observation entries of an agent to its features ``[..., F]``."""

    def __init__(self, layout: ObsLayout, normalize: bool) -> None:
        super().__init__()
        self.norm: nn.Module = RunningNorm(layout.vector) if normalize and layout.vector else nn.Identity()
        dims = layout.channel_dims or (FIRST,) * len(layout.images)
        self.images = nn.ModuleList([ImageEncoder(s, dim) for (_, s), dim in zip(layout.images, dims)])
        self.vector, self.has_vector = layout.vector, layout.vector > 0
        self.size = layout.vector + IMAGE_FEATURES * len(layout.images)

    def forward(self, *obs: Tensor) -> Tensor:
        """Return features; the arguments come in the order of `ObsLayout.keys`."""
        if not len(self.images):
            return self.norm(obs[0])

        parts = [self.norm(obs[0])] if self.has_vector else []
        images = obs[1:] if self.has_vector else obs
        return torch.cat(parts + [net(image) for net, image in zip(self.images, images)], -1)


class ImageEncoder(nn.Module):
    """Two convolutions and a linear layer, as ML-Agents' "simple" encoder; 3x3 ones on small images.

    Args:
        shape: of an image.
        channel_dim: 0 for ``C, H, W`` (Unity since package 3.0), 2 for ``H, W, C`` (before).
    """

    def __init__(self, shape: tuple[int, ...], channel_dim: int = FIRST) -> None:
        super().__init__()
        self.channels_last = channel_dim == LAST
        channels, height, width = (shape[2], *shape[:2]) if self.channels_last else shape

        if min(height, width) >= 20:
            convolutions = [nn.Conv2d(channels, 16, 8, 4), nn.SiLU(), nn.Conv2d(16, 32, 4, 2), nn.SiLU()]
        else:
            convolutions = [
                nn.Conv2d(channels, 16, 3, 1, 1),
                nn.SiLU(),
                nn.Conv2d(16, 32, 3, 2, 1),
                nn.SiLU(),
            ]

        self.conv = nn.Sequential(*convolutions, nn.Flatten())

        # the convolutions themselves tell the size of their features
        with torch.no_grad():
            flat = self.conv(torch.zeros(1, channels, height, width)).shape[1]
        self.out = nn.Sequential(nn.Linear(flat, IMAGE_FEATURES), nn.SiLU())

    def forward(self, image: Tensor) -> Tensor:
        """Return features ``[..., 128]`` of images ``[..., C, H, W]`` (or ``[..., H, W, C]``)."""
        # convolutions take a single batch dimension
        flat = image.flatten(0, -4)
        flat = flat.permute(0, 3, 1, 2) if self.channels_last else flat
        return self.out(self.conv(flat)).unflatten(0, image.shape[:-3])
