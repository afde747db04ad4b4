"""Players that a registry of ML-Agents names: find the entry, fetch its archive, unpack it once.

The format of a registry is that of mlagents_envs.registry.
"""

from __future__ import annotations

import contextlib
import io
import sys
from pathlib import Path
from typing import Any

from mappo_unity.errors import ConfigError
from mappo_unity.protocol.process import find_executable

_URLS = {"darwin": "_darwin_url", "win32": "_win_url"}


def fetch_player(registry: str, entry: str) -> tuple[Path, list[str]]:
    """Return an entry's executable, fetched and unpacked if it is not there yet, and the entry's arguments.

    Raises:
        ConfigError: no such registry or entry (lists those that exist), no player for this system,
            arguments that are no list, or the archive cannot be fetched.
    """
    from mlagents_envs.registry.binary_utils import get_local_binary_path

    entries = _entries(registry)
    if entry not in entries:
        choices = ", ".join(sorted(entries)) or "none"
        raise ConfigError(
            f"env.registry={registry} has no entry {entry!r}; choices: {choices} (env.registry_entry=...)"
        )

    url = getattr(entries[entry], _URLS.get(sys.platform, "_linux_url"))
    if url is None:
        raise ConfigError(f"entry {entry!r} of env.registry={registry} has no player for {sys.platform}")

    # they choose the scene where one build serves several entries
    arguments = entries[entry]._add_args or []
    if not isinstance(arguments, list):
        raise ConfigError(
            f"entry {entry!r} of env.registry={registry}: additional_args is {arguments!r}; it must be a "
            "list, such as [--level, 3]"
        )

    try:
        with contextlib.redirect_stdout(io.StringIO()):  # its progress bars
            path = get_local_binary_path(entry, url)
    except Exception as error:  # whatever network, archive or disk do
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"entry {entry!r} of env.registry={registry}: {url} gives no player: {reason}"
        ) from error

    return find_executable(path, f"registry entry {entry}"), [str(argument) for argument in arguments]


def _entries(registry: str) -> dict[str, Any]:
    from mlagents_envs.registry import UnityEnvRegistry, default_registry

    if registry == "default":
        source = default_registry
    else:
        source = UnityEnvRegistry()
        source.register_from_yaml(registry)

    try:
        return dict(source.items())
    except Exception as error:  # a missing file, no network, no YAML, other keys
        reason = f"{type(error).__name__}: {error}"
        raise ConfigError(f"env.registry={registry} cannot be read: {reason}") from error
