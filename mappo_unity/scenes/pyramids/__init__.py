"""The scene Pyramids: `scene` plays it, `drawing` says how it looks."""
