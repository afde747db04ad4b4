"""The commands: arguments in, a call, exit codes and printed lines out. The only room that prints.

One module a command, each with ``run(lines) -> exit code`` and ``help_text()``; what is heavy is imported
inside them, so that ``--help`` and mistakes in the options come at once.

Exit codes: 0 done, 1 an error of ours (with its traceback) or a failed job of a sweep, 2 a mistake in the
options, 3 an environment that failed for good (a checkpoint is written first) or a hub out of reach, 4 a run
that ended but most of whose updates were rolled back, 130, 138 and 143 ended by SIGINT, SIGUSR1 and SIGTERM.
"""

from __future__ import annotations

import errno
import importlib
import io
import os
import signal
import sys
from contextlib import suppress

from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.signals import interrupts_wait

_NOT_OURS = (
    *(errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO),
    errno.ENAMETOOLONG,
)
"""What a file system refuses for reasons of its own."""


def train_main(arguments: list[str] | None = None) -> int:
    """Run mappo-train: train, resume or sweep; return the exit code."""
    return _run("train", arguments)


def learn_main(arguments: list[str] | None = None) -> int:
    """Run mappo-learn: train with ML-Agents' configuration and flags; return the exit code."""
    return _run("learn", arguments)


def eval_main(arguments: list[str] | None = None) -> int:
    """Run mappo-eval: play episodes with a trained policy; return the exit code."""
    return _run("eval", arguments)


def play_main(arguments: list[str] | None = None) -> int:
    """Run mappo-play: show a policy in its scene; return the exit code."""
    return _run("play", arguments)


def export_main(arguments: list[str] | None = None) -> int:
    """Run mappo-export: write a trained policy as ONNX files; return the exit code."""
    return _run("export", arguments)


def league_main(arguments: list[str] | None = None) -> int:
    """Run mappo-league: let policies play one another and rate them; return the exit code."""
    return _run("league", arguments)


def plot_main(arguments: list[str] | None = None) -> int:
    """Run mappo-plot: draw curves of runs as a picture; return the exit code."""
    return _run("plot", arguments)


def report_main(arguments: list[str] | None = None) -> int:
    """Run mappo-report: write a page of HTML about runs; return the exit code."""
    return _run("report", arguments)


def hub_main(arguments: list[str] | None = None) -> int:
    """Run mappo-hub: bring policies to the Hugging Face hub, and from there; return the exit code."""
    return _run("hub", arguments)


def search_main(arguments: list[str] | None = None) -> int:
    """Run mappo-search: look for good options; return the exit code."""
    return _run("search", arguments)


def player_main(arguments: list[str] | None = None) -> int:
    """Run mappo-player: serve a scene as a Unity player; return the exit code."""
    return _run("player", arguments)


def doctor_main(arguments: list[str] | None = None) -> int:
    """Run mappo-doctor: look for what keeps a player or an environment from working; return the exit code."""
    return _run("doctor", arguments)


def _run(command: str, arguments: list[str] | None) -> int:
    """Run a command; turn what it raises into lines and exit codes."""
    name = f"mappo-{command}"
    lines = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, io.TextIOWrapper):  # a path in letters that a terminal lacks must end no run
        sys.stdout.reconfigure(errors="backslashreplace")

    try:
        code = _answer(command, name, lines)
        if sys.stdout is not None:  # closed by `>&-`
            sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has gone, as in `mappo-eval ... | head -1`
        _drop_output()
        return 141

    # what a user can mend, and what only the environment can
    except ConfigError as error:
        print(f"{name}: {error}", *error.details, sep="\n", file=sys.stderr)
        return 2
    except EnvironmentFailure as error:
        print(f"{name}: {error}", *error.details, sep="\n", file=sys.stderr)
        return 3

    except KeyboardInterrupt as error:
        if arguments is None:  # a second Ctrl-C would only find Python taking itself down
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print(f"{name}: interrupted", file=sys.stderr)
        return 128 + int(getattr(error, "signal", 2))
    except OSError as error:  # what nobody below knew the option of
        if error.errno not in _NOT_OURS:
            raise
        _drop_output()
        print(f"{name}: {error.filename or 'its output'}: {error.strerror}", file=sys.stderr)
        return 2


def _answer(command: str, name: str, lines: list[str]) -> int:
    own = lines
    if command == "learn":
        from mappo_unity.config.mlagents.flags import before_env_args

        own = before_env_args(lines)

    if any(line in ("--help", "-h") for line in own):
        print(importlib.import_module(f"{__name__}.{command}").help_text())
        return 0

    if "--version" in own:
        from mappo_unity import __version__

        print(f"{name} {__version__}")
        return 0

    if lines[:1] == ["--completion"]:
        from mappo_unity.cli.completion import completion_script

        print(completion_script(" ".join(lines[1:])), end="")
        return 0

    # a Ctrl-C that breaks an import off would end in a traceback of a half loaded module
    with interrupts_wait():
        module = importlib.import_module(f"{__name__}.{command}")
    return module.run(lines)


def _drop_output() -> None:
    """Let what is still to be written to standard output go nowhere, also when Python ends."""
    with suppress(OSError, ValueError, AttributeError):  # None where it was closed by `>&-`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
