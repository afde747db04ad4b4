"""What several learners add up, each of which has a part of a batch; one alone has the whole.

Data-parallel learners take the same steps from the same networks where everything that depends on the whole
batch is added up: means over decisions, the moments of advantages, returns and observations, gradients, the
KL that ends an update, and how many minibatches there are. A learner computes its *part* of a mean: its own
sum over the count of all, so that parts, and their gradients, need only be added.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
import torch.distributed as dist
from torch import Tensor, nn

from mappo_unity.config.schema import ObsNormUpdate, PPOConfig
from mappo_unity.errors import ConfigError


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of ``values`` where ``mask`` holds (0 if nowhere; None: everywhere), a scalar."""
    if mask is None:
        return values.mean()
    weight = mask.to(torch.get_default_dtype())
    return (values * weight).sum() / weight.sum().clamp_min(1.0)


class Reduction:
    """One learner alone: its part is the whole.

    Attributes: `size`, how many learners there are.
    """

    size = 1

    def part(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """Return this learner's part of the mean of all learners' values where their masks hold, a scalar."""
        return masked_mean(values, mask)

    def whole(self, part: Tensor) -> Tensor:
        """Return the sum of all learners' parts, without gradients."""
        return part

    def mean(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """Return the mean of all learners' values where their masks hold, a scalar without gradients."""
        return self.whole(self.part(values, mask))

    def total(self, count: int) -> int:
        """Return the sum of all learners' counts."""
        return count

    def least(self, count: int) -> int:
        """Return the least of all learners' counts."""
        return count

    def moments(self, rows: Tensor) -> tuple[int, Tensor, Tensor]:
        """Return the number of all learners' rows ``[n, size]``, their mean and variance ``[size]``."""
        return len(rows), rows.mean(0), rows.var(0, unbiased=False)

    def add_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace the gradients by the sums of all learners'."""

    def share(self, tensors: Iterable[Tensor]) -> None:
        """Replace the tensors by those of the first learner."""


ALONE = Reduction()


class SeveralLearners(Reduction):
    """Learners in processes of their own, joined by torch.distributed.

    Each calls the same methods in the same order; where one fails, the others' next call does.

    Args:
        group: the process group; None: all processes.
        device: where numbers are added up: of the networks, where the backend is NCCL.
    """

    def __init__(self, group: dist.ProcessGroup | None = None, device: str = "cpu") -> None:
        self._group, self._device = group, device
        self.size = self._count_learners()

    def part(self, values: Tensor, mask: Tensor | None) -> Tensor:
        """Return this learner's sum over the count of all."""
        weight = torch.ones_like(values) if mask is None else mask.to(values.dtype)
        count = self._sum(weight.sum(dtype=torch.float64)).clamp_min(1.0)
        return (values * weight).sum() / count.to(values.dtype)

    def whole(self, part: Tensor) -> Tensor:
        """Return the sum of all parts."""
        return self._sum(part.detach().clone())

    def total(self, count: int) -> int:
        """Return the sum of all counts."""
        return int(self._sum(torch.tensor(count, device=self._device)))

    def least(self, count: int) -> int:
        """Return the least of all counts."""
        return -int(self._most(torch.tensor(-count, device=self._device)))

    def moments(self, rows: Tensor) -> tuple[int, Tensor, Tensor]:
        """Return them by two passes: sums, then squares of what is left."""
        count = self.total(len(rows))
        mean = self._sum(rows.sum(0)) / max(1, count)
        return count, mean, self._sum(((rows - mean) ** 2).sum(0)) / max(1, count)

    def add_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Add them up in one piece; where one has none, it has none in any learner."""
        gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
        flat = self._sum(torch.cat([gradient.flatten() for gradient in gradients]))
        sizes = [gradient.numel() for gradient in gradients]
        for gradient, whole in zip(gradients, flat.split(sizes), strict=True):
            gradient.copy_(whole.view_as(gradient))

    @torch.no_grad()
    def share(self, tensors: Iterable[Tensor]) -> None:
        """Send those of rank 0."""
        for tensor in tensors:
            self._send(tensor)

    # --- the calls of torch.distributed

    def _count_learners(self) -> int:
        return dist.get_world_size(self._group)

    def _sum(self, tensor: Tensor) -> Tensor:
        dist.all_reduce(tensor, group=self._group)
        return tensor

    def _most(self, tensor: Tensor) -> Tensor:
        dist.all_reduce(tensor, dist.ReduceOp.MAX, group=self._group)
        return tensor

    def _send(self, tensor: Tensor) -> None:
        dist.broadcast(tensor, group=self._group, group_src=0)


def check_reduced(size: int, cfg: PPOConfig, streams: Sequence[str], clones: bool) -> None:
    """Raise ConfigError for what several learners do not add up.

    Args:
        size: how many there are.
        cfg: the learner's options.
        streams: names of the reward streams, the environment's own first.
        clones: whether demonstrations are cloned.
    """
    if size == 1:
        return
    given = [f"rewards.{name}" for name in streams[1:]] + ["bc.demos"] * clones
    given += ["ppo.obs_norm_update=round"] * (cfg.obs_norm_update is ObsNormUpdate.round)
    if given:
        raise ConfigError(
            f"{given[0]} does not go with {size} learners: each would learn it by itself; leave it "
            "out, or let one learn alone"
        )
