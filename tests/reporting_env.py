"""An environment that reports statistics of itself: for ``env.factory=reporting_env:make``."""

from __future__ import annotations

from probes import ObsReward

METHODS = {"mean": "average", "last": "most_recent", "sum": "sum", "spread": "histogram"}


class Reporting(ObsReward):
    """Four agents; with its steps 1, 2, 3 ... it reports their number, plus `offset`, in every way."""

    def __init__(self, seed, offset=0.0, broken=None):
        super().__init__(seed, teams=4)
        self.offset, self.broken, self.steps, self.reported = offset, broken, 0, {}

    def step(self):
        super().step()
        self.steps += 1
        for name, how in METHODS.items():
            self.reported.setdefault(f"Game/{name}", []).append((self.steps + self.offset, how))

    def pop_statistics(self):
        if self.broken and self.steps:
            return {"raises": lambda: 1 / 0, "text": lambda: {"Goals": "many"}, "list": lambda: [1]}[
                self.broken
            ]()
        out, self.reported = self.reported, {}
        return out


def make(seed, offset=0.0, broken=None):
    """Return the environment; with `broken` what it reports makes no sense."""
    return Reporting(seed, offset, broken)
