"""mappo-player: serve a scene as if it were a built Unity player, or build one."""

from __future__ import annotations

from mappo_unity.cli.players import options as player_options
from mappo_unity.signals import interrupts_end


def help_text() -> str:
    """Return the text of --help."""
    return player_options.help_text()


def run(lines: list[str]) -> int:
    """Serve or build; return the exit code: 0 when the trainer closed, 1 after an error."""
    with interrupts_end("mappo-player"):
        from mappo_unity import __version__
        from mappo_unity.cli.players.build import build
        from mappo_unity.cli.players.log import PlayerLog
        from mappo_unity.protocol import messages
        from mappo_unity.protocol.serve import Player, env_function, serve

    known, ignored = player_options.parse(lines)

    if known.scene == "build":
        player_options.check_build(known, ignored)
        make_env = env_function(ignored[0], known.num_areas, known.params)
        make_env(0, None).close()  # it starts with these options
        print(build(ignored[0], ignored[1], ignored[2:], known))
        return 0

    make_env = env_function(known.scene, known.num_areas, known.params)
    port = player_options.EDITOR_PORT if known.port is None else known.port

    with PlayerLog(known.log_file) as log:
        log(f"mappo-player {__version__}: {known.scene}, port {port}, protocol {messages.API_VERSION}")
        if ignored:
            log(f"accepted and without effect: {' '.join(ignored)}")

        return serve(Player(make_env, known.scene, log, png=not known.no_png), port, log)
