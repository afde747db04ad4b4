"""The scene WallJump: `scene` plays it, `drawing` says how it looks."""
