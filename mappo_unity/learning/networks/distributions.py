"""The distribution of actions for any Unity action spec, from one parameter tensor ``[..., P]``.

An action is one tensor ``[..., C + K]``: C continuous columns, then K branch indices. A purely discrete
action is int64, any other float32 (branch indices up to 2**24 are exact in it).

Continuous columns are Gaussian before the environment clips them to +-3 and divides by 3, as in
ML-Agents' exported policies. Squashed ones are 3 tanh(Gaussian), which that clip leaves alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from mlagents_envs.base_env import ActionSpec
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import softplus

CONTINUOUS_LIMIT = 3.0  # ML-Agents: clip to +-3, then divide by 3 (mlagents.trainers torch distributions)
TANH_LIMIT = 1 - 1e-6  # a squashed action is not brought nearer to its limit: float32 could not invert it
LEAST_SCALE = 0.01  # of a state-dependent deviation, as a share of the initial one
_LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)

# nodes and weights (which sum to 1) of Gauss-Hermite quadrature: means under N(0, 1) are weighted sums
_NODES, _WEIGHTS = (x.tolist() for x in np.polynomial.hermite_e.hermegauss(32))
_WEIGHTS = [w / math.sqrt(2 * math.pi) for w in _WEIGHTS]


@dataclass(frozen=True)
class ActionLayout:
    """Sizes of an action: C continuous columns and the sizes of K discrete branches.

    With ``joint`` there is one categorical over all combinations of the branches (27 for 3x3x3)
    instead of one for each; the action itself still holds one index a branch. With ``squashed``
    continuous columns go through tanh.
    """

    continuous: int
    branches: tuple[int, ...]
    joint: bool = False
    squashed: bool = False

    @classmethod
    def from_spec(cls, spec: ActionSpec, joint: bool = False) -> ActionLayout:
        """Read the layout from a behavior's action spec."""
        branches = tuple(int(n) for n in spec.discrete_branches)
        return cls(int(spec.continuous_size), branches, joint and len(branches) > 1)

    @property
    def categoricals(self) -> tuple[int, ...]:
        """Sizes of the categoricals: the branches, or their product alone."""
        return (math.prod(self.branches),) if self.joint else self.branches

    @property
    def num_logits(self) -> int:
        """Number of logits."""
        return sum(self.categoricals)

    @property
    def num_means(self) -> int:
        """Number of a network's outputs for continuous columns: squashed ones have a deviation each, too."""
        return self.continuous * (2 if self.squashed else 1)

    @property
    def num_params(self) -> int:
        """Length P of the parameters: means, logarithms of deviations, logits."""
        return 2 * self.continuous + self.num_logits

    def to_categories(self, branches: Tensor) -> Tensor:
        """Turn branch indices ``[..., K]`` into indices of the categoricals ``[..., K or 1]``."""
        if not self.joint:
            return branches

        # branches are the digits of one number, the first the highest
        index = torch.zeros_like(branches[..., 0])
        for column, size in enumerate(self.branches):
            index = index * size + branches[..., column]

        return index.unsqueeze(-1)

    def to_branches(self, categories: Tensor) -> Tensor:
        """Turn indices of the categoricals ``[..., K or 1]`` into branch indices ``[..., K]``."""
        if not self.joint:
            return categories

        index, columns = categories[..., 0], []
        for size in reversed(self.branches):
            columns.append(index % size)
            index = index // size

        return torch.stack(columns[::-1], -1)

    def joint_mask(self, mask: Tensor) -> Tensor:
        """Turn masks of branches ``[..., sum]`` into masks of the categoricals."""
        if not self.joint:
            return mask

        # a combination is allowed where all its parts are
        first, *rest = mask.split(list(self.branches), -1)
        for part in rest:
            first = (first.unsqueeze(-1) & part.unsqueeze(-2)).flatten(-2)
        return first


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
        self.log_probs = self._categoricals(params[..., 2 * size :], mask) if layout.branches else []
        super().__init__(params.shape[:-1], torch.Size([size + len(layout.branches)]), validate_args=False)

    def sample(self, sample_shape: Sequence[int] = ()) -> Tensor:
        """Draw actions ``[*sample_shape, ..., C + K]``."""
        with torch.no_grad():
            if not self.layout.branches:
                return self._sample_continuous(sample_shape)

            categories = torch.stack([self._sample_category(p, sample_shape) for p in self.log_probs], -1)
            return self._join(self._sample_continuous(sample_shape), self.layout.to_branches(categories))

    rsample = sample

    @property
    def mode(self) -> Tensor:
        """The most likely action ``[..., C + K]``; of squashed columns the median."""
        if not self.layout.branches:
            return self.squash(self.loc)
        categories = torch.stack([p.argmax(-1) for p in self.log_probs], -1)
        return self._join(self.squash(self.loc), self.layout.to_branches(categories))

    @property
    def deterministic_sample(self) -> Tensor:
        """The same as `mode`; TorchRL asks for it by this name."""
        return self.mode

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log-probability ``[...]`` of actions ``[..., C + K]``, summed over columns."""
        size = self.layout.continuous
        total = torch.zeros(()) if not size else self._continuous_log_prob(value[..., :size])
        if not self.log_probs:
            return total

        # in an action of both kinds the branch indices are floats
        categories = self.layout.to_categories(value[..., size:].long())
        for column, log_probs in enumerate(self.log_probs):
            total = total + log_probs.gather(-1, categories[..., column : column + 1]).squeeze(-1)

        return total

    def component_log_probs(self, value: Tensor) -> Tensor:
        """Return log-probabilities ``[..., C + K]`` of actions, of each column and each branch by itself.

        With `ActionLayout.joint` the branches are one component.
        """
        size = self.layout.continuous
        parts = [self._column_log_probs(value[..., :size])] if size else []
        if self.log_probs:
            categories = self.layout.to_categories(value[..., size:].long())
            parts += [p.gather(-1, categories[..., i : i + 1]) for i, p in enumerate(self.log_probs)]
        return torch.cat(parts, -1)

    def entropy(self, mean: bool = False) -> Tensor:
        """Return the entropy ``[...]``, summed over columns and branches.

        Args:
            mean: take the mean over the continuous columns, and add the branches to it (ML-Agents).
        """
        total = torch.zeros(())
        if self.layout.continuous:
            columns = self.log_std + 0.5 + _LOG_SQRT_2PI
            if self.layout.squashed:
                columns = columns + self._mean_log_slope()
            total = columns.mean(-1) if mean else columns.sum(-1)

        for log_probs in self.log_probs:
            total = total - (log_probs.exp() * log_probs).sum(-1)

        return total

    def _categoricals(self, logits: Tensor, mask: Tensor | None) -> list[Tensor]:
        if mask is not None:
            # not -inf: times a probability of 0 it would make the entropy nan
            logits = logits.masked_fill(~self.layout.joint_mask(mask), torch.finfo(logits.dtype).min / 4)

        return [part.log_softmax(-1) for part in logits.split(list(self.layout.categoricals), -1)]

    def squash(self, value: Tensor) -> Tensor:
        """Return continuous columns of Gaussian values ``[..., C]``: 3 tanh of them, or they themselves."""
        if not self.layout.squashed:
            return value
        return CONTINUOUS_LIMIT * value.tanh().clamp(-TANH_LIMIT, TANH_LIMIT)

    def _mean_log_slope(self) -> Tensor:
        """Mean logarithm of the slope of `squash`, by which it changes the entropy, for each column.

        It has no closed form; quadrature gives it without the noise of drawing it.
        """
        std = torch.exp(self.log_std)
        parts = [w * _log_slope(self.loc + std * x) for x, w in zip(_NODES, _WEIGHTS)]
        return sum(parts[1:], parts[0])

    def _continuous_log_prob(self, value: Tensor) -> Tensor:
        return self._column_log_probs(value).sum(-1)

    def _column_log_probs(self, value: Tensor) -> Tensor:
        if self.layout.squashed:
            value = (value / CONTINUOUS_LIMIT).clamp(-TANH_LIMIT, TANH_LIMIT).atanh()

        z = (value - self.loc) * torch.exp(-self.log_std)
        log_probs = -0.5 * z * z - self.log_std - _LOG_SQRT_2PI
        return log_probs - _log_slope(value) if self.layout.squashed else log_probs

    def _sample_continuous(self, sample_shape: Sequence[int]) -> Tensor:
        shape = torch.Size(sample_shape) + self.loc.shape
        noise = torch.randn(shape, device=self.loc.device)
        return self.squash(self.loc + torch.exp(self.log_std) * noise)

    @staticmethod
    def _sample_category(log_probs: Tensor, sample_shape: Sequence[int]) -> Tensor:
        shape = torch.Size(sample_shape) + log_probs.shape
        # Gumbel-max: argmax(log p + Gumbel noise) is a draw from p
        noise = -torch.empty(shape, device=log_probs.device).exponential_().log()
        return (log_probs + noise).argmax(-1)

    def _join(self, continuous: Tensor, branches: Tensor) -> Tensor:
        if not self.layout.continuous:
            return branches
        return torch.cat([continuous, branches.to(continuous.dtype)], -1)


def state_log_std(raw: Tensor, init_log_std: float) -> Tensor:
    """Return the log deviations of network outputs ``raw``: at 0 they are ``init_log_std``.

    A biased softplus, TorchRL's ``biased_softplus_1.0`` where ``init_log_std`` is 0.
    """
    shift, least = scale_shift(init_log_std)
    return (softplus(raw + shift) + least).log()


def scale_shift(init_log_std: float) -> tuple[float, float]:
    """Return ``shift`` and ``least`` of the deviation ``softplus(raw + shift) + least``."""
    scale = math.exp(init_log_std)
    least = LEAST_SCALE * scale
    return math.log(math.expm1(scale - least)), least


def _log_slope(value: Tensor) -> Tensor:
    """Logarithm of the slope of ``3 tanh`` at ``value``: 1 - tanh(x)**2 = 4 / (exp(x) + exp(-x))**2."""
    return math.log(4 * CONTINUOUS_LIMIT) - 2 * (value + softplus(-2 * value))
