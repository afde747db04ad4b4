"""Networks and PPO.

In: batches, options. Out: better networks, metrics. Knows no environment, file or process.
"""
