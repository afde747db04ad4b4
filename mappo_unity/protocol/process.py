"""Players as processes: find the executable, start it, end it, and leave none behind.

A player must not outlive its trainer, however that ends. On Linux the kernel kills it with the thread that
started it (prctl PR_SET_PDEATHSIG), so one thread that lives as long as the process starts them all; on other
systems a player leaves when its connection breaks.
"""

from __future__ import annotations

import errno
import glob
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

from mappo_unity.config.overrides import shell_word
from mappo_unity.errors import ConfigError
from mappo_unity.protocol.player_failures import PlayerFailure

_EXTENSIONS = (".app", ".exe", ".x86_64", ".x86")  # of all systems' players

_DIE_WITH_PARENT = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
if os.getppid() != int(sys.argv[1]):
    os._exit(1)
try:
    os.execv(sys.argv[2], sys.argv[2:])
except OSError as error:
    sys.exit(f"{sys.argv[2]} cannot be executed: {error.strerror}")
"""
LAST_LINES, LAST_BYTES, LINE_LENGTH = 3, 4096, 200
"""How much of what a failed player printed is quoted: lines, read from the last bytes; characters a line."""

_PROGRAMS = {
    b"\x7fELF": "Linux",
    b"MZ": "Windows",
    b"\xcf\xfa\xed\xfe": "macOS",
    b"\xca\xfe\xba\xbe": "macOS",
}
"""How programs begin, and the systems that they are built for."""


def find_executable(file_name: str, option: str = "env.file_name") -> Path:
    """Return the executable that `file_name` (with or without its extension) means on this system.

    Raises:
        ConfigError: there is none, it may not be executed, or this system cannot run it; says what is there.
    """
    from mlagents_envs.env_utils import validate_environment_path

    if not file_name.strip():
        raise ConfigError(f"{option}= is empty: give the path of the built player")

    path = Path(os.path.expanduser(file_name))
    # before ML-Agents looks: to it a broken link is just a missing file
    _check_link(path, f"{option}={file_name}")

    # The exact name first: ML-Agents takes extensions out of a path wherever they stand. It takes a name
    # for a pattern, too; where that finds nothing, its brackets are letters.
    matched = (
        _exactly(path)
        or validate_environment_path(str(path))
        or validate_environment_path(glob.escape(str(path)))
    )
    place = Path(matched or path)
    if not place.is_file():
        kinds = {"darwin": ".app", "win32": ".exe"}.get(sys.platform, ".x86_64, .x86, or no extension")
        raise ConfigError(
            f"{option}={file_name}: no Unity player is there; looked for {path.absolute()} with "
            f"{kinds}; give the path of the built player{_inside(path) or _beside(path)}"
        )

    found = place.absolute()
    if not os.access(found, os.X_OK):
        raise ConfigError(
            f"{option}={file_name}: {found} is not executable; run: chmod +x {shell_word(found)}"
        )

    reason = _why_not_run(found)
    if reason is not None:
        raise ConfigError(f"{option}={file_name}: {found} cannot be run on this system: {reason}")

    return found


def _exactly(path: Path) -> str | None:
    """Return the file that a path names, as it is or with this system's extension; None if there is none.

    A name with another system's extension means the build for this one, which may lie beside that.
    """
    extensions = {"darwin": (".app",), "win32": (".exe",)}.get(sys.platform, (".x86_64", ".x86"))
    if path.suffix in _EXTENSIONS and path.suffix not in extensions:
        return None
    names = [f"{path}{extension}" for extension in ("", *extensions)]
    return next(filter(os.path.isfile, names), None)


def _check_link(path: Path, what: str) -> None:
    """Raise ConfigError if a path cannot be followed; one that does not exist may lack its extension."""
    try:
        path.stat()
    except FileNotFoundError as error:
        if path.is_symlink():
            target = os.readlink(path)
            raise ConfigError(f"{what} is a symbolic link to {target}, which does not exist") from error
    except NotADirectoryError:
        pass  # nothing is there, which is told with what lies beside it
    except OSError as error:
        circle = "it is a symbolic link that leads in a circle"
        reason = circle if error.errno == errno.ELOOP else error.strerror
        raise ConfigError(f"{what} cannot be opened: {reason}") from error


def _why_not_run(path: Path) -> str | None:
    """Say why a file is no program for this system, as far as its beginning tells; None if it may be one."""
    if os.name == "nt":
        return None

    with path.open("rb") as file:
        begin = file.read(256)
    if not begin:
        return "it is empty; build or copy the player again"

    if begin.startswith(b"#!"):
        # Only spaces and tabs go: a carriage return belongs to the name, as the kernel reads it.
        interpreter = begin[2:].split(b"\n")[0].decode(errors="replace").strip(" \t")
        if os.path.exists(interpreter.split(" ")[0]):
            return None
        return f"it is a script for {interpreter!r}, which is not there"

    for magic, system in _PROGRAMS.items():
        if begin.startswith(magic):
            home = {"Linux": "linux", "macOS": "darwin"}.get(system, "win32")
            return None if sys.platform == home else f"it is built for {system}; build one for this system"

    if b"\0" in begin:
        return None  # perhaps a format that was registered here

    return "it is a text without a first line such as #!/bin/sh; give the player itself"


class PlayerProcess:
    """A running player, in a session of its own.

    `output`: the file for what it prints.

    Raises:
        PlayerFailure: the system cannot start it, or its output cannot be written.
    """

    def __init__(self, executable: Path, arguments: list[str], output: Path) -> None:
        self.executable, self.output = executable, output

        command = [str(executable), *arguments]
        # A small program asks the kernel to die with this process, then becomes the player.
        if sys.platform.startswith("linux"):
            command = [sys.executable, "-S", "-E", "-c", _DIE_WITH_PARENT, str(os.getpid()), *command]

        # Not only a mistake in the options: at a restart the executable may be in the middle of a new build.
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            self._process = _starter(os.getpid()).submit(_start, command, output).result()
        except OSError as error:
            raise PlayerFailure(f"player {executable.name} did not start: {error}") from error

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def ended(self) -> str | None:
        """Say how the process ended; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        if code >= 0:
            return f"exit code {code}"

        # subprocess gives a signal as its negative number.
        try:
            return f"killed by {signal.Signals(-code).name}"
        except ValueError:
            return f"killed by signal {-code}"

    def traces(self, log_file: Path) -> str:
        """Say what there is to read about this player: its log, else the end of what it printed."""
        if log_file.is_file() and log_file.stat().st_size > 0:
            return f"its log: {log_file}"

        end = _end_of(self.output)
        return (
            f"it wrote no log, but printed ({self.output}): {end}" if end else "it printed and logged nothing"
        )

    def wait(self, timeout_s: float) -> bool:
        """Wait for its end; tell whether it came in time."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """End it at once, with every process that it started."""
        try:
            # a player leads its own session, so its group is all that it started
            if hasattr(os, "killpg"):
                os.killpg(self.pid, signal.SIGKILL)
            else:
                self._process.kill()
        except (ProcessLookupError, PermissionError):
            pass  # it has ended

        # Takes its exit code, so that no zombie stays.
        self._process.wait()


@cache
def _starter(pid: int) -> ThreadPoolExecutor:
    """Return the one thread of this process that starts players."""
    # Kept by pid: in a child that was forked the parent's thread does not run.
    return ThreadPoolExecutor(1, "player-starter")


def _start(command: list[str], output: Path) -> subprocess.Popen:
    with output.open("wb") as file:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C is the trainer's business
        )


def _end_of(path: Path) -> str:
    """Return the last lines of a file as one, without control characters; "" if there are none."""
    if not path.is_file():
        return ""

    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - LAST_BYTES))
        text = file.read().decode(errors="replace")

    lines = ["".join(filter(str.isprintable, line)).strip()[:LINE_LENGTH] for line in text.splitlines()]
    return " | ".join([line for line in lines if line][-LAST_LINES:])


def _inside(path: Path) -> str:
    """Say that a path is a folder, and which players it holds; "" if it is none."""
    if not path.is_dir():
        return ""
    names = [entry.name for entry in path.glob("*") if entry.suffix in (".x86_64", ".x86", ".app", ".exe")]
    return f" ({path} is a folder; players in it: {', '.join(sorted(names)) or 'none'})"


def _beside(path: Path) -> str:
    """Name what lies in the folder of a path that does not exist."""
    folder = path.absolute().parent
    if not folder.is_dir():
        return f" (there is no folder {folder})"
    if not os.access(folder, os.R_OK | os.X_OK):
        return f" (the folder {folder} may not be read)"

    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    return f" ({folder} holds {', '.join(names[:10]) or 'nothing'}{', ...' if len(names) > 10 else ''})"
