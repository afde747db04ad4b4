"""Options: their schema, checks, composing and presets.

In: override lines, the files under conf/. Out: a checked `Config`. Imports no torch.
"""
