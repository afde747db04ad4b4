"""Actor and critic of one policy name, from its specs and the model options.

In: sizes read from the environment, `ModelConfig`. Out: TensorDict modules that read ``observation``
(and ``action_mask``) and write ``action``, ``action_log_prob`` and ``state_value``. Observation
normalisation is part of the networks, so that it is saved and exported with them.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from mappo_unity import keys
from mappo_unity.actions import ActionDistribution, ActionLayout
from mappo_unity.config import Activation, ModelConfig

ACTIVATIONS: dict[Activation, type[nn.Module]] = {
    Activation.tanh: nn.Tanh,
    Activation.relu: nn.ReLU,
    Activation.silu: nn.SiLU,
    Activation.elu: nn.ELU,
}
OBS_CLIP = 5.0  # ML-Agents clips normalised observations to +-5


class RunningNorm(nn.Module):
    """Normalise features by running mean and variance: ``clip((x - mean) / std, +-5)``.

    Statistics move only in `update`, never in `forward`, so that they stand still during a batch
    and its update: the first minibatch then has ratio 1.
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    inv_std: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("inv_std", torch.ones(size))

    def forward(self, x: Tensor) -> Tensor:
        """Return ``x`` ``[..., size]``, normalised."""
        return ((x - self.mean) * self.inv_std).clamp(-OBS_CLIP, OBS_CLIP)

    @torch.no_grad()
    def update(self, rows: Tensor) -> None:
        """Take ``rows`` ``[n, size]`` into the statistics (Chan et al., pairwise update)."""
        if not len(rows):
            return
        count = self.count + len(rows)
        weight = float(len(rows) / count)
        delta = rows.mean(0) - self.mean
        var = self.var * (1 - weight) + rows.var(0, unbiased=False) * weight
        self.var.copy_(var + delta**2 * weight * (1 - weight))
        self.mean.add_(delta * weight)
        self.count.copy_(count)
        self.inv_std.copy_(1.0 / torch.sqrt(self.var + 1e-6))


class Actor(nn.Module):
    """Observation ``[..., O]`` to the parameters ``[..., P]`` of an `ActionDistribution`."""

    def __init__(self, obs_size: int, layout: ActionLayout, cfg: ModelConfig) -> None:
        super().__init__()
        self.norm = RunningNorm(obs_size) if cfg.normalize_obs else nn.Identity()
        outputs = layout.continuous + sum(layout.branches)
        self.net = make_mlp(obs_size, list(cfg.hidden), outputs, cfg.activation, last_gain=0.01)
        self.layout = layout
        self.log_std = nn.Parameter(torch.full((layout.continuous,), float(cfg.init_log_std)))

    def forward(self, obs: Tensor) -> Tensor:
        """Return distribution parameters."""
        out = self.net(self.norm(obs))
        size = self.layout.continuous
        if not size:
            return out
        log_std = self.log_std.clamp(-5.0, 2.0).expand(*out.shape[:-1], size)
        return torch.cat([out[..., :size], log_std, out[..., size:]], -1)


class Critic(nn.Module):
    """Observation ``[..., O]`` to a value ``[..., 1]`` in normalised space."""

    def __init__(self, obs_size: int, cfg: ModelConfig) -> None:
        super().__init__()
        self.norm = RunningNorm(obs_size) if cfg.normalize_obs else nn.Identity()
        hidden = list(cfg.critic_hidden or cfg.hidden)
        self.net = make_mlp(obs_size, hidden, 1, cfg.activation, last_gain=1.0)

    def forward(self, obs: Tensor) -> Tensor:
        """Return values."""
        return self.net(self.norm(obs))


def make_mlp(
    size: int, hidden: list[int], outputs: int, activation: Activation, last_gain: float
) -> nn.Sequential:
    """Build an MLP with orthogonal weights (hidden gain sqrt 2, last layer `last_gain`), zero biases."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [_linear(size, width, 2**0.5), ACTIVATIONS[activation]()]
        size = width
    return nn.Sequential(*layers, _linear(size, outputs, last_gain))


def _linear(size: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(size, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def make_actor(obs_size: int, layout: ActionLayout, cfg: ModelConfig) -> ProbabilisticActor:
    """Build the policy as a TorchRL actor over the entries of one policy name."""
    module = TensorDictModule(Actor(obs_size, layout, cfg), in_keys=[keys.OBS], out_keys=["params"])
    in_keys = {"params": "params"} | ({"mask": keys.MASK} if layout.branches else {})
    return ProbabilisticActor(
        module,
        in_keys=in_keys,
        out_keys=[keys.ACTION],
        distribution_class=ActionDistribution,
        distribution_kwargs={"layout": layout},
        return_log_prob=True,
        log_prob_key=keys.LOG_PROB,
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic(obs_size: int, cfg: ModelConfig) -> TensorDictModule:
    """Build the critic over the entries of one policy name."""
    return TensorDictModule(Critic(obs_size, cfg), in_keys=[keys.OBS], out_keys=[keys.VALUE])


class JointPolicy(TensorDictModuleBase):
    """The actors of all policy names as one policy for the collector."""

    def __init__(self, actors: dict[str, TensorDictModuleBase]) -> None:
        super().__init__()
        self.actors = nn.ModuleDict({str(i): actor for i, actor in enumerate(actors.values())})
        self.names = list(actors)
        self.in_keys = [(n, k) for n, actor in actors.items() for k in list(actor.in_keys)]
        self.out_keys = [(n, k) for n in actors for k in (keys.ACTION, keys.LOG_PROB)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write every name's action and log-probability beside its observation."""
        for name, actor in zip(self.names, self.actors.values()):
            entries = tensordict.get(name)
            out = actor(entries.select(*actor.in_keys, strict=False))  # type: ignore[misc]
            entries.set(keys.ACTION, out.get(keys.ACTION))
            entries.set(keys.LOG_PROB, out.get(keys.LOG_PROB))
        return tensordict
