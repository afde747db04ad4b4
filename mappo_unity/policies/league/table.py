"""The results of a league: a row for each pair and side, kept in ``matches.csv``.

The file is written whole after every pair: a league that was cut off goes on with the pairs that it lacks.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from mappo_unity.errors import ConfigError
from mappo_unity.runs.atomic import write_atomically

MATCHES = "matches.csv"

Pair = tuple[str, str]


@dataclass(frozen=True)
class Result:
    """What a policy's matches as one side against an opponent came to."""

    policy: str
    opponent: str
    side: str  # the behaviors that the policy played, joined by +
    won: int
    drawn: int
    lost: int
    decisions: int  # of one agent, over all matches


_COLUMNS = [item.name for item in fields(Result)]
_NUMBERS = _COLUMNS[3:]


def pairs_of(names: Sequence[str]) -> list[Pair]:
    """Return all pairs, in the order in which they are played."""
    return [(first, second) for index, first in enumerate(names) for second in names[index + 1 :]]


def read_results(folder: Path) -> dict[Pair, list[Result]]:
    """Return the results of the pairs that have been played.

    Raises:
        ConfigError: the file was changed by somebody else.
    """
    path, results = folder / MATCHES, dict[Pair, list[Result]]()
    if not path.is_file():
        return results

    try:
        with path.open(newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file, strict=True):
                numbers = {name: int(row[name]) for name in _NUMBERS}
                result = Result(row["policy"], row["opponent"], row["side"], **numbers)
                results.setdefault((result.policy, result.opponent), []).append(result)
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise ConfigError(
            f"{path} is no table of results any more ({error}): delete it, and all pairs are played again"
        ) from error
    return results


def write_results(folder: Path, results: dict[Pair, list[Result]], names: Sequence[str]) -> None:
    """Write the results in the order of the pairs, whatever the order in which they came."""
    rows = [result for pair in pairs_of(names) for result in results.get(pair, [])]
    write_csv(folder / MATCHES, _COLUMNS, [[getattr(row, name) for name in _COLUMNS] for row in rows])


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table, whole or not at all."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_atomically(path, text.getvalue().encode())


def outcomes(results: dict[Pair, list[Result]], names: Sequence[str]) -> np.ndarray:
    """Return wins, draws and losses ``[N, N, 3]`` of each player (row) against each other (column)."""
    place, table = (
        {name: index for index, name in enumerate(names)},
        np.zeros((len(names), len(names), 3), int),
    )
    for (first, second), rows in results.items():
        for row in rows:
            table[place[first], place[second]] += [row.won, row.drawn, row.lost]
            table[place[second], place[first]] += [row.lost, row.drawn, row.won]
    return table
