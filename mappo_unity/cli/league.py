"""mappo-league: policies play one another, and are rated."""

from __future__ import annotations

from mappo_unity.config.schema import LeagueConfig
from mappo_unity.signals import interrupts_end, termination_as_interrupt


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import league_help

    return league_help(LeagueConfig)


def run(lines: list[str]) -> int:
    """Play the league; print a table and one line of JSON; return the exit code."""
    with interrupts_end("mappo-league"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.config.plain_options import take_parameters, take_words
        from mappo_unity.policies.league.checks import check_league

        env_lines, lines = take_parameters(lines, "env")
        config = compose_plain(take_words(lines, LeagueConfig, "policies"), LeagueConfig)
        league = check_league(config, env_lines)

        # torch comes only now: mistakes in the options are told at once
        from mappo_unity.cli import summaries
        from mappo_unity.policies.league.play import play_league
        from mappo_unity.policies.league.report import write_report
        from mappo_unity.policies.league.table import Result

    def told(pair: tuple[str, str], results: list[Result], done: int, total: int) -> None:
        print(summaries.pair_line(pair, results, done, total), flush=True)

    with termination_as_interrupt():
        standings, files = write_report(league, play_league(league, config.workers, told))

    summaries.console().print(summaries.league_table(standings))
    for path in files:
        print(path)
    print(summaries.json_line(standings.figures()))
    return 0
