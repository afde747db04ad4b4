"""The scene Walker: `scene` plays it, `drawing` says how it looks."""
