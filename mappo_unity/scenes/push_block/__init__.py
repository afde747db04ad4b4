"""The scene PushBlock: `scene` plays it, `drawing` says how it looks; its bodies serve others, too."""
