"""The files that show a league: ``league.csv``, ``league.svg`` and ``league.html``.

They hold no date and no path: the same league gives the same files.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from mappo_unity.errors import ConfigError
from mappo_unity.policies.league.checks import League
from mappo_unity.policies.league.page import page
from mappo_unity.policies.league.picture import picture
from mappo_unity.policies.league.standings import Row, Standings, standings_of
from mappo_unity.policies.league.table import Pair, Result, pairs_of, write_csv
from mappo_unity.runs.atomic import write_atomically

TABLE, PICTURE, PAGE = "league.csv", "league.svg", "league.html"


def write_report(league: League, results: dict[Pair, list[Result]]) -> tuple[Standings, list[Path]]:
    """Rate the players and write the files; return both.

    Raises:
        ConfigError: the folder cannot be written.
    """
    # a league that went on has its newest pairs last
    standings = standings_of(league.names, {pair: results[pair] for pair in pairs_of(league.names)})
    table, image, html = files = [league.folder / name for name in (TABLE, PICTURE, PAGE)]
    columns = [item.name for item in fields(Row)]

    try:
        write_csv(table, columns, [[getattr(row, name) for name in columns] for row in standings.rows])
        write_atomically(image, picture(standings).encode())
        write_atomically(html, page(league, standings).encode())
    except OSError as error:
        raise ConfigError(f"out={league.folder} cannot be written ({error.strerror or error})") from error
    return standings, files
