"""The scene Basic: `scene` plays it, `drawing` says how it looks."""
