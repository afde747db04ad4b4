"""A batch of rounds seen as decisions: what followed each one, and whether that has arrived.

An environment is played in rounds, in which not every agent is asked. Learning looks at an agent's own
decisions: the outcome of one is the reward of all rounds up to the agent's next decision or its end, and the
value that stands there. `DecisionView` finds these once for a batch, for all slots side by side; advantages,
memory and other reward signals read it. A decision whose outcome had not arrived when the batch ended is
*pending*: it is carried into the next batch (`learning.carried`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DecisionView:
    """Where each decision leads; all arrays are ``[T, N]`` for T rounds and N slots.

    Attributes:
        valued: bool, rows that have a value: a decision was requested, or the agent departed and a team mate
            was asked.
        known: bool, the rows among them whose outcome has arrived.
        ends: bool, the rows among them after which the episode ended before the slot's next such row.
        last: int64, the last round whose reward belongs to the row (read where valued).
        following: int64, the slot's next row with a value; T is the row after the batch (read where known and
            not ends).
    """

    valued: np.ndarray
    known: np.ndarray
    ends: np.ndarray
    last: np.ndarray
    following: np.ndarray

    @classmethod
    def of(cls, valued: np.ndarray, final_valued: np.ndarray, ended: np.ndarray) -> DecisionView:
        """Build the view.

        Args:
            valued: bool ``[T, N]``.
            final_valued: bool ``[N]``, the same for the row after the last.
            ended: bool ``[T, N]``, slots whose episode ended in the round, for whatever reason.
        """
        rounds = len(valued)
        never = rounds + 1
        index = np.arange(rounds + 1)[:, None]

        # for every row the first end at or after it, and the first row with a value after it
        first_end = np.minimum.accumulate(np.where(ended, index[:-1], never)[::-1])[::-1]
        all_valued = np.concatenate([valued, final_valued[None]])
        at_or_after = np.minimum.accumulate(np.where(all_valued, index, never)[::-1])[::-1]
        following = at_or_after[1:]

        ends = valued & (first_end < following)
        known = valued & (ends | (following <= rounds))
        last = np.where(ends, first_end, np.minimum(following, rounds) - 1)
        return cls(valued, known, ends, last, following)

    @property
    def pending(self) -> np.ndarray:
        """bool ``[T, N]``: rows with a value whose outcome has not arrived."""
        return self.valued & ~self.known

    def rewards(self, reward: np.ndarray) -> np.ndarray:
        """Sum what arrived from each row up to its outcome, or, where that is pending, to the batch's end.

        Args:
            reward: float ``[T, N]``, reward that arrived in a round.

        Returns:
            float32 ``[T, N]``, 0 where there is no value.
        """
        rows = np.arange(len(reward))[:, None]
        is_one_round = self.last == rows
        if is_one_round[self.valued].all():  # everybody is asked in every round
            return np.where(self.valued, reward, 0).astype(np.float32)

        # differences of running sums, in float64 so that nothing is lost
        total = np.concatenate([np.zeros((1, reward.shape[1])), np.cumsum(reward, 0, np.float64)])
        sums = np.take_along_axis(total, self.last + 1, 0) - total[:-1]
        return np.where(self.valued, np.where(is_one_round, reward, sums), 0).astype(np.float32)

    def onward(self, values: np.ndarray, final: np.ndarray) -> np.ndarray:
        """Return what stands ``[T, N]`` at the row that follows each row, read where known and not ends.

        Args:
            values: ``[T, N]``, read where valued.
            final: ``[N]``, the same of the row after the last.
        """
        return np.take_along_axis(
            np.concatenate([values, final[None]]), np.minimum(self.following, len(values)), 0
        )

    def next_values(
        self, value: np.ndarray, final_value: np.ndarray, end_value: np.ndarray, truncated: np.ndarray
    ) -> np.ndarray:
        """Return the value that stands where each row leads; 0 at a real end and where it is not known.

        Args:
            value: float32 ``[T, N]`` of the rows, read where valued.
            final_value: float32 ``[N]`` of the row after the last.
            end_value: float32 ``[T, N]`` of terminal observations, read where truncated.
            truncated: bool ``[T, N]``, ends that were cut off: there the value goes on.
        """
        onward = self.onward(value, final_value)
        at_end = np.take_along_axis(np.where(truncated, end_value, 0), self.last, 0)
        return np.where(self.known, np.where(self.ends, at_end, onward), 0)

    def scan(self, delta: np.ndarray, decay: float | np.ndarray, horizon: int | None = None) -> np.ndarray:
        """Run ``A_k = delta_k + decay * A_next`` from each slot's last row to its first.

        An end, and the row after the batch, have A = 0.

        Args:
            delta: float32 ``[T, N]``.
            decay: one for all rows, or float32 ``[T, N]``.
            horizon: what comes after so many rows with a value, counted from the episode's first row in the
                batch, counts as A = 0, too; None: nothing does.

        Returns:
            float32 ``[T, N]``, 0 where the outcome is not known.
        """
        delta = np.where(self.known, delta, 0).astype(np.float32)
        factor = np.where(self.known & ~self.ends, np.asarray(decay, np.float32), np.float32(0))
        if horizon is not None:
            factor[self._place() % horizon == 0] = 0
        factor[~self.valued] = 1  # rounds without a value pass on what they got

        out = np.empty((len(delta) + 1, delta.shape[1]), np.float32)
        out[-1] = 0
        for t in range(len(delta) - 1, -1, -1):
            np.multiply(factor[t], out[t + 1], out=out[t])
            out[t] += delta[t]

        return np.where(self.valued, out[:-1], 0)

    def _place(self) -> np.ndarray:
        """int64 ``[T, N]``: 1 for an episode's first row with a value in the batch, 2 for its second ..."""
        count = self.valued.cumsum(0)
        at_end = np.maximum.accumulate(np.where(self.ends, count, 0))
        count[1:] -= at_end[:-1]
        return count
