"""The scene Hallway: `scene` plays it, `drawing` says how it looks."""
