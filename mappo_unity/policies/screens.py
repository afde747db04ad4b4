"""Whether a video can be drawn and written, or a window be opened, here: asked before torch is loaded.

In: `PlayConfig` and what the system has. Out: nothing, or a `ConfigError` that names what is missing.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path

from mappo_unity.config.schema import ConfigError, PlayConfig


def check_screen(cfg: PlayConfig) -> None:
    """Raise ConfigError if the video cannot be written or drawn, or no window can be opened."""
    check_mujoco()
    if cfg.video is None:
        from mappo_unity.policies.window import check_display

        return check_display()
    from mappo_unity.policies.render import check_opengl
    from mappo_unity.policies.video import check_video

    check_video(Path(cfg.video))
    check_opengl()


def check_mujoco() -> None:
    """Raise ConfigError if MuJoCo cannot be loaded with the OpenGL that MUJOCO_GL names.

    MuJoCo looks at that variable when it is imported, whether anything is drawn or not.
    """
    choice = os.environ.get("MUJOCO_GL", "").strip()
    if not choice:
        return
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # PyOpenGL raises many kinds where a library is missing
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(
            f"MuJoCo cannot be loaded with the environment variable MUJOCO_GL={choice} ({reason}): unset it, "
            "or set it to egl or osmesa and install that (Debian and Ubuntu: apt-get install libegl1 "
            "libgl1-mesa-dri, or libosmesa6)"
        ) from error
