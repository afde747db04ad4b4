"""The old place of mappo-player: player folders built before the rooms start it as ``-m mappo_unity.player``."""

from mappo_unity.cli import player_main

if __name__ == "__main__":
    raise SystemExit(player_main())
