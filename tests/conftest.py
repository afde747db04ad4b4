"""Shared fixtures. One thread for torch and its libraries: tests are small and share the machine."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")  # why: mappo_unity/protocol/__init__.py


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder with the official policies and scene sheets; skip where it is absent.

    It lies beside the checkout, or where the environment variable MAPPO_SHARED says.
    """
    beside = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("MAPPO_SHARED", beside))
    if not folder.is_dir():
        pytest.skip(f"needs the shared folder (MAPPO_SHARED={folder} is not a folder)")
    return folder


@pytest.fixture(scope="module")
def renderer() -> Iterator[Any]:
    """Return a renderer; skip where no OpenGL works."""
    films = importlib.import_module("films")
    try:
        made = importlib.import_module("mappo_unity.viewing.render").Renderer(films.CAMERA, *films.SIZE)
    except importlib.import_module("mappo_unity.errors").ConfigError as error:
        pytest.skip(str(error))
    yield made
    made.close()


@pytest.fixture
def needs_video(renderer: Any) -> None:
    """Skip where no video can be written."""
    pytest.importorskip("imageio_ffmpeg")
    pytest.importorskip("PIL")
