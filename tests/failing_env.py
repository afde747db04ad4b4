"""An environment of a user's own that fails at a step of choice: for ``env.factory=failing_env:make``."""

from __future__ import annotations

import os
import signal
import sys
import time

import numpy as np
from probes import ObsReward


class Failing(ObsReward):
    """Sixteen agents that decide every step; at step `at`, `how` happens, at the next one again."""

    def __init__(self, seed, how, at, marker=None):
        super().__init__(seed, teams=16)
        self.how, self.at, self.steps, self.marker = how, at, 0, marker

    def step(self):
        super().step()
        self.steps += 1
        if self.steps >= self.at and not (self.marker and os.path.exists(self.marker)):
            getattr(self, self.how)()

    def raises(self):
        raise ValueError("the game broke")

    def leaves(self):
        sys.exit(7)

    def runs_out_of_memory(self):
        raise MemoryError

    def sends_nan(self):
        self.result[0].obs[0][3] = np.nan

    def is_our_bug(self):
        assert self.steps < 0, "not the user's"

    def is_terminated(self):
        """A signal comes, and from then on every step is slow."""
        if self.steps == self.at:
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.05)


def make(seed, how="raises", at=70, marker=None):
    """Return the environment; while a file `marker` exists it does not fail."""
    return Failing(seed, how, at, marker)
