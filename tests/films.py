"""Where things are in pictures; what a video holds."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from mappo_unity.scenes.core.shapes import Camera, Color

SIZE = (160, 96)
CAMERA = Camera((0.0, 0.0, 0.0), 12.0, yaw=0.0, pitch=30.0)


def where(frame: np.ndarray, color: Color) -> tuple[float, float, int]:
    """Return column and row of the middle of what has a colour, and its number of pixels."""
    channel = int(np.argmax(color[:3]))
    others = [i for i in range(3) if i != channel]
    strong = frame[..., channel].astype(int) - frame[..., others].max(axis=-1).astype(int) > 70
    rows, columns = np.nonzero(strong)
    return float(columns.mean()), float(rows.mean()), rows.size


def frames_of(path: Path) -> list[np.ndarray]:
    """Return the frames of a video."""
    if path.suffix == ".gif":
        with importlib.import_module("PIL.Image").open(path) as image:
            pages = importlib.import_module("PIL.ImageSequence").Iterator(image)
            return [np.array(page.convert("RGB")) for page in pages]
    reader = importlib.import_module("imageio_ffmpeg").read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def gif_durations_ms(path: Path) -> list[int]:
    """Return how long each frame of a GIF is shown."""
    with importlib.import_module("PIL.Image").open(path) as image:
        durations = []
        for number in range(image.n_frames):
            image.seek(number)
            durations.append(image.info["duration"])
    return durations
