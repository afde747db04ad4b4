"""Statistics that an environment reports of itself beside its records, as Unity's StatsRecorder does."""

from __future__ import annotations

import numbers
from collections.abc import Iterable, Mapping
from typing import Any

from mappo_unity.scenes.contract.rules import EnvironmentDataError, show_kind

AVERAGE, MOST_RECENT, SUM, HISTOGRAM = AGGREGATIONS = ("average", "most_recent", "sum", "histogram")
"""How values become one number, in the order of ML-Agents' StatsAggregationMethod."""
Statistics = Mapping[str, list[tuple[float, str]]]
"""Values reported under each name, oldest first, each with one of `AGGREGATIONS`."""


def pop_statistics(env: Any) -> Statistics:
    """Return what an environment reported since the last call; nothing where it has no `pop_statistics`.

    Raises:
        EnvironmentDataError: it is not of the form of `Statistics`.
    """
    pop = getattr(env, "pop_statistics", None)
    if pop is None:
        return {}

    found = pop()
    if not isinstance(found, Mapping):
        raise EnvironmentDataError(f"pop_statistics() returned {show_kind(found)}; it must be a dict by name")
    for name, values in found.items():
        _check(name, values)
    return found


def _check(name: Any, values: Any) -> None:
    if not isinstance(name, str) or not name:
        raise EnvironmentDataError(f"pop_statistics() has a name {name!r}; names must be texts")

    for entry in values if isinstance(values, (list, tuple)) else [values]:
        pair = isinstance(entry, (list, tuple)) and len(entry) == 2
        if not (pair and isinstance(entry[0], numbers.Real) and entry[1] in AGGREGATIONS):
            raise EnvironmentDataError(
                f"pop_statistics()[{name!r}] holds {entry!r}; it must be a list of pairs of a number and one "
                f"of {', '.join(AGGREGATIONS)}"
            )


def join_statistics(parts: Iterable[Statistics]) -> Statistics:
    """Return the values of all parts under their names, those of the first part first."""
    out: dict[str, list[tuple[float, str]]] = {}
    for part in parts:
        for name, values in part.items():
            out.setdefault(name, []).extend(values)
    return out
