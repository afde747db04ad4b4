"""Actor and critic of one policy name, from its specs and the model options.

Both are TensorDict modules, which read observations (and ``action_mask``) and write ``action``,
``action_log_prob`` and ``state_value``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType, exploration_type
from torchrl.modules import ProbabilisticActor

from mappo_unity import keys
from mappo_unity.config.schema import CriticKind, DistributionKind, ModelConfig
from mappo_unity.learning.critics import CentralCritic, LocalCritic, PooledCritic
from mappo_unity.learning.distributions import ActionDistribution, ActionLayout, state_log_std
from mappo_unity.learning.encoders import Encoder, ObsLayout
from mappo_unity.learning.mlp import make_mlp
from mappo_unity.learning.network_options import apply_options

LOG_STD_RANGE = (-5.0, 2.0)


class Actor(nn.Module):
    """Observation entries of an agent to the parameters ``[..., P]`` of an `ActionDistribution`."""

    def __init__(self, obs: ObsLayout, layout: ActionLayout, cfg: ModelConfig) -> None:
        super().__init__()
        self.encoder = Encoder(obs, cfg.normalize_obs)

        # a squashed action's deviation depends on the state: one more output for each column
        means = layout.continuous * (2 if layout.squashed else 1)
        outputs = means + layout.num_logits
        # the small last gain makes first actions almost independent of what is observed
        self.net = make_mlp(self.encoder.size, list(cfg.hidden), outputs, cfg.activation, last_gain=0.01)

        self.layout, self.init_log_std = layout, float(cfg.init_log_std)
        apply_options(self, cfg, means)
        if not layout.squashed:
            self.log_std = nn.Parameter(torch.full((layout.continuous,), self.init_log_std))

    def forward(self, *obs: Tensor) -> Tensor:
        """Return distribution parameters."""
        out = self.net(self.encoder(*obs))

        size = self.layout.continuous
        if not size:
            return out

        # means, logarithms of deviations, logits: the order that `ActionDistribution` reads
        if self.layout.squashed:
            log_std = state_log_std(out[..., size : 2 * size], self.init_log_std)
            return torch.cat([out[..., :size], log_std, out[..., 2 * size :]], -1)

        log_std = self.log_std.clamp(*LOG_STD_RANGE).expand(*out.shape[:-1], size)
        if not self.layout.branches:
            return torch.cat([out, log_std], -1)

        return torch.cat([out[..., :size], log_std, out[..., size:]], -1)


class PerMember(nn.Module):
    """A network for each member of a team: member ``a`` gets column ``a`` of its own network's output.

    Args:
        nets: one for each of the A members.
        dims: where A stands in each input, for networks that look at their member alone; None for
            networks that look at the team.
    """

    def __init__(self, nets: list[nn.Module], dims: list[int] | None) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)
        self.dims = dims

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return outputs ``[..., A, *]`` of inputs ``[..., A, *]``."""
        columns = []

        for member, net in enumerate(self.nets):
            if self.dims is None:
                columns.append(net(*inputs)[..., member, :])
            else:
                columns.append(net(*[x.select(dim, member) for x, dim in zip(inputs, self.dims)]))

        return torch.stack(columns, -2)


class UnityActor(ProbabilisticActor):
    """The policy of one policy name as a TorchRL actor, which can also give draws alone.

    Args:
        net: observation entries to the parameters ``[..., P]`` of an `ActionDistribution`.
        obs_keys: the entries that it reads, in its order.
        layout: the sizes of an action.
    """

    def __init__(self, net: nn.Module, obs_keys: Sequence[str], layout: ActionLayout) -> None:
        in_keys = {"params": "params"} | ({"mask": keys.MASK} if layout.branches else {})
        super().__init__(
            TensorDictModule(net, in_keys=list(obs_keys), out_keys=["params"]),
            in_keys=in_keys,
            out_keys=[keys.ACTION],
            distribution_class=ActionDistribution,
            distribution_kwargs={"layout": layout},
            return_log_prob=True,
            log_prob_key=keys.LOG_PROB,
            default_interaction_type=InteractionType.RANDOM,
        )
        self.obs_keys, self.layout = list(obs_keys), layout

    def draw(self, entries: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return random actions ``[..., C + K]`` and their log-probabilities ``[...]``, without gradients.

        The same numbers as `forward` writes in exploration; collecting calls this, because on small
        networks the wrappers between `forward` and the network cost more than the network.
        """
        with torch.no_grad():
            # the network itself, inside its TensorDictModule
            params = self.module[0].module(*[entries.get(key) for key in self.obs_keys])
            mask = entries.get(keys.MASK) if self.layout.branches else None

            dist = ActionDistribution(params, self.layout, mask)
            action = dist.sample()
            return action, dist.log_prob(action)


def make_actor(obs: ObsLayout, layout: ActionLayout, team_size: int, cfg: ModelConfig) -> UnityActor:
    """Build the policy as a TorchRL actor over the entries of one policy name."""
    squashed = cfg.action_distribution is DistributionKind.tanh_normal and layout.continuous > 0
    layout = replace(layout, squashed=squashed)

    if cfg.share_parameters or team_size == 1:
        net: nn.Module = Actor(obs, layout, cfg)
    else:
        net = PerMember([Actor(obs, layout, cfg) for _ in range(team_size)], obs.team_dims)
    return UnityActor(net, obs.keys, layout)


def make_critic(obs: ObsLayout, team_size: int, cfg: ModelConfig) -> TensorDictModule:
    """Build the critic over the entries of one policy name; a team of one has a local one."""
    local = team_size == 1 or cfg.critic is CriticKind.local
    in_keys = list(obs.keys) if local else [*obs.keys, keys.PRESENT, keys.DEPARTED]

    if cfg.share_parameters or team_size == 1:
        net = _critic(obs, team_size, cfg)
    else:
        nets = [_critic(obs, team_size, cfg) for _ in range(team_size)]
        net = PerMember(nets, obs.team_dims if local else None)

    return TensorDictModule(net, in_keys=in_keys, out_keys=[keys.VALUE])


def _critic(obs: ObsLayout, team_size: int, cfg: ModelConfig) -> nn.Module:
    if team_size == 1 or cfg.critic is CriticKind.local:
        net: nn.Module = LocalCritic(obs, cfg)
    elif cfg.critic is CriticKind.central:
        net = CentralCritic(obs, team_size, cfg)
    else:
        net = PooledCritic(obs, team_size, cfg)
    return apply_options(net, cfg)


class JointPolicy(TensorDictModuleBase):
    """The actors of all policy names as one policy for the collector."""

    def __init__(self, actors: dict[str, TensorDictModuleBase]) -> None:
        super().__init__()
        # by number: a module's name may hold no dot, a policy's may
        self.actors = nn.ModuleDict({str(i): actor for i, actor in enumerate(actors.values())})

        self.names = list(actors)
        self.inputs = [[str(k) for k in actor.in_keys] for actor in actors.values()]
        self.in_keys = [(name, k) for name, inputs in zip(self.names, self.inputs) for k in inputs]
        self.out_keys = [(n, k) for n in actors for k in (keys.ACTION, keys.LOG_PROB)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write every name's action and log-probability beside its observation."""
        # only then are the actor's draws what its `forward` would write
        draws = exploration_type() in (None, ExplorationType.RANDOM) and not torch.is_grad_enabled()

        for name, inputs, actor in zip(self.names, self.inputs, self.actors.values()):
            entries = tensordict.get(name)
            if draws and isinstance(actor, UnityActor):
                action, log_prob = actor.draw(entries)
            else:
                out = actor(entries.select(*inputs, strict=False))
                action, log_prob = out.get(keys.ACTION), out.get(keys.LOG_PROB)

            entries.set(keys.ACTION, action)
            entries.set(keys.LOG_PROB, log_prob)

        return tensordict
