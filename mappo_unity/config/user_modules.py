"""Where the module of env.factory lies: beside the user, on Python's path, or where a run found it.

The module itself is not imported, but looking for it imports its parent packages. `sys.path` gets the folders
that are needed.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

from mappo_unity.errors import ConfigError


def add_working_directory() -> None:
    """Let modules beside the user be found, after all others."""
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))


def folder_of(factory: str) -> Path | None:
    """Return the folder on Python's path in which the factory's module is found; None: in no folder."""
    add_working_directory()
    module = factory.partition(":")[0]

    try:
        spec = importlib.util.find_spec(module)
    except Exception:  # a parent package raises what it likes
        return None

    if spec is None or not spec.has_location or spec.origin is None:
        return None

    # up by one for each parent package, and by one more for a package, whose file is its __init__.py
    file = Path(spec.origin).absolute()
    levels = module.count(".") + (file.stem == "__init__")
    return file.parents[levels] if levels < len(file.parents) else None


def look_in(folder: Path | None, factory: str, run: Path) -> None:
    """Let the factory's module be found in the folder that a run remembers, unless it is found without.

    Raises:
        ConfigError: it is nowhere; names both places.
    """
    add_working_directory()
    module = factory.partition(":")[0]
    if _is_found(module):
        return

    # last on the path, so that it hides no other module
    if folder is not None:
        sys.path.append(str(folder))
        if _is_found(module):
            return
        sys.path.remove(str(folder))

    if folder is None:
        elsewhere = f", and the record of the run {run} does not say where it was"
    elif folder.is_dir():
        elsewhere = f", nor in {folder}, where the run {run} found it"
    else:
        elsewhere = f", and the folder {folder}, where the run {run} found it, is gone"

    raise ConfigError(
        f"env.factory={factory}: there is no module {module!r} in the working directory {Path.cwd()} or "
        f"elsewhere on Python's path{elsewhere}; go to the folder that holds it, or name it in "
        "PYTHONPATH"
    )


def _is_found(module: str) -> bool:
    """Whether a module is there; one whose parent package fails is, and its import will tell why."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError as error:
        # a parent package may miss an import of its own, which says nothing against the module
        return not (error.name and f"{module}.".startswith(f"{error.name}."))
    except Exception:
        return True
