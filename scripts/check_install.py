"""Install the project with plain `pip install .` on one Python after the other, train, and print the times.

    python scripts/check_install.py python3.10 python3.11 python3.12 python3.13

Each gets a virtual environment of its own, with the pip that this Python brings, which is removed afterwards.
Without torch's CPU wheels at hand an installation downloads several GB. `--resolve` only asks pip what it
would install, which is enough to see whether its resolver comes to an end. Exit code 1 if anything failed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from run_script import run_script

ROOT = Path(__file__).resolve().parents[1]
RUN = ("env=Basic", "max_steps=4000")
HEAD = ("Python", "pip", "install s", "train s", "torch", "result")


@dataclass
class Row:
    """What came of one Python; times in s."""

    python: str
    pip: str = "-"
    install_s: float | None = None
    train_s: float | None = None
    torch: str = "-"
    result: str = "ok"

    def cells(self) -> tuple[str, ...]:
        """Return the row as texts."""
        times = ("-" if s is None else f"{s:.0f}" for s in (self.install_s, self.train_s))
        return (self.python, self.pip, *times, self.torch, self.result)


def check(python: str, timeout_s: float, resolve: bool) -> Row:
    """Install and train with one interpreter."""
    row = Row(python)
    with tempfile.TemporaryDirectory(prefix="mappo-install-") as folder:
        try:
            own = Path(folder) / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
            timed([python, "-m", "venv", str(own.parent)], timeout_s, folder)
            row.python = says(own, "import platform; print(platform.python_version())")
            row.pip = says(own, "import pip; print(pip.__version__)")
            command = [str(own / "python"), "-m", "pip", "install", "--quiet", str(ROOT)]
            row.install_s = timed([*command, "--dry-run"] if resolve else command, timeout_s, folder)
            if not resolve:
                row.torch = says(own, "import torch; print(torch.__version__)")
                row.train_s = timed([str(own / "mappo-train"), *RUN], timeout_s, folder)
        except subprocess.TimeoutExpired as error:
            row.result = f"no end after {error.timeout:.0f} s: {Path(error.cmd[0]).name}"
        except (subprocess.CalledProcessError, OSError) as error:
            output = getattr(error, "stderr", None) or str(error)
            row.result = f"failed: {output.strip().splitlines()[-1]}"
    return row


def timed(command: list[str], timeout_s: float, folder: str) -> float:
    """Run a command in a folder; return how long it took."""
    start_s = time.monotonic()
    subprocess.run(command, check=True, timeout=timeout_s, cwd=folder, capture_output=True, text=True)
    return time.monotonic() - start_s


def says(own: Path, code: str) -> str:
    """Return what a line of Python prints in the environment."""
    done = subprocess.run([str(own / "python"), "-c", code], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def main() -> int:
    """Print a line when each Python is done, and the table at the end."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "pythons", nargs="*", default=[sys.executable], help="interpreters; default: this one"
    )
    parser.add_argument("--timeout", type=float, default=1800, help="seconds for each step (%(default)s)")
    parser.add_argument("--resolve", action="store_true", help="only resolve, install and train nothing")
    options = parser.parse_args()

    rows = []
    for python in options.pythons:
        rows.append(check(python, options.timeout, options.resolve))
        print(" ".join(rows[-1].cells()), file=sys.stderr, flush=True)

    print(f"| {' | '.join(HEAD)} |", "|---" * len(HEAD) + "|", sep="\n")
    for row in rows:
        print(f"| {' | '.join(row.cells())} |")
    return int(any(row.result != "ok" for row in rows))


if __name__ == "__main__":
    run_script(main)
