"""Why a run does not learn: what its batches held, and the rules that read it beside its metrics.

In: batches while a run trains (`survey`), or its folder afterwards. Out: findings, each with what was seen
and the option that cures it. It changes nothing of a run, and draws no random numbers.
"""
