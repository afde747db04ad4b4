"""What mappo-doctor run=FOLDER says of a training run: why does it not learn?"""

from __future__ import annotations

from collections.abc import Sequence

from mappo_unity.cli.examine.findings import Report
from mappo_unity.diagnosis.diagnose import diagnose
from mappo_unity.diagnosis.evidence import Evidence, amount
from mappo_unity.diagnosis.pace import describe_pace
from mappo_unity.errors import ConfigError
from mappo_unity.reports.groups import run_names
from mappo_unity.reports.reading import read_runs

WORD = "run="


def examine_runs(report: Report, words: Sequence[str]) -> None:
    """Report findings about the runs that ``run=FOLDER`` name, or that lie below such a folder.

    Raises:
        ConfigError: a word of another kind stands beside them, or a path leads to no run with metrics.
    """
    others = [word for word in words if not word.startswith(WORD)]
    if others:
        raise ConfigError(
            f"{others[0]} does not go with run=: a run's folder is all that is looked at; without run= the "
            "installation and games are examined"
        )
    paths = [word.removeprefix(WORD) for word in words]
    if "" in paths:
        raise ConfigError("run= names no folder: run=outputs/ENV/DATE")

    runs, notes = read_runs(paths, "run")
    for note in notes:
        report.head(note)
    for run, name in zip(runs, run_names(runs)):
        _examine(report, Evidence.of(run), str(run.folder) if len(runs) == 1 else name)


def _examine(report: Report, evidence: Evidence, name: str) -> None:
    report.head(f"{name}: {amount(evidence.decisions)} of {amount(evidence.number('max_steps'))} decisions")
    if not evidence.survey:
        report.head("  it has no survey.json (an older version trained it): only its metrics are examined")

    found = diagnose(evidence)
    for finding in found:
        report.warn(f"{finding.text}: {finding.evidence}", finding.cure)
    if not found:
        report.good("nothing is found that keeps it from learning")
    if not found and not evidence.is_judged:
        report.head("  it is early: what the return tells is judged after half of max_steps, 20 iterations")
    report.good(describe_pace(evidence))
