"""Shared fixtures. One thread for torch and its libraries: tests are small and share the machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

for variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")  # why: mappo_unity/link/__init__.py


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
