"""Traces of what an agent has observed: a memory of the critic that has no weights to be learnt.

A trace is a moving average over the agent's decisions since the beginning of its episode,

    z <- decay * z + (1 - decay) * [x, 1],    z = 0 before the first decision

of columns x of its vector observations (memory traces: Eberhard, Muehlebach and Vernade, arXiv 2503.15200).
Values are learnt from single decisions in any order, as without a memory. The 1 tells which share of the
average the episode has filled so far, and with it how old a young episode is.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class ObservationTraces(nn.Module):
    """Traces ``[..., K * (n + 1)]`` of n columns of vector observations ``[..., O]``, one for each decay.

    Args:
        decays: K of them, between 0 and 1, exclusive.
        columns: the n columns.

    Attributes: `size`, ``K * (n + 1)``.
    """

    decays: Tensor
    columns: Tensor

    def __init__(self, decays: Sequence[float], columns: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("decays", torch.tensor(decays).unsqueeze(-1), persistent=False)
        self.register_buffer("columns", torch.tensor(columns), persistent=False)
        self.size = len(decays) * (len(columns) + 1)

    def after(self, traces: Tensor, obs: Tensor) -> Tensor:
        """Return the traces after one more decision, with observations ``[..., O]``."""
        seen = torch.cat([obs.index_select(-1, self.columns), torch.ones_like(obs[..., :1])], -1)
        traces = traces.unflatten(-1, (-1, seen.shape[-1]))
        return (self.decays * traces + (1 - self.decays) * seen.unsqueeze(-2)).flatten(-2)

    def walk(self, state: Tensor, obs: Tensor, first: Tensor, acting: Tensor) -> Tensor:
        """Return the traces after each of T rows, ``[T, ..., K * (n + 1)]``.

        Args:
            state: ``[..., K * (n + 1)]``, the traces before the first row.
            obs: ``[T, ..., O]``.
            first: bool ``[T, ..., 1]``, whose episode begins with this row.
            acting: bool ``[T, ..., 1]``, who decides in this row; the traces of others stay.
        """
        rows = []
        for row in range(len(obs)):
            state = torch.where(first[row], 0.0, state)
            state = torch.where(acting[row], self.after(state, obs[row]), state)
            rows.append(state)
        return torch.stack(rows)

    def forward(self, traces: Tensor, mean: Tensor, inv_std: Tensor) -> Tensor:
        """Return the traces that normalised observations, ``(x - mean) * inv_std``, would have left."""
        sums, share = traces.unflatten(-1, (-1, len(self.columns) + 1)).split([len(self.columns), 1], -1)
        sums = (sums - mean[self.columns] * share) * inv_std[self.columns]
        return torch.cat([sums, share], -1).flatten(-2)
