"""The training loop and what surrounds it.

In: a checked `Config`, a run folder. Out: checkpoints, metrics, an `Outcome`.
"""
