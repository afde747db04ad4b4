#!/usr/bin/env python
"""Write the golden runs: the metrics that a refactoring must reproduce (tests/test_golden.py).

    python scripts/write_golden.py              # all of them
    python scripts/write_golden.py 3DBall       # one

Only for a change that is meant to change training; say in the commit what and why.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import golden_runs
from run_script import check_names, run_script


def main() -> None:
    """Write the runs that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", metavar="RUN")
    every = [*golden_runs.RUNS, "resume"]
    names = parser.parse_args().runs or every
    check_names(names, every, "run")
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            print(golden_runs.write(name, Path(folder) / "run"))


if __name__ == "__main__":
    run_script(main)
