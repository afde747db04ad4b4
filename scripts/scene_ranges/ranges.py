"""What the classes of all scenes stand on: watching a scene, noting extremes and faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

SLACK = 1e-6  # of a stated range, for rounding


@dataclass
class Seen:
    """A range and the extreme values seen."""

    low: float
    high: float
    lowest: float = np.inf
    highest: float = -np.inf
    count: int = 0


class Ranges:
    """Watch one scene.

    `resets` counts checked resets: of agents, or of whole fields and areas where a scene resets these.
    `seen` holds the range and the extremes of every quantity, `faults` how often a rule was broken, with
    the first case. A scene's class states what `begun` and `tick` check.
    """

    RESET_HOOK = "begin_episode"

    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self.resets = 0
        self.seen: dict[str, Seen] = {}
        self.faults: dict[str, list[Any]] = {}
        self.watch(scene, self.RESET_HOOK, self._begun, self.before)
        scene.after_tick = self.tick

    def before(self) -> Any:
        """Return what `begun` needs to know of the moment before the reset."""

    def begun(self, rows: np.ndarray, before: Any) -> None:
        """Check a reset of slots or areas `rows` [n]."""
        raise NotImplementedError

    def tick(self) -> None:
        """Check where bodies are at the end of a tick."""

    def within(self, what: str, values: Any, low: float, high: float) -> None:
        """Check that all values lie in a range, and keep their extremes."""
        values = np.asarray(values)
        if not values.size:
            return
        seen = self.seen.setdefault(what, Seen(low, high))
        lowest, highest = float(values.min()), float(values.max())
        seen.lowest, seen.highest = min(seen.lowest, lowest), max(seen.highest, highest)
        seen.count += values.size
        if not (lowest >= low - SLACK and highest <= high + SLACK):
            self.fault(f"{what} not in {low:g} .. {high:g}", f"{lowest!r} .. {highest!r}")

    def holds(self, rule: str, condition: Any) -> None:
        """Check that a rule holds everywhere."""
        if not np.all(condition):
            self.fault(f"not so: {rule}", f"rows {np.flatnonzero(~np.asarray(condition)).tolist()}")

    def fault(self, rule: str, case: str) -> None:
        """Count a broken rule; keep its first case."""
        self.faults.setdefault(rule, [0, f"tick {self.scene.counter}: {case}"])[0] += 1

    def watch(
        self,
        owner: Any,
        name: str,
        check: Callable[[np.ndarray, Any], None],
        before: Callable[[], Any] | None = None,
    ) -> None:
        """Call `check(rows, before())` after every call of the method `name` of `owner`."""
        method = getattr(owner, name)

        def watched(rows: np.ndarray, *others: Any) -> Any:
            remembered = before() if before else None
            result = method(rows, *others)
            check(rows, remembered)
            return result

        setattr(owner, name, watched)

    def _begun(self, rows: np.ndarray, before: Any) -> None:
        self.resets += len(rows)
        self.begun(rows, before)
