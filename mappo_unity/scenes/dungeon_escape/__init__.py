"""The scene DungeonEscape: `scene` plays it, `drawing` says how it looks."""
