"""Films: frames into .mp4 (H.264) and .gif files.

In: shapes or frames. Out: a file, which appears under its name only when it is complete. Knows no scene.
"""

from __future__ import annotations

import importlib
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mappo_unity.config import ConfigError
from mappo_unity.render import Renderer
from mappo_unity.scenes.drawings.shapes import Camera, Shape

SUFFIXES = (".mp4", ".gif")


class VideoFile:
    """Draw shapes into a video file; a context manager, which discards the file after an error.

    Args:
        path: NAME.mp4 or NAME.gif; overwritten when the film is complete.
        camera: the first view.
        size: width and height in pixels, both even.
        fps: frames a second.

    Raises:
        ConfigError: the file cannot be written, a package is missing, nothing can be drawn here.
    """

    def __init__(self, path: Path, camera: Camera, size: tuple[int, int], fps: float) -> None:
        check_video(path)
        self._renderer = Renderer(camera, *size)
        self._path = path
        self._folder = Path(tempfile.mkdtemp(prefix=f".{path.stem}_", dir=path.parent))
        self._writer: Any = _open_writer(self._folder / path.name, fps)

    def show(self, shapes: Sequence[Shape], camera: Camera) -> bool:
        """Append a frame; return True: a file always wants more."""
        self.write(self._renderer.frame(shapes, camera))
        return True

    def write(self, frame: np.ndarray) -> None:
        """Append a frame uint8 [height, width, 3]."""
        self._writer.append_data(frame)

    def __enter__(self) -> VideoFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
            if kind is None:
                os.replace(self._folder / self._path.name, self._path)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._renderer.close()


def check_video(path: Path) -> None:
    """Raise ConfigError if no video can be written to `path`."""
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"video={path} must end in one of: {', '.join(SUFFIXES)}")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK) or path.is_dir():
        raise ConfigError(
            f"video={path} cannot be written: {path.parent} must be a folder that can be written"
        )
    for package in ("imageio", "imageio_ffmpeg" if path.suffix == ".mp4" else "PIL"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise ConfigError(
                f"video={path} needs the package {package}: pip install 'mappo-unity[video]'"
            ) from error


class GifWriter:
    """Collect frames; Pillow writes them on closing, with a time for each.

    A GIF counts in hundredths of a second: frames end at their time rounded to it, so errors do not add up.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._image: Any = importlib.import_module("PIL.Image")
        self._path, self._fps = path, fps
        self._frames: list[Any] = []

    def append_data(self, frame: np.ndarray) -> None:
        """Append a frame uint8 [height, width, 3]."""
        self._frames.append(self._image.fromarray(frame))

    def close(self) -> None:
        """Write the file."""
        if not self._frames:
            return
        ends = [round(100 * number / self._fps) for number in range(len(self._frames) + 1)]
        durations_ms = [10 * (end - start) for start, end in zip(ends, ends[1:])]
        first, *rest = self._frames
        first.save(self._path, save_all=True, append_images=rest, duration=durations_ms, loop=0)


def _open_writer(path: Path, fps: float) -> Any:
    if path.suffix == ".gif":
        return GifWriter(path, fps)
    imageio = importlib.import_module("imageio.v2")
    return imageio.get_writer(path, fps=fps, codec="libx264", quality=7, macro_block_size=2)
