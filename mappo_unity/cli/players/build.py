"""mappo-player build: an executable that looks to ML-Agents like a built Unity player.

``FOLDER/SCENE.x86_64`` (macOS: ``SCENE.app``) is a script that starts mappo-player with this Python.
"""

from __future__ import annotations

import shlex
import sys
from argparse import Namespace
from pathlib import Path

from mappo_unity.errors import ConfigError


def build(scene: str, folder: str, rest: list[str], options: Namespace) -> Path:
    """Write the executable of a scene; return its path.

    Raises:
        ConfigError: no such scene, a folder that cannot be written, or a platform without scripts.
    """
    if rest:
        raise ConfigError(f"build takes a scene and a folder, not {' '.join(rest)}")

    name = scene.rpartition(":")[2] or scene
    path = _executable(Path(folder), name)

    # the trainer's own arguments, its port among them, come behind these ("$@")
    command = [sys.executable, "-m", "mappo_unity.player", scene]
    if options.num_areas is not None:
        command += ["--num-areas", str(options.num_areas)]
    for parameter in options.param:
        command += ["--param", parameter]
    if options.no_png:
        command += ["--no-png"]

    # the error of mkdir would not say which part of the path is a file
    file = next((above for above in path.parents if above.exists() and not above.is_dir()), None)
    if file is not None:
        raise ConfigError(f"{path} cannot be written: {file} is a file, not a folder")

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'#!/bin/sh\nexec {shlex.join(command)} "$@"\n', encoding="utf-8")
        path.chmod(0o755)
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from error

    return path


def _executable(folder: Path, name: str) -> Path:
    if sys.platform == "win32":
        raise ConfigError(
            "mappo-player build writes a script, which ML-Agents cannot start on Windows; run mappo-player "
            f"{name} by hand and train with env.backend=editor"
        )

    if sys.platform == "darwin":
        return folder / f"{name}.app" / "Contents" / "MacOS" / name

    return folder / f"{name}.x86_64"
