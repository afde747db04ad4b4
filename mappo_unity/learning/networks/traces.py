"""Traces of what an agent has observed: a memory that has no weights to be learnt.

A trace is a moving average over the agent's decisions since the beginning of its episode,

    z <- decay * z + (1 - decay) * [x, 1],    z = 0 before the first decision

of columns x of its vector observations (memory traces: Eberhard, Muehlebach and Vernade, arXiv 2503.15200).
What reads them is learnt from single decisions in any order, as without a memory. The 1 tells which share of
the average the episode has filled so far, and with it how old a young episode is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn


class ObservationTraces(nn.Module):
    """Traces ``[..., K * (n + 1)]`` of n columns of vector observations ``[..., O]``, one for each decay.

    Args:
        decays: K of them, between 0 and 1, exclusive.
        columns: the n columns.

    Attributes: `size`, ``K * (n + 1)``; `options`, decays and runs of columns as the model options give them.
    """

    decays: Tensor
    columns: Tensor

    def __init__(self, decays: Sequence[float], columns: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("decays", torch.tensor(decays).unsqueeze(-1), persistent=False)
        self.register_buffer("columns", torch.tensor(columns), persistent=False)
        self.size = len(decays) * (len(columns) + 1)
        self.options = {"decays": list(decays), "columns": runs_of(columns)}

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


def runs_of(columns: Sequence[int]) -> list[int]:
    """Return columns as runs, two numbers each: first column and length."""
    runs: list[int] = []
    for column in columns:
        if runs and column == sum(runs[-2:]):
            runs[-1] += 1
        else:
            runs += [column, 1]
    return runs


class TracingActor(nn.Module):
    """An actor that sees traces beside the newest observation; they are the state that is handed on.

    Args:
        actor: `learning.networks.actor_critic.Actor`, whose encoder reads traces.
    """

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor: Any = actor
        self.layout = actor.layout

    @property
    def traces(self) -> ObservationTraces:
        """What it keeps of an episode."""
        return self.actor.encoder.traces

    @property
    def state_size(self) -> int:
        """The width M of its state."""
        return self.traces.size

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return distribution parameters ``[..., P]`` and the traces ``[..., M]`` after this decision.

        Args:
            *inputs: the observation entries ``[..., *]``, vectors first, then the traces before it.
        """
        vectors, *others, state = inputs
        after = self.traces.after(state, vectors)
        return self.actor(vectors, after, *others), after

    def unroll(self, *inputs: Tensor) -> Tensor:
        """Return parameters ``[B, L, P]`` of observations ``[B, L, *]`` from traces ``[B, M]``."""
        *obs, state = inputs
        rows = []
        for place in range(obs[0].shape[1]):
            params, state = self(*(entry[:, place] for entry in obs), state)
            rows.append(params)
        return torch.stack(rows, 1)
