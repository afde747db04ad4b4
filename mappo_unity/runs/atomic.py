"""Write a file so that readers, after a crash too, see the old or the new content, whole."""

from __future__ import annotations

import os
from pathlib import Path


def write_atomically(path: Path, data: bytes) -> None:
    """Replace a file's content: temporary file beside it, fsync, rename.

    Raises OSError (a full disk, say) with the old content untouched and no temporary file left.
    """
    # Hidden, and no suffix of the target's: nobody who looks for such files may take it for one.
    temporary = path.with_name(f".{path.stem[:40]}.{os.getpid()}.part")

    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
