"""The versions that a run is trained with: of Python, this package and its commit, and what it stands on."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

_PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "numpy", "mlagents-envs", "protobuf", "hydra-core")


def read_versions() -> dict[str, Any]:
    """Return the versions of Python, of this package and its commit, and of what it stands on."""
    versions: dict[str, Any] = {"python": platform.python_version(), "platform": platform.platform()}

    for package in ("mappo-unity", *_PACKAGES):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = None

    # A checkout that is used without being installed.
    if versions["mappo-unity"] is None:
        from mappo_unity import __version__

        versions["mappo-unity"] = __version__

    return {**versions, **_git_state(Path(__file__).resolve().parents[2])}


def _git_state(checkout: Path) -> dict[str, Any]:
    if not (checkout / ".git").exists():
        return {}
    try:
        commit = _git(checkout, "rev-parse", "HEAD").strip()
        return {"git_commit": commit, "git_dirty": bool(_git(checkout, "status", "--porcelain").strip())}
    except (OSError, subprocess.SubprocessError):
        return {}


def _git(checkout: Path, *arguments: str) -> str:
    command = ["git", "-C", str(checkout), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout
