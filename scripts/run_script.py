"""How the scripts of this folder take counts and names, and end: a mistake is one line and exit code 2."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

from mappo_unity.errors import ConfigError, EnvironmentFailure


def run_script(main: Callable[[], int | None]) -> NoReturn:
    """Run `main`, then exit with the code that it returns (None: 0), or with one for what it raises.

    As the package's commands do: 2 after a ConfigError, 3 after an EnvironmentFailure, 130 after Ctrl-C. A
    command that `main` runs has said itself why it failed, and its code is passed on.
    """
    name = Path(sys.argv[0]).name
    try:
        sys.exit(main())
    except (ConfigError, EnvironmentFailure) as error:
        print(f"{name}: {error}", *error.details, sep="\n", file=sys.stderr)
        sys.exit(2 if isinstance(error, ConfigError) else 3)
    except subprocess.CalledProcessError as error:
        print(error.stderr or "", end="", file=sys.stderr)  # where it was caught, nobody has read it yet
        print(f"{name}: {Path(error.cmd[0]).name} ended with exit code {error.returncode}", file=sys.stderr)
        sys.exit(max(error.returncode, 1))
    except KeyboardInterrupt:
        print(f"{name}: interrupted", file=sys.stderr)
        sys.exit(130)


def positive(word: str) -> int:
    """Return the count that a word is, as a type of argparse's; raises ArgumentTypeError."""
    with suppress(ValueError):
        if (count := int(word)) >= 1:
            return count
    raise argparse.ArgumentTypeError(f"{word} must be a whole number of at least 1")


def check_names(names: Iterable[str], known: Collection[str], what: str) -> None:
    """Raise ConfigError unless all `names` are known ones of a kind, which the message calls `what`."""
    for name in names:
        if name not in known:
            raise ConfigError(f"{name}: there is no such {what}; there are {', '.join(filter(None, known))}")
