"""Train multi-agent policies (MAPPO) on Unity ML-Agents environments.

    from mappo_unity import load_policy, make_scene, train

The commands do the same from a shell (see `mappo_unity.cli`). What these names need, torch among it, is
imported when they are first used.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mappo_unity.api import load_policy, train
    from mappo_unity.farama import gym_env, parallel_env, vector_env
    from mappo_unity.scenes import make_scene

__version__ = "0.2.0"
__all__ = ["gym_env", "load_policy", "make_scene", "parallel_env", "train", "vector_env"]

# Set before torch is imported, unless the environment says otherwise: threads of OpenMP that wait for each
# other sleep instead of spinning. Where a core is shared, two that spin learn several times slower than one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")

_FARAMA = dict.fromkeys(("gym_env", "parallel_env", "vector_env"), "mappo_unity.farama")
_HOMES = {
    **{"load_policy": "mappo_unity.api", "train": "mappo_unity.api", "make_scene": "mappo_unity.scenes"},
    **_FARAMA,
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
