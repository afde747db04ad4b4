"""mappo-play: show a policy in its scene, in a window or as a video."""

from __future__ import annotations

from mappo_unity.config.schema import PlayConfig
from mappo_unity.signals import interrupts_end


def help_text() -> str:
    """Return the text of --help."""
    from mappo_unity.cli.help import play_help

    return play_help(PlayConfig)


def run(lines: list[str]) -> int:
    """Show the policy; return the exit code."""
    with interrupts_end("mappo-play"):
        from mappo_unity.config.compose import compose_plain
        from mappo_unity.policies.first_checks import check_film
        from mappo_unity.viewing.screens import check_screen

        options = compose_plain(lines, PlayConfig)
        check_screen(options)
        check_film(options)

        # what is heavy comes only now: mistakes in the options are told at once
        from mappo_unity.cli.summaries import play_line
        from mappo_unity.viewing.play import play

    print(play_line(play(options)))
    return 0
