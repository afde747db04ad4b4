"""What the players of a league are called in tables and pictures: short, and each by a name of its own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import PurePath

from mappo_unity.policies.policy_files import RANDOM, ZOO


def short_names(words: Sequence[str]) -> list[str]:
    """Return of each player's path the last parts, as many as tell it from the others, and from random.

    Args:
        words: the players as the user named them, no two the same.
    """
    paths = {word: _parts(word) for word in [*words, RANDOM]}
    return [_tail(paths[word], [path for other, path in paths.items() if other != word]) for word in words]


def _parts(word: str) -> tuple[str, ...]:
    path = os.path.normpath(word)
    if path != word and path in (RANDOM, ZOO):  # a folder of one's own, ./zoo
        path = os.path.abspath(path)
    return PurePath(path).parts


def _tail(path: tuple[str, ...], others: Sequence[tuple[str, ...]]) -> str:
    lengths = range(1, len(path) + 1)
    alone = (length for length in lengths if all(path[-length:] != other[-length:] for other in others))
    return PurePath(*path[-next(alone, len(path)) :]).as_posix()
