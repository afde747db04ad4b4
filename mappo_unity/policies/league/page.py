"""A league as one page of HTML, which loads nothing from elsewhere and fits a phone."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from mappo_unity.policies.league.checks import League
from mappo_unity.policies.league.picture import ladder, matrix, svg
from mappo_unity.policies.league.ratings import ANCHOR, expected
from mappo_unity.policies.league.standings import Standings
from mappo_unity.policies.league.table import Result
from mappo_unity.policies.policy_files import RANDOM
from mappo_unity.reports.document import document, table


def page(league: League, standings: Standings) -> str:
    """Return the page: ladder, table of players, matrix, table of pairs."""
    title = f"League in {league.env.name}"
    way = "the most likely actions" if league.deterministic else "sampled actions"
    facts = (
        f"{len(standings.rows)} policies, {league.matches} matches of each pair, both sides in turn, {way}, "
    )
    facts += f"seed {league.seed}."
    anchor = RANDOM if RANDOM in standings.names else "the mean of all"

    parts = [
        f"<h1>{escape(title)}</h1><p>{facts}</p>",
        f"<h2>Ratings</h2><div class='wide'>{svg(standings, *ladder(standings))}</div>",
        _players(standings),
        f"<p>Bradley-Terry ratings on the Elo scale with 95 % intervals; {anchor} is {ANCHOR:.0f}. A lead of "
        f"200 points means {100 * expected(200, 0):.0f} % of the points, one of 400 "
        f"{100 * expected(400, 0):.0f} %. A draw is half a win.</p>",
        f"<h2>Who beat whom</h2><div class='wide'>{svg(standings, *matrix(standings))}</div>",
        f"<h2>Pairs</h2>{_pairs(standings)}",
        "<p>Expected: the share of the points that the ratings alone would give. Far from what was won, the "
        "two suit each other in a way that one number a player cannot say.</p>",
        f"<h2>Sides</h2>{_sides(standings.results)}",
    ]
    return document(title, parts)


def _players(standings: Standings) -> str:
    rows = [
        [row.name, f"{row.rating:.0f}", f"{row.low:.0f} to {row.high:.0f}", row.won, row.drawn, row.lost]
        for row in standings.rows
    ]
    return table(["name", "rating", "95 %", "won", "drawn", "lost"], rows, 1)


def _pairs(standings: Standings) -> str:
    rows = []
    for first, one in enumerate(standings.rows):
        for second in range(first + 1, len(standings.rows)):
            other = standings.rows[second]
            shares = (standings.share(first, second), expected(one.rating, other.rating))
            numbers = standings.outcomes[first, second].tolist()
            rows.append([one.name, other.name, *numbers, *(f"{100 * share:.0f} %" for share in shares)])
    return table(["policy", "opponent", "won", "drawn", "lost", "points", "expected"], rows, 2)


def _sides(results: Iterable[Result]) -> str:
    rows = []
    for row in results:
        length = row.decisions / max(1, row.won + row.drawn + row.lost)
        rows.append([row.policy, row.opponent, row.side, row.won, row.drawn, row.lost, f"{length:.0f}"])
    return table(["policy", "opponent", "as", "won", "drawn", "lost", "decisions"], rows, 3)
