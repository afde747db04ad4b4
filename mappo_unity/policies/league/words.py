"""What the players of a league are called in tables and pictures: short, and each by a name of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import PurePath


def short_names(words: Sequence[str], files: Sequence[str]) -> list[str]:
    """Return the words as they were given, without the folders that all the files among them lie in.

    Args:
        words: the players as the user named them, no two the same.
        files: those of them that are paths.
    """
    parts = {word: PurePath(os.path.normpath(word)).parts for word in files}
    # the last part stays in any case
    shared = os.path.commonprefix([path[:-1] for path in parts.values()])
    if shared == ("/",):
        return list(words)
    names = {word: "/".join(path[len(shared) :]) for word, path in parts.items()}

    short = [names.get(word, word) for word in words]
    return short if len(set(short)) == len(short) else list(words)
