"""A window that shows shapes at the pace of the clock."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import mujoco

from mappo_unity.errors import ConfigError
from mappo_unity.scenes.core.shapes import Camera, Shape
from mappo_unity.viewing.render import Stage

NO_WINDOW = "no window can be opened on the display; video=FILE.mp4 or .gif writes a video"


def check_display() -> None:
    """Start the library of windows; raise ConfigError if there is no display, or none that it can use."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ConfigError("there is no display for a window here; video=FILE.mp4 or .gif writes a video")

    import glfw

    glfw.ERROR_REPORTING = "ignore"  # no warnings beside our message
    if not glfw.init():
        raise ConfigError(NO_WINDOW)


class Window:
    """Show shapes in a window; a context manager.

    Args:
        camera: the first view.
        size: width and height in pixels.
        fps: frames a second; `show` waits for the time of its frame.
        title: of the window.

    Raises:
        ConfigError: there is no display, or no window can be opened on it.
    """

    def __init__(self, camera: Camera, size: tuple[int, int], fps: float, title: str) -> None:
        check_display()
        import glfw

        self._glfw: Any = glfw
        # Four samples a pixel; hints count only for windows that are made after them.
        glfw.window_hint(glfw.SAMPLES, 4)
        self._window: Any = glfw.create_window(*size, title, None, None)
        if not self._window:
            glfw.terminate()
            raise ConfigError(NO_WINDOW)

        # MuJoCo puts its pictures and shapes into the context that is current: first this, then its own.
        glfw.make_context_current(self._window)
        self._stage = Stage(camera, *size)
        self._context = mujoco.MjrContext(self._stage.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_WINDOW.value, self._context)

        self._frame_s = 1.0 / fps
        self._due = time.monotonic()

    def show(self, shapes: Sequence[Shape], camera: Camera, caption: Sequence[str] = ()) -> bool:
        """Show a frame, over it a line of text, when its time has come; return False once it was closed."""
        area = mujoco.MjrRect(0, 0, *self._glfw.get_framebuffer_size(self._window))
        mujoco.mjr_render(area, self._stage.fill(shapes, camera), self._context)
        if caption:
            font, corner = mujoco.mjtFont.mjFONT_NORMAL.value, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT.value
            mujoco.mjr_overlay(font, corner, area, "    ".join(caption), "", self._context)

        # After a stall the pace is kept from now on, at most one frame behind: nothing is rushed through.
        self._due = max(self._due + self._frame_s, time.monotonic() - self._frame_s)
        time.sleep(max(0.0, self._due - time.monotonic()))

        self._glfw.swap_buffers(self._window)
        self._glfw.poll_events()
        return not self._glfw.window_should_close(self._window)

    def __enter__(self) -> Window:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.free()
        self._glfw.terminate()
