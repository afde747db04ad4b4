"""Where VMAS' objects keep their values: the dicts and lists below an environment, for snapshots of it."""

from __future__ import annotations

from typing import Any

from vmas.simulator.environment import Environment
from vmas.simulator.scenario import BaseScenario


def holders_of(root: Environment) -> dict[str, Any]:
    """Return the dicts and lists in which VMAS' objects keep their values, by the shortest way there."""
    found: dict[str, Any] = {"": vars(root)}
    seen = {id(vars(root))}
    waiting = list(found.items())

    # the list grows while it is gone through
    for path, holder in waiting:
        for key, value in items_of(holder):
            inside = value if isinstance(value, dict | list) else _attributes(value)
            if inside is not None and id(inside) not in seen:
                seen.add(id(inside))
                found[f"{path}/{key}"] = inside
                waiting.append((f"{path}/{key}", inside))

    return found


def items_of(holder: Any) -> list[tuple[Any, Any]]:
    """Return keys and values; dicts keyed by objects (forces) are VMAS' notes within a step."""
    if isinstance(holder, dict):
        return [(key, value) for key, value in holder.items() if isinstance(key, str)]
    return list(enumerate(holder))


def _attributes(value: Any) -> dict[str, Any] | None:
    """Return the attributes of an object of VMAS; None of any other."""
    ours = isinstance(value, BaseScenario) or type(value).__module__.startswith("vmas.")
    return vars(value) if ours and hasattr(value, "__dict__") else None
