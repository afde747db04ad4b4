"""A run on disk: its folder, lock, checkpoints, metrics and progress.

In: options, metrics, state dicts. Out: files, lines on the terminal. Knows nothing of learning.
"""
