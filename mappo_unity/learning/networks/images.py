"""Encoders of images and grids: ML-Agents' (trainers/torch_entities/encoders.py), and two of our own.

What `model.image_encoder` names is convolutions, a Linear layer and its activation.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from mlagents_envs.base_env import ObservationSpec
from torch import Tensor, nn

from mappo_unity.config.schema import ImageKind
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.contract.images import FIRST, LAST, channel_dim

OURS = (ImageKind.auto, ImageKind.grid)
"""One for every size, and one that keeps more of where things are; both with Swish."""
IMAGE_FEATURES = 128  # of ours; ML-Agents' encoders have as many as a hidden layer is wide

MIN_SIDES: dict[ImageKind, int] = {
    ImageKind.auto: 1,
    ImageKind.simple: 20,
    ImageKind.nature: 36,
    ImageKind.resnet: 15,
    ImageKind.match3: 5,
    ImageKind.dense: 1,
    ImageKind.grid: 11,
}
"""The least height and width that an encoder takes."""

RESNET_STACKS = (16, 32, 32)
RESNET_BLOCKS = 2  # of a stack


class ImageEncoder(nn.Module):
    """Convolutions and a linear layer: images ``[..., C, H, W]`` to features.

    Args:
        shape: of an image.
        channel_dim: 0 for ``C, H, W`` (Unity since package 3.0), 2 for ``H, W, C`` (before).
        kind: the encoder.
        width: features of ML-Agents' encoders; `OURS` have their own number.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        channel_dim: int = FIRST,
        kind: ImageKind = ImageKind.auto,
        width: int = IMAGE_FEATURES,
    ) -> None:
        super().__init__()
        self.channels_last = channel_dim == LAST
        channels, height, width_px = (shape[2], *shape[:2]) if self.channels_last else shape
        self.size = IMAGE_FEATURES if kind in OURS else width

        self.conv = nn.Sequential(*_convolutions(kind, channels, min(height, width_px)), nn.Flatten())

        # the convolutions themselves tell the size of their features
        with torch.no_grad():
            flat = self.conv(torch.zeros(1, channels, height, width_px)).shape[1]
        self.out = nn.Sequential(nn.Linear(flat, self.size), _last_activation(kind))

    def forward(self, image: Tensor) -> Tensor:
        """Return features ``[..., size]`` of images ``[..., C, H, W]`` (or ``[..., H, W, C]``)."""
        # convolutions take a single batch dimension
        flat = image.flatten(0, -4)
        flat = flat.permute(0, 3, 1, 2) if self.channels_last else flat
        return self.out(self.conv(flat)).unflatten(0, image.shape[:-3])


def by_pixel(images: Tensor) -> Tensor:
    """Return images ``[..., C, H, W]`` whose channels, pixel by pixel, lie side by side in memory.

    Nothing else changes. On a CPU, gradients of convolutions of such images take half the time ("channels
    last" in PyTorch); on a GPU it has not been measured, and is the same so that runs are. Bytes only: a
    second copy of images in floats would take four times as much memory.
    """
    if images.dtype != torch.uint8:
        return images
    return images.movedim(-3, -1).contiguous().movedim(-1, -3)


class ResidualBlock(nn.Module):
    """Two convolutions whose output is added to what they were given."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, 1, 1),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, 1, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return ``[n, C, H, W]`` of the same."""
        return x + self.layers(x)


def check_sides(behavior: str, sensors: Sequence[ObservationSpec], kind: ImageKind) -> None:
    """Raise ConfigError if an image is smaller than its encoder takes."""
    for index, sensor in enumerate(sensors):
        if len(sensor.shape) != 3:
            continue
        height, width = sensor.shape[:2] if channel_dim(sensor) == LAST else sensor.shape[1:]
        side = min(height, width)
        if side < MIN_SIDES[kind]:
            fits = ", ".join(other.value for other, least in MIN_SIDES.items() if side >= least)
            raise ConfigError(
                f"sensor obs_{index} ({sensor.name}) of {behavior!r} is {height} x {width}, too small for "
                f"model.image_encoder={kind.value}, which takes {MIN_SIDES[kind]} x {MIN_SIDES[kind]} and "
                f"more; choices for this size: {fits}"
            )


def _convolutions(kind: ImageKind, channels: int, side: int) -> list[nn.Module]:
    """Return the layers before the linear one."""
    if kind is ImageKind.resnet:
        return _resnet(channels)
    # features, kernel, stride and padding of each
    sizes: dict[ImageKind, list[tuple[int, int, int, int]]] = {
        ImageKind.auto: [(16, 8, 4, 0), (32, 4, 2, 0)] if side >= 20 else [(16, 3, 1, 1), (32, 3, 2, 1)],
        ImageKind.simple: [(16, 8, 4, 0), (32, 4, 2, 0)],
        ImageKind.nature: [(32, 8, 4, 0), (64, 4, 2, 0), (64, 3, 1, 0)],
        ImageKind.match3: [(35, 3, 1, 0), (144, 3, 1, 0)],
        ImageKind.dense: [],
        ImageKind.grid: [(16, 5, 3, 0), (32, 3, 1, 0)],
    }
    layers: list[nn.Module] = []
    for features, kernel, stride, padding in sizes[kind]:
        activation = nn.SiLU() if kind in OURS else nn.LeakyReLU()
        layers += [nn.Conv2d(channels, features, kernel, stride, padding), activation]
        channels = features
    return layers


def _resnet(channels: int) -> list[nn.Module]:
    layers: list[nn.Module] = []
    for features in RESNET_STACKS:
        layers += [nn.Conv2d(channels, features, 3, 1, 1), nn.MaxPool2d(3, 2)]
        layers += [ResidualBlock(features) for _ in range(RESNET_BLOCKS)]
        channels = features
    return [*layers, nn.SiLU()]


def _last_activation(kind: ImageKind) -> nn.Module:
    if kind in OURS:
        return nn.SiLU()
    return nn.ReLU() if kind is ImageKind.resnet else nn.LeakyReLU()
