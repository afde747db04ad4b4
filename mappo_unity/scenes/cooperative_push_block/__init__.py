"""The scene CooperativePushBlock: `scene` plays it, `drawing` says how it looks."""
