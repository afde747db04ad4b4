#!/usr/bin/env python3
"""Count how many of the faults of tests/faulty_env.py mappo-doctor finds, and what it says of healthy runs.

    python scripts/score_doctor.py [FAULT ...]
    python scripts/score_doctor.py --runs RUN ...       # healthy runs: anything found is a false alarm

Every fault is trained for some ten thousand decisions. A fault counts as found if a finding of its own kind
is among those said.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
from pathlib import Path

from run_script import check_names, run_script

TESTS = Path(__file__).resolve().parents[1] / "tests"
sys.path.insert(0, str(TESTS))
faulty_env = importlib.import_module("faulty_env")
doctor_score = importlib.import_module("doctor_score")


def main() -> None:
    """Train the faults that are named, or all of them, and print what was found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("faults", nargs="*")
    parser.add_argument("--runs", type=Path, nargs="+", default=[])
    arguments = parser.parse_args()

    if arguments.runs:
        alarms = sum(bool(findings(run)) for run in arguments.runs)
        print(f"{alarms} of {len(arguments.runs)} healthy runs with a finding")
        return

    wanted = {"": ""} | faulty_env.IN_THE_GAME
    wanted |= {fault: kind for fault, (kind, _) in faulty_env.IN_THE_OPTIONS.items()}
    names = arguments.faults or list(wanted)
    check_names(names, wanted, "fault")

    found = 0
    os.chdir(TESTS)  # env.factory is looked for there
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            kinds = train(Path(folder) / (name or "sound"), name)
            outcome = "found" if wanted[name] in kinds else "MISSED"
            found += bool(name) and outcome == "found"
            print(f"  -> {name}: {outcome}" if name else f"  -> no fault: {len(kinds)} findings", flush=True)
    print(f"{found} of {len(names) - ('' in names)} faults found")


def train(folder: Path, fault: str) -> list[str]:
    """Train a fault; return the kinds of what is found."""
    from mappo_unity.cli import train_main

    train_main([*doctor_score.lines_of(fault), f"hydra.run.dir={folder}"])
    return findings(folder)


def findings(folder: Path) -> list[str]:
    """Print what is found in a run; return its kinds."""
    from mappo_unity.diagnosis.diagnose import diagnose
    from mappo_unity.diagnosis.evidence import Evidence
    from mappo_unity.reports.reading import read_run

    found = diagnose(Evidence.of(read_run(folder)))
    for finding in found:
        print(f"{folder.name}: [{finding.kind}] {finding.text} ({finding.evidence}); {finding.cure}")
    return [finding.kind for finding in found]


if __name__ == "__main__":
    run_script(main)
