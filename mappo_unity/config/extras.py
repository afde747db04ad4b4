"""How an extra of this package is installed here, for messages that miss one."""

from __future__ import annotations

import importlib.metadata
import os
import shlex
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Where the package lies: the top of a clone, or site-packages."""

SWEEP_EXTRA = {
    "hydra/launcher=joblib": ("hydra_joblib_launcher", "sweep"),
    "hydra/launcher=submitit_local": ("hydra_submitit_launcher", "slurm"),
    "hydra/launcher=submitit_slurm": ("hydra_submitit_launcher", "slurm"),
}
"""Presets of conf/hydra that need a plugin: the plugin's package, and the extra that brings it."""


def install_command(extra: str) -> str:
    """Return what installs an extra: scripts/setup for a clone's own .venv, pip elsewhere.

    Of a package installed by pip it names the extra's packages.
    """
    # short where the user stands at the top of the clone, else with the whole path
    is_here = Path.cwd() == ROOT
    setup = ROOT / "scripts" / "setup"

    if os.name == "posix" and setup.is_file() and Path(sys.prefix).resolve() == (ROOT / ".venv").resolve():
        return f"{'./scripts/setup' if is_here else shlex.quote(str(setup))} {extra}"

    if (ROOT / "pyproject.toml").is_file():  # a clone, in an environment of the user's
        place = "." if is_here else str(ROOT)
        return f"pip install --editable {_quoted(f'{place}[{extra}]')}"

    # by the packages' names: the package itself may have come from a folder that is gone
    return "pip install " + " ".join(_quoted(package) for package in _packages(extra))


def _quoted(word: str) -> str:
    """Return a word as a shell takes it; cmd.exe knows double quotes only, and reads > as elsewhere."""
    return shlex.quote(word) if os.name == "posix" else f'"{word}"'


def _packages(extra: str) -> list[str]:
    """Return what an extra brings, such as ``["matplotlib>=3.8"]``, as the installed package says."""
    try:
        requirements = importlib.metadata.requires("mappo-unity") or []
    except importlib.metadata.PackageNotFoundError:  # copied, not installed
        return [f"mappo-unity[{extra}]"]

    halves = [requirement.partition(";") for requirement in requirements]
    wanted = {f"extra == '{extra}'", f'extra == "{extra}"'}
    return [package.strip() for package, _, marker in halves if marker.strip() in wanted]
