"""All findings about runs."""

from __future__ import annotations

from collections.abc import Sequence

from mappo_unity.diagnosis.evidence import Evidence, Finding
from mappo_unity.diagnosis.inputs import from_inputs
from mappo_unity.diagnosis.learning import from_learning
from mappo_unity.diagnosis.pace import from_pace
from mappo_unity.reports.reading import Run


def diagnose(evidence: Evidence) -> list[Finding]:
    """Return what keeps a run from learning: inputs first, then the update, then what slows it down."""
    return [*from_inputs(evidence), *from_learning(evidence), *from_pace(evidence)]


def records(runs: Sequence[Run], names: Sequence[str]) -> list[dict[str, str]]:
    """Return the findings about several runs as a report's page takes them; of many with the run's name."""
    found = []
    for run, name in zip(runs, names):
        for finding in diagnose(Evidence.of(run)):
            record = finding.as_record()
            if len(runs) > 1:
                record["text"] = f"{name}: {record['text']}"
            found.append(record)
    return found
