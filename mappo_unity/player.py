"""mappo-player as ``python -m mappo_unity.player``, the form that the scripts of player folders use."""

from mappo_unity.cli import player_main

if __name__ == "__main__":
    raise SystemExit(player_main())
