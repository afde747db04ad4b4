"""Videos: frames into .mp4 (H.264) and .gif files.

A file appears under its name only when it is complete.
"""

from __future__ import annotations

import importlib
import os
import re
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from mappo_unity.config.extras import install_command
from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.shapes import Camera, Shape
from mappo_unity.viewing.caption import draw_caption
from mappo_unity.viewing.render import Renderer

SUFFIXES = (".mp4", ".gif")


class VideoFile:
    """Draw shapes into a video file; a context manager, which discards the file after an error.

    Args:
        path: NAME.mp4 or NAME.gif; overwritten when the video is complete.
        camera: the first view.
        size: width and height in pixels, both even.
        fps: frames a second.

    Raises:
        ConfigError: the file cannot be written (also later: a full disk), a package is missing, nothing
            can be drawn here.
    """

    def __init__(self, path: Path, camera: Camera, size: tuple[int, int], fps: float) -> None:
        check_video(path)
        self._path, self._size, self._fps = path, size, fps
        # Hidden, and no suffix of a video's: nobody may take it for one.
        self._part = path.with_name(f".{path.stem[:40]}.{os.getpid()}.part")
        self._renderer = Renderer(camera, *size)

    def show(self, shapes: Sequence[Shape], camera: Camera, caption: Sequence[str] = ()) -> bool:
        """Append a frame, with a line of text if there are parts of one; return True: a file wants more."""
        frame = self._renderer.frame(shapes, camera)
        if caption:
            draw_caption(frame, caption)
        self.write(frame)
        return True

    def write(self, frame: np.ndarray) -> None:
        """Append a frame uint8 [height, width, 3]."""
        with _told(self._path):
            self._writer.append(frame)

    def __enter__(self) -> VideoFile:
        kind = GifWriter if self._path.suffix == ".gif" else Mp4Writer

        # What fails here undoes what was done before it; once all is open, `__exit__` does.
        with ExitStack() as stack:
            stack.callback(self._renderer.close)
            with _told(self._path):
                stack.callback(self._part.unlink, missing_ok=True)
                self._part.touch()  # what forbids it is told before anything is played
                self._writer: GifWriter | Mp4Writer = kind(self._part, self._size, self._fps)
            stack.callback(self._writer.stop)
            self._stack = stack.pop_all()

        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with _told(self._path), self._stack:
            if kind is None:
                self._writer.finish()
                os.replace(self._part, self._path)


class GifWriter:
    """Collect frames; write them when the video is over, with a time for each.

    A GIF counts in hundredths of a second: frames end at their time rounded to it, so errors do not add up.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self._image: Any = importlib.import_module("PIL.Image")
        self._path, self._fps = path, fps
        self._frames: list[Any] = []

    def append(self, frame: np.ndarray) -> None:
        """Append a frame uint8 [height, width, 3]."""
        self._frames.append(self._image.fromarray(frame))

    def finish(self) -> None:
        """Write the file; raises OSError."""
        ends = [round(100 * number / self._fps) for number in range(len(self._frames) + 1)]
        durations_ms = [10 * (end - start) for start, end in zip(ends, ends[1:])]

        first, *rest = self._frames
        with self._path.open("wb") as file:
            first.save(file, "GIF", save_all=True, append_images=rest, duration=durations_ms, loop=0)

    def stop(self) -> None:
        """Do nothing: nothing is under way."""


class Mp4Writer:
    """Send frames to ffmpeg.

    Not imageio-ffmpeg's own writer: it passes over ffmpeg's exit code, and a full disk gives a broken video.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        program = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe()

        rate = Fraction(fps).limit_denominator(1001)
        source = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {rate} -i -"
        target = "-an -c:v libx264 -preset veryfast -pix_fmt yuv420p -crf 15 -f mp4"

        self._process = subprocess.Popen(
            [program, "-y", "-v", "error", "-xerror", *source.split(), *target.split(), str(path.absolute())],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is ours to answer
        )

    def append(self, frame: np.ndarray) -> None:
        """Append a frame uint8 [height, width, 3]; raises OSError."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(frame.tobytes())
        except BrokenPipeError:
            # Where ffmpeg ended with an error, this raises its own reason.
            self.finish()
            raise OSError("ffmpeg ended before the video was complete") from None

    def finish(self) -> None:
        """Wait until the file is written; raises OSError with ffmpeg's first complaint."""
        _, complaints = self._process.communicate()
        if self._process.returncode:
            first = complaints.decode(errors="replace").strip().split("\n")[0]
            reason = re.sub(r"^\[[^]]*] *", "", first)  # without the part of ffmpeg that complains
            raise OSError(reason or f"ffmpeg ended with exit code {self._process.returncode}")

    def stop(self) -> None:
        """End ffmpeg if it still runs."""
        self._process.kill()
        self._process.communicate()


def check_video(path: Path, caption: bool = False) -> None:
    """Raise ConfigError if no video, with a caption where that is wanted, can be written to `path`."""
    if path.suffix not in SUFFIXES:
        raise ConfigError(f"video={path} must end in one of: {', '.join(SUFFIXES)}")

    with _told(path):
        writable = path.parent.is_dir() and os.access(path.parent, os.W_OK) and not path.is_dir()
    if not writable:
        raise ConfigError(
            f"video={path} cannot be written: {path.parent} must be a folder that can be written"
        )

    _check_package(f"video={path}", "imageio_ffmpeg" if path.suffix == ".mp4" else "PIL")
    if caption:
        _check_package("caption=true", "PIL")


def _check_package(option: str, package: str) -> None:
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise ConfigError(f"{option} needs the package {package}: {install_command('video')}") from error


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """Tell what kept a video from being written as a mistake in the options."""
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"video={path} cannot be written: {error.strerror or error}; give a file in a folder "
            "that can be written, on a disk with free space"
        ) from error
