"""The Hugging Face hub: policies go there, and come from there.

The token is the hub's own affair (HF_TOKEN, or `hf auth login`): it is no option, and nothing here shows it.
What the hub's client raises becomes a ConfigError, or an EnvironmentFailure where the network is at fault.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mappo_unity.config.extras import install_command
from mappo_unity.config.overrides import shell_argument
from mappo_unity.errors import ConfigError, EnvironmentFailure
from mappo_unity.policies.policy_files import SUFFIX

README = "README.md"
FILMS = (".mp4", ".gif")
_NAME = re.compile(r"[A-Za-z0-9_](?:[A-Za-z0-9._-]{0,94}[A-Za-z0-9_])?")
_HTTP_PACKAGES = ("httpx", "httpx2", "httpcore", "httpcore2", "requests")
"""Whose network errors the client lets through; which one it uses has changed with its versions."""
_UNAUTHORIZED, _FORBIDDEN = 401, 403
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""What a disk refuses; the client's other errors without a file's name are the network's."""


@dataclass(frozen=True)
class Pushed:
    """An upload that is done."""

    url: str
    files: Sequence[str]


def check_repo(repo: str) -> None:
    """Raise ConfigError if a text cannot be the name of a repository on the hub."""
    parts = repo.split("/")
    fits = len(parts) == 2 and all(_NAME.fullmatch(part) for part in parts)
    if not fits or "--" in repo or ".." in repo or repo.endswith(".git"):
        raise ConfigError(
            f"repo={repo} is no name of a repository: it is user/name, each of letters, digits, '.', '_' and "
            "'-', without '--' and '..', neither beginning nor ending with '.' or '-', nor ending in .git"
        )


def import_hub() -> Any:
    """Return the package huggingface_hub; raise ConfigError, which names the extra, where it is missing."""
    try:
        import huggingface_hub.errors
        import huggingface_hub.utils  # its submodules are attributes only once they are imported
    except ImportError as error:
        raise ConfigError(
            f"the package huggingface_hub is needed for the hub, but cannot be imported ({error}): "
            f"{install_command('hub')}"
        ) from error

    huggingface_hub.utils.disable_progress_bars()
    return huggingface_hub


def check_login() -> None:
    """Raise ConfigError if there is no token to upload with."""
    if import_hub().get_token() is None:
        raise ConfigError(
            "nobody is logged in to the hub: set HF_TOKEN to a token that may write, or run `hf auth login`"
        )


def push(files: Mapping[str, Path | bytes], repo: str, private: bool, message: str) -> Pushed:
    """Upload files in one commit; the repository is made if it is not there.

    Args:
        files: by their names in the repository.

    Raises:
        ConfigError: not logged in, no permission, or refused, as a README.md with wrong front matter is.
        EnvironmentFailure: the hub cannot be reached.
    """
    hub = import_hub()
    check_login()
    _check_readme(files.get(README))

    api = hub.HfApi()
    additions = [hub.CommitOperationAdd(name, content) for name, content in files.items()]
    with _told(hub, repo):
        api.create_repo(repo, private=private, exist_ok=True)
        try:
            done = api.create_commit(repo, additions, commit_message=message)
        except ValueError as error:  # the client's, of what the hub says of the front matter
            raise ConfigError(f"the hub refused repo={repo}: {' '.join(str(error).split())}") from error
    return Pushed(str(done.commit_url), list(files))


def _check_readme(readme: Path | bytes | None) -> None:
    """Raise ConfigError if the hub could not read a README.md, before a repository is made for it."""
    if not isinstance(readme, Path):  # text of ours, or none
        return
    try:
        readme.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{readme} is no UTF-8 text (byte {error.start}), and the hub takes no other: save it as UTF-8"
        ) from error


def pull(repo: str, out: Path, revision: str | None) -> list[Path]:
    """Download a repository's ONNX files, card and films into a new or empty folder, all or none.

    Raises:
        ConfigError: no such repository or revision, no policy in it, or a folder that is not empty.
        EnvironmentFailure: the hub cannot be reached.
    """
    check_empty(out)
    hub = import_hub()
    api = hub.HfApi()

    with _told(hub, repo, revision):
        info = api.model_info(repo, revision=revision)
        names = [file.rfilename for file in info.siblings or []]
        # What lies in folders is no policy of ours, and no name leads out of the folder.
        flat = [name for name in names if Path(name).name == name and "\\" not in name]
        wanted = [name for name in flat if name.endswith((SUFFIX, *FILMS)) or name == README]
        if not any(name.endswith(SUFFIX) for name in wanted):
            raise ConfigError(f"repo={repo} holds no policy: no *{SUFFIX} among its {len(names)} files")
        # The commit that was looked at, whatever is pushed meanwhile.
        cached = [api.hf_hub_download(repo, name, revision=info.sha) for name in wanted]

    return _place(dict(zip(wanted, map(Path, cached))), out)


def check_empty(out: Path) -> None:
    """Raise ConfigError if a folder to write is there, and holds something."""
    try:
        taken = out.exists() and (not out.is_dir() or any(out.iterdir()))
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written: {error.strerror or error}") from error
    if taken:
        raise ConfigError(
            f"out={out} is there and not empty, and nothing is overwritten: name another folder, "
            f"{shell_argument('out', f'{out}_new')}"
        )


def _place(files: Mapping[str, Path], out: Path) -> list[Path]:
    """Copy files into a folder beside its place, and move that there."""
    part: Path | None = None
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(prefix=f".{out.name[:40]}.", suffix=".part", dir=out.parent))
        part.chmod(0o755)
        for name, path in files.items():
            shutil.copyfile(path, part / name)
        if out.exists():  # empty, and Windows moves nothing onto it
            out.rmdir()
        os.replace(part, out)
    except OSError as error:
        raise ConfigError(f"out={out} cannot be written: {error.strerror or error}") from error
    finally:
        if part is not None:
            with suppress(OSError):
                shutil.rmtree(part)
    return [out / name for name in files]


@contextmanager
def _told(hub: Any, repo: str, revision: str | None = None) -> Iterator[None]:
    """Turn what the hub's client raises into a line that says what to do."""
    errors = hub.errors
    try:
        yield
    except errors.RevisionNotFoundError as error:
        raise ConfigError(f"revision={revision} is no branch, tag or commit of {repo}") from error
    except errors.GatedRepoError as error:
        raise ConfigError(f"repo={repo} is gated: ask for access on its page on the hub") from error
    except errors.RepositoryNotFoundError as error:
        raise ConfigError(
            f"repo={repo} is not on the hub, or is private and not yours: see its name, and who is logged in "
            "(hf auth whoami)"
        ) from error
    except errors.OfflineModeIsEnabled as error:
        raise EnvironmentFailure("HF_HUB_OFFLINE is set: without it the hub is asked") from error
    except errors.LocalEntryNotFoundError as error:
        raise _unreachable(error) from error
    except Exception as error:
        # A failed upload of a large file comes inside another error.
        inner = error.__cause__ if type(error) is RuntimeError and error.__cause__ else error
        if isinstance(inner, errors.HfHubHTTPError):
            raise _refused(repo, inner) from error
        if isinstance(inner, OSError) and (inner.filename is not None or inner.errno in _DISK):
            place = inner.filename or f"the hub's cache {hub.constants.HF_HUB_CACHE}"
            raise ConfigError(f"{place} cannot be read or written: {inner.strerror}") from error
        if type(inner).__module__.partition(".")[0] in _HTTP_PACKAGES or isinstance(inner, OSError):
            raise _unreachable(inner) from error
        raise


def _refused(repo: str, error: Any) -> Exception:
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status == _UNAUTHORIZED:
        return ConfigError(
            "the hub does not take the token: set HF_TOKEN to another one, or run `hf auth login` again"
        )
    if status == _FORBIDDEN:
        return ConfigError(
            f"repo={repo} may not be written with this token: it needs the right to write, and the user or "
            "organization must be one that it belongs to"
        )
    if status is not None and status < 500:
        return ConfigError(f"the hub refused repo={repo} (HTTP {status})")
    return EnvironmentFailure(f"the hub failed (HTTP {status}): try again later; nothing was changed here")


def _unreachable(error: BaseException) -> EnvironmentFailure:
    return EnvironmentFailure(
        f"the hub at {import_hub().constants.ENDPOINT} cannot be reached ({type(error).__name__}): see the "
        "network, a proxy, and HF_ENDPOINT"
    )
