"""An environment that shows its behavior some steps after a reset: for ``env.factory=late_env:make``."""

from __future__ import annotations

from probes import ObsReward


class Late(ObsReward):
    """Its agents request their first decision three steps after a reset, and are not known before."""

    def reset(self):
        super().reset()
        self.waits = 3

    @property
    def behavior_specs(self):
        return {} if self.waits else super().behavior_specs

    def step(self):
        if self.waits:
            self.waits -= 1
        else:
            super().step()


def make(seed):
    """Return the environment."""
    return Late(seed, teams=4)
