"""How an extra of this package is installed here, for messages that miss one."""

from __future__ import annotations

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
    """Return what installs an extra: scripts/setup for a clone's own .venv, pip elsewhere."""
    # short where the user stands at the top of the clone, else with the whole path
    is_here = Path.cwd() == ROOT
    setup = ROOT / "scripts" / "setup"

    if os.name == "posix" and setup.is_file() and Path(sys.prefix).resolve() == (ROOT / ".venv").resolve():
        return f"{'./scripts/setup' if is_here else shlex.quote(str(setup))} {extra}"

    if (ROOT / "pyproject.toml").is_file():  # a clone, in an environment of the user's
        place = "." if is_here else str(ROOT)
        return f"pip install --editable {shlex.quote(f'{place}[{extra}]')}"

    return f"pip install 'mappo-unity[{extra}]'"
