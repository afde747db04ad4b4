"""Running statistics of returns, so that the critic learns in a normalised space.

As in the MAPPO paper's repository (arXiv 2103.01955, section 4): exponential averages of x and x**2
with debiasing, variance floor 1e-2. TorchRL's norms of that name scale prediction and target inside the loss
instead, which leaves the critic's output in the reward's scale; hence this module.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mappo_unity.learning.reduction import ALONE, Reduction

VARIANCE_FLOOR = 1e-2


class ValueNorm(nn.Module):
    """Normalise returns by debiased exponential averages, those of each reward stream by themselves.

    Args:
        beta: decay of the averages for each update.
        enabled: False makes it the identity.
        streams: V, reward streams that have a value each.

    Attributes: `reduction`, of several learners, whose returns are taken together.
    """

    mean: Tensor
    mean_sq: Tensor
    debias: Tensor

    def __init__(self, beta: float, enabled: bool = True, streams: int = 1) -> None:
        super().__init__()
        self.beta, self.enabled = beta, enabled
        self.reduction: Reduction = ALONE
        self.register_buffer("mean", torch.zeros(streams, dtype=torch.float64))
        self.register_buffer("mean_sq", torch.zeros(streams, dtype=torch.float64))
        self.register_buffer("debias", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, returns: Tensor) -> None:
        """Take returns ``[n, V]`` into the averages."""
        if not self.enabled or not self.reduction.total(returns.numel()):
            return

        # in float64: a difference of two averages of squares loses digits
        columns = [column.contiguous() for column in returns.double().unbind(-1)]
        for average, moments in (
            (self.mean, [self.reduction.mean(column, None) for column in columns]),
            (self.mean_sq, [self.reduction.mean(column**2, None) for column in columns]),
        ):
            average.mul_(self.beta).add_(torch.stack(moments).to(average) * (1 - self.beta))
        self.debias.mul_(self.beta).add_(1 - self.beta)

    def statistics(self) -> tuple[Tensor, Tensor]:
        """Return the debiased means and standard deviations of returns, float64 ``[V]``."""
        if not self.enabled or float(self.debias) == 0.0:
            return torch.zeros_like(self.mean), torch.ones_like(self.mean)
        mean = self.mean / self.debias
        variance = self.mean_sq / self.debias - mean**2
        return mean, variance.clamp_min(VARIANCE_FLOOR).sqrt()

    def normalize(self, returns: Tensor) -> Tensor:
        """Return ``(returns - mean) / std`` of returns ``[..., V]``."""
        mean, std = (moment.to(returns) for moment in self.statistics())
        return (returns - mean) / std

    def denormalize(self, values: Tensor) -> Tensor:
        """Return ``values * std + mean``, the critic's outputs ``[..., V]`` in the rewards' scale."""
        mean, std = (moment.to(values) for moment in self.statistics())
        return values * std + mean


def by_stream(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the state of a `ValueNorm`; one from before 0.3 has a number for each moment, and no streams."""
    return {name: value if name == "debias" else value.reshape(-1) for name, value in state.items()}


@torch.no_grad()
def move_statistics(norm: ValueNorm, returns: Tensor, layers: Sequence[nn.Linear] = ()) -> None:
    """Take returns ``[n, V]`` into the statistics; what these layers say, in the rewards' scale, stays.

    PopArt (van Hasselt et al., arXiv 1602.07714, eq. 7): w' = w std / std',
    b' = (std b + mean - mean') / std'.
    """
    mean, std = norm.statistics()
    norm.update(returns)
    new_mean, new_std = norm.statistics()
    for layer in layers:
        weight, bias = layer.weight, layer.bias
        weight.mul_((std / new_std).unsqueeze(-1).to(weight))
        bias.mul_(std.to(bias)).add_((mean - new_mean).to(bias)).div_(new_std.to(bias))
