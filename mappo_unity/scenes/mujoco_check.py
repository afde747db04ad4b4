"""A check whether MuJoCo can be loaded here, for use where a plain import would end in a traceback."""

from __future__ import annotations

import importlib
import os

from mappo_unity.errors import ConfigError


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
