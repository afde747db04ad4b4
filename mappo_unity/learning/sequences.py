"""Decisions of one agent in a row: what a network with a memory learns on.

A sequence never crosses an end; decisions that the batch before left pending stand before those of this one.
It starts from the state that the memory really had then. What is shorter than `ppo.sequence_length` is padded
at its end, and the padding is masked.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mappo_unity.learning.decisions import DecisionView


@dataclass(frozen=True)
class Sequences:
    """Where the decisions of each sequence stand.

    Attributes:
        rounds: int64 ``[B, L]``, the round of each decision; padding repeats the last one's.
        slots: int64 ``[B]``, whose they are.
        valid: bool ``[B, L]``, False where padded.
    """

    rounds: np.ndarray
    slots: np.ndarray
    valid: np.ndarray


def cut_sequences(view: DecisionView, first: np.ndarray, used: np.ndarray, length: int) -> Sequences:
    """Cut each slot's rows with a value into sequences.

    Args:
        view: of the batch.
        first: bool ``[T, N]``, first decisions of their agents.
        used: bool ``[T, N]``, rows that are learnt from; sequences without any are left out.
        length: decisions in a sequence at most.
    """
    # slot by slot, in the order of time
    slots, rounds = np.nonzero(view.valued.T)
    if not len(slots):
        none = np.zeros((0, 1), np.int64)
        return Sequences(none, none[:, 0], none.astype(bool))

    new = np.ones(len(slots), bool)
    new[1:] = slots[1:] != slots[:-1]
    new[1:] |= view.ends[rounds, slots][:-1] | first[rounds, slots][1:]

    # the place of each decision in its episode's part, then cut every `length`
    index = np.arange(len(slots))
    start = np.maximum.accumulate(np.where(new, index, 0))
    new |= (index - start) % length == 0
    begin = np.flatnonzero(new)
    sizes = np.diff(np.append(begin, len(slots)))

    kept = np.add.reduceat(used[rounds, slots].astype(np.int64), begin) > 0
    begin, sizes = begin[kept], sizes[kept]
    width = int(sizes.max(initial=1))
    steps = np.arange(width)[None]
    at = begin[:, None] + np.minimum(steps, sizes[:, None] - 1)
    return Sequences(rounds[at], slots[begin], steps < sizes[:, None])
