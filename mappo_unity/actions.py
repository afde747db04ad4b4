"""Actions of any Unity action spec through one door: one parameter tensor, one action tensor.

In: network outputs ``[..., P]``. Out: a `torch.distributions.Distribution` over actions
``[..., C + K]``: C continuous columns, then K branch indices. A purely discrete action is int64, any
other float32 (branch indices up to 2**24 are exact in it).

Continuous columns are Gaussian before the environment clips them to +-3 and divides by 3, as in
ML-Agents' exported policies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from mlagents_envs.base_env import ActionSpec
from torch import Tensor
from torch.distributions import Distribution

CONTINUOUS_LIMIT = 3.0  # ML-Agents: clip to +-3, then divide by 3 (mlagents.trainers torch distributions)
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True)
class ActionLayout:
    """Sizes of an action: C continuous columns and the sizes of K discrete branches."""

    continuous: int
    branches: tuple[int, ...]

    @classmethod
    def from_spec(cls, spec: ActionSpec) -> ActionLayout:
        """Read the layout from a behavior's action spec."""
        return cls(int(spec.continuous_size), tuple(int(n) for n in spec.discrete_branches))

    @property
    def num_params(self) -> int:
        """Length P of the parameters: means, logarithms of deviations, logits."""
        return 2 * self.continuous + sum(self.branches)


class ActionDistribution(Distribution):
    """Independent Gaussians for C columns and categoricals for K branches.

    Args:
        params: float32 ``[..., P]``: C means, C log standard deviations, all branches' logits.
        layout: the sizes.
        mask: bool ``[..., sum of branches]``, True = allowed; None = all allowed.
    """

    arg_constraints: dict = {}
    has_enumerate_support = False

    def __init__(self, params: Tensor, layout: ActionLayout, mask: Tensor | None = None) -> None:
        self.layout = layout
        size = layout.continuous
        self.loc = params[..., :size]
        self.log_std = params[..., size : 2 * size]
        logits = params[..., 2 * size :]
        if mask is not None and layout.branches:
            logits = logits.masked_fill(~mask, torch.finfo(logits.dtype).min / 4)
        self.log_probs = [part.log_softmax(-1) for part in logits.split(list(layout.branches), -1)]
        super().__init__(params.shape[:-1], torch.Size([size + len(layout.branches)]), validate_args=False)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw actions ``[*sample_shape, ..., C + K]``."""
        with torch.no_grad():
            if not self.layout.branches:
                return self._sample_continuous(sample_shape)
            branches = torch.stack([self._sample_branch(p, sample_shape) for p in self.log_probs], -1)
            return self._join(self._sample_continuous(sample_shape), branches)

    rsample = sample

    @property
    def mode(self) -> Tensor:
        """The most likely action ``[..., C + K]``."""
        if not self.layout.branches:
            return self.loc
        return self._join(self.loc, torch.stack([p.argmax(-1) for p in self.log_probs], -1))

    @property
    def deterministic_sample(self) -> Tensor:
        """The same as `mode`; TorchRL asks for it by this name."""
        return self.mode

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-probability ``[...]`` of actions ``[..., C + K]``, summed over columns."""
        size = self.layout.continuous
        total = torch.zeros(())
        if size:
            z = (value[..., :size] - self.loc) * torch.exp(-self.log_std)
            total = (-0.5 * z * z - self.log_std - _LOG_SQRT_2PI).sum(-1)
        for branch, log_probs in enumerate(self.log_probs):
            index = value[..., size + branch].long().unsqueeze(-1)
            total = total + log_probs.gather(-1, index).squeeze(-1)
        return total

    def entropy(self) -> Tensor:
        """Return the entropy ``[...]``, summed over columns and branches."""
        total = torch.zeros(())
        if self.layout.continuous:
            total = (self.log_std + 0.5 + _LOG_SQRT_2PI).sum(-1)
        for log_probs in self.log_probs:
            total = total - (log_probs.exp() * log_probs).sum(-1)
        return total

    def _sample_continuous(self, sample_shape: Sequence[int]) -> Tensor:
        shape = torch.Size(sample_shape) + self.loc.shape
        return self.loc + torch.exp(self.log_std) * torch.randn(shape, device=self.loc.device)

    @staticmethod
    def _sample_branch(log_probs: Tensor, sample_shape: Sequence[int]) -> Tensor:
        shape = torch.Size(sample_shape) + log_probs.shape
        # Gumbel-max: argmax(log p + Gumbel noise) is a draw from p
        noise = -torch.empty(shape, device=log_probs.device).exponential_().log()
        return (log_probs + noise).argmax(-1)

    def _join(self, continuous: Tensor, branches: Tensor) -> Tensor:
        if not self.layout.continuous:
            return branches
        return torch.cat([continuous, branches.to(continuous.dtype)], -1)
