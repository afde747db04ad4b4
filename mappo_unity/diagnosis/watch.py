"""Findings while a run trains: its batches surveyed, and each finding said once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from mlagents_envs.base_env import BehaviorSpec
from tensordict import TensorDictBase

from mappo_unity.diagnosis.diagnose import diagnose
from mappo_unity.diagnosis.evidence import Evidence
from mappo_unity.diagnosis.survey import Survey
from mappo_unity.envs.rounds import Episode
from mappo_unity.errors import ConfigError
from mappo_unity.reports.reading import read_run


class Watch:
    """Survey a run's batches, and say what keeps it from learning.

    Args:
        folder: the run's.
        specs: of each behavior.
        sides: behaviors of each policy name.
    """

    def __init__(
        self, folder: Path, specs: Mapping[str, BehaviorSpec], sides: Mapping[str, Sequence[str]]
    ) -> None:
        self._folder = folder
        self._survey = Survey(specs, sides)
        self._is_due = False
        self._said: set[str] = set()

    def add(self, rounds: TensorDictBase, episodes: Mapping[str, Sequence[Episode]]) -> None:
        """Take a batch in, as `Survey.add` does."""
        self._is_due = self._survey.add(rounds, episodes)

    def news(self) -> list[str]:
        """Return a line about each finding that was not said yet, after the 1st, 2nd, 4th, 8th ... batch.

        The batch's metrics must have been written.
        """
        if not self._is_due:
            return []

        lines = []
        self.write()
        # a run is not ended by what looks at it: a folder that cannot be read has its own message
        with suppress(ConfigError):
            for finding in diagnose(Evidence.of(read_run(self._folder))):
                if finding.text not in self._said:
                    self._said.add(finding.text)
                    lines.append(f"look: {finding.text} ({finding.evidence}); {finding.cure}")
        return lines

    def write(self) -> None:
        """Write the survey into the run's folder; a full disk costs it, not the run."""
        with suppress(OSError):
            self._survey.write(self._folder)
