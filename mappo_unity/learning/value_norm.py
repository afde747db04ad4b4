"""Running statistics of returns, so that the critic learns in a normalised space.

As in the MAPPO paper's repository (arXiv 2103.01955, section 4): exponential averages of x and x**2
with debiasing, variance floor 1e-2. TorchRL's norms of that name scale prediction and target inside the loss
instead, which leaves the critic's output in the reward's scale; hence this module.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

VARIANCE_FLOOR = 1e-2


class ValueNorm(nn.Module):
    """Normalise returns by debiased exponential averages.

    Args:
        beta: decay of the averages for each update.
        enabled: False makes it the identity.
    """

    mean: Tensor
    mean_sq: Tensor
    debias: Tensor

    def __init__(self, beta: float, enabled: bool = True) -> None:
        super().__init__()
        self.beta, self.enabled = beta, enabled
        self.register_buffer("mean", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean_sq", torch.zeros((), dtype=torch.float64))
        self.register_buffer("debias", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, returns: Tensor) -> None:
        """Take returns ``[n]`` into the averages."""
        if not self.enabled or not returns.numel():
            return

        # in float64: a difference of two averages of squares loses digits
        returns = returns.double()
        self.mean.mul_(self.beta).add_(float(returns.mean()) * (1 - self.beta))
        self.mean_sq.mul_(self.beta).add_(float((returns**2).mean()) * (1 - self.beta))
        self.debias.mul_(self.beta).add_(1 - self.beta)

    def statistics(self) -> tuple[float, float]:
        """Return the debiased mean and standard deviation of returns."""
        if not self.enabled or float(self.debias) == 0.0:
            return 0.0, 1.0
        mean = float(self.mean / self.debias)
        variance = float(self.mean_sq / self.debias) - mean**2
        return mean, max(variance, VARIANCE_FLOOR) ** 0.5

    def normalize(self, returns: Tensor) -> Tensor:
        """Return ``(returns - mean) / std``."""
        mean, std = self.statistics()
        return (returns - mean) / std

    def denormalize(self, values: Tensor) -> Tensor:
        """Return ``values * std + mean``, the critic's output in the reward's scale."""
        mean, std = self.statistics()
        return values * std + mean


@torch.no_grad()
def move_statistics(norm: ValueNorm, returns: Tensor, layers: Sequence[nn.Linear] = ()) -> None:
    """Take returns ``[n]`` into the statistics; what these layers say, in the reward's scale, stays.

    PopArt (van Hasselt et al., arXiv 1602.07714, eq. 7): w' = w std / std',
    b' = (std b + mean - mean') / std'.
    """
    mean, std = norm.statistics()
    norm.update(returns)
    new_mean, new_std = norm.statistics()
    for layer in layers:
        layer.weight.mul_(std / new_std)
        layer.bias.mul_(std).add_(mean - new_mean).div_(new_std)
