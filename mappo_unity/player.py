"""The old place of mappo-player, which older player folders start as ``-m mappo_unity.player``."""

from mappo_unity.cli import player_main

if __name__ == "__main__":
    raise SystemExit(player_main())
