"""The scene 3DBall: `scene` plays it, `drawing` says how it looks."""
