"""Actor and critic of one policy name, from its specs and the model options.

Both are TensorDict modules, which read observations (and ``action_mask``) and write ``action``,
``action_log_prob`` and ``state_value``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from mappo_unity import keys
from mappo_unity.config.schema import LOG_STD_RANGE, CriticKind, DistributionKind, MemoryKind, ModelConfig
from mappo_unity.learning.networks.critics import CentralCritic, LocalCritic, PooledCritic
from mappo_unity.learning.networks.distributions import ActionDistribution, ActionLayout, state_log_std
from mappo_unity.learning.networks.encoders import Encoder, ObsLayout, RunningNorm
from mappo_unity.learning.networks.goals import condition_on_goals
from mappo_unity.learning.networks.handed import make_handed
from mappo_unity.learning.networks.mirror import MirroredCritic, make_mirror
from mappo_unity.learning.networks.mlp import apply_options, init_head, make_mlp
from mappo_unity.learning.networks.poca import PocaCritic
from mappo_unity.learning.networks.recurrent import RecurrentActor, RecurrentCritic, output_size
from mappo_unity.learning.networks.traces import TracingActor

RememberingActor: TypeAlias = RecurrentActor | TracingActor
"""An `Actor` with a memory: it has that actor, and the width of its state, ``state_size``."""


class Actor(nn.Module):
    """Observation entries of an agent to the parameters ``[..., P]`` of an `ActionDistribution`."""

    def __init__(self, obs: ObsLayout, layout: ActionLayout, cfg: ModelConfig) -> None:
        super().__init__()
        self.mirror = make_mirror(cfg.mirror, obs, layout)
        self.encoder = Encoder(obs, cfg.normalize_obs, cfg.image_encoder, cfg.hidden[0])

        outputs = layout.num_means + layout.num_logits
        # the small last gain makes first actions almost independent of what is observed
        self.net = make_mlp(self.encoder.size, list(cfg.hidden), outputs, cfg.activation, last_gain=0.01)
        condition_on_goals(self, cfg)
        make_handed(self, "net.0", cfg.mirror)

        self.layout, self.init_log_std = layout, float(cfg.init_log_std)
        apply_options(self, cfg, layout.num_means)
        if not layout.squashed:
            self.log_std = nn.Parameter(torch.full((layout.continuous,), self.init_log_std))

    def forward(self, *obs: Tensor) -> Tensor:
        """Return distribution parameters."""
        if self.mirror is None:
            return self.complete(self.net(self.encoder(*obs)))
        return self.complete(self.mirror.mean(self.net(self.encoder(*self.mirror.both(*obs)))))

    def complete(self, out: Tensor) -> Tensor:
        """Put the standard deviations, which do not depend on observations, among the network's outputs."""
        size = self.layout.continuous
        if not size:
            return out

        # means, logarithms of deviations, logits: the order that `ActionDistribution` reads
        if self.layout.squashed:
            log_std = state_log_std(out[..., size : 2 * size], self.init_log_std)
            return torch.cat([out[..., :size], log_std, out[..., 2 * size :]], -1)

        log_std = self.mirrored_log_std(self._bounded_log_std()).expand(*out.shape[:-1], size)
        if not self.layout.branches:
            return torch.cat([out, log_std], -1)

        return torch.cat([out[..., :size], log_std, out[..., size:]], -1)

    def mirrored_log_std(self, log_std: Tensor) -> Tensor:
        """Return the log deviations ``[C]`` that actions have: with a mirror, the same on both sides."""
        return log_std if self.mirror is None else self.mirror.mean_deviation(log_std)

    @torch.no_grad()
    def project(self) -> None:
        """Take the deviations back into their range, after a step of the optimizer."""
        if not self.layout.squashed:
            self.log_std.clamp_(*LOG_STD_RANGE)

    def _bounded_log_std(self) -> Tensor:
        bounded = self.log_std.clamp(*LOG_STD_RANGE).detach()
        # `clamp` itself has no gradient outside its range: a deviation there could never come back
        return bounded + (self.log_std - self.log_std.detach())


def bounded_actors(net: nn.Module) -> list[Actor]:
    """Return the networks of a policy that are to `project` after each step of an optimizer."""
    return [module for module in net.modules() if isinstance(module, Actor)]


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


class Draw(NamedTuple):
    """What `UnityActor.draw` returns."""

    action: Tensor  # [..., C + K]
    log_prob: Tensor  # [...]
    log_probs: Tensor | None  # [..., n], of the components, where the actor keeps them
    memory: Tensor | None  # [..., M], the states after these decisions, where the actor has a memory


class UnityActor(ProbabilisticActor):
    """The policy of one policy name as a TorchRL actor, which can also be asked for draws alone.

    Args:
        net: observation entries to the parameters ``[..., P]`` of an `ActionDistribution`.
        obs_keys: the entries that it reads, in its order.
        layout: the sizes of an action.

    Attributes: `memory_size`, M, 0 without a memory; `is_recurrent`, whether that is learnt on sequences;
    `keeps_components`, whether draws hold the log-probabilities of an action's components, too;
    `moving_norms`, the normalisers whose statistics move while a batch is collected.
    """

    def __init__(self, net: nn.Module, obs_keys: Sequence[str], layout: ActionLayout) -> None:
        in_keys = {"params": "params"} | ({"mask": keys.MASK} if layout.branches else {})
        memory_size = net.state_size if isinstance(net, RememberingActor) else 0
        state = ([keys.MEMORY], [keys.MEMORY_AFTER]) if memory_size else ([], [])
        super().__init__(
            TensorDictModule(net, in_keys=[*obs_keys, *state[0]], out_keys=["params", *state[1]]),
            in_keys=in_keys,
            out_keys=[keys.ACTION],
            distribution_class=ActionDistribution,
            distribution_kwargs={"layout": layout},
            return_log_prob=True,
            log_prob_key=keys.LOG_PROB,
            default_interaction_type=InteractionType.RANDOM,
        )
        self.obs_keys, self.layout = list(obs_keys), layout
        self.memory_size, self.is_recurrent = memory_size, isinstance(net, RecurrentActor)
        self.keeps_components = False
        self.moving_norms: list[RunningNorm] = []

    @property
    def has_memory(self) -> bool:
        """Whether actions depend on earlier observations."""
        return self.memory_size > 0

    def draw(self, entries: TensorDictBase, deterministic: bool = False) -> Draw:
        """Return actions and their log-probabilities, without gradients.

        The same numbers as `forward` writes; collecting asks here, because on small networks the wrappers
        between `forward` and the network cost more than the network.
        """
        with torch.no_grad():
            params, after = self.params(entries)
            dist = self.distribution(params, entries)
            action = dist.mode if deterministic else dist.sample()
            parts = dist.component_log_probs(action) if self.keeps_components else None
            return Draw(action, dist.log_prob(action), parts, after)

    def params(self, entries: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        """Return the parameters of actions' distributions and, with a memory, the states after these."""
        inputs = [entries.get(key) for key in self.obs_keys]
        with torch.no_grad():
            if not self.has_memory:
                return self.module[0].module(*inputs), None
            params, after = self.module[0].module(*inputs, entries.get(keys.MEMORY))
            return params, after

    def distribution(self, params: Tensor, entries: TensorDictBase) -> ActionDistribution:
        """Return the distributions of actions with these parameters, masked as the entries say."""
        mask = entries.get(keys.MASK) if self.layout.branches else None
        return ActionDistribution(params, self.layout, mask)


def make_actor(obs: ObsLayout, layout: ActionLayout, team_size: int, cfg: ModelConfig) -> UnityActor:
    """Build the policy as a TorchRL actor over the entries of one policy name."""
    squashed = cfg.action_distribution is DistributionKind.tanh_normal and layout.continuous > 0
    layout = replace(layout, squashed=squashed)

    if cfg.share_parameters or team_size == 1:
        net: nn.Module = Actor(with_traces(obs, *cfg.traces_of_actor(obs.vector)), layout, cfg)
        if cfg.is_recurrent:
            net = RecurrentActor(net, cfg)
            init_head(net.head, cfg, layout.num_means)
        elif cfg.memory is MemoryKind.traces:
            net = TracingActor(net)
    else:
        net = PerMember([Actor(obs, layout, cfg) for _ in range(team_size)], obs.team_dims)
    return UnityActor(net, obs.keys, layout)


def make_critic(
    obs: ObsLayout, team_size: int, cfg: ModelConfig, layout: ActionLayout, streams: int = 1
) -> TensorDictModule:
    """Build the critic over the entries of one policy name; a team of one has a local one.

    Args:
        obs: the observation entries of an agent.
        team_size: slots of a team.
        cfg: the networks' options.
        layout: the sizes of an action, which MA-POCA's baseline reads.
        streams: reward streams V, which have a value each.
    """
    obs = with_traces(obs, *cfg.traces_of_critic(obs.vector))
    local = team_size == 1 or cfg.critic is CriticKind.local
    in_keys = list(obs.keys) if local else [*obs.keys, keys.PRESENT, keys.DEPARTED]

    if cfg.share_parameters or team_size == 1:
        net = _critic(obs, team_size, cfg, layout, streams)
        if cfg.is_recurrent:
            net = RecurrentCritic(net, cfg, sees_team=not local)
            init_head(net.value_heads[0], cfg)
    else:
        nets = [_critic(obs, team_size, cfg, layout, streams) for _ in range(team_size)]
        net = PerMember(nets, obs.team_dims if local else None)

    return TensorDictModule(net, in_keys=in_keys, out_keys=[keys.VALUE])


def _critic(
    obs: ObsLayout, team_size: int, cfg: ModelConfig, layout: ActionLayout, streams: int
) -> nn.Module:
    if team_size == 1 or cfg.critic is CriticKind.local:
        net: nn.Module = LocalCritic(obs, cfg, streams)
    elif cfg.critic is CriticKind.central:
        net = CentralCritic(obs, team_size, cfg, streams)
    elif cfg.critic is not CriticKind.poca:
        net = PooledCritic(obs, team_size, cfg, streams)
    else:
        head_size = output_size(cfg.memory, cfg.memory_size) if cfg.is_recurrent else None
        net = PocaCritic(obs, layout, team_size, cfg, head_size, streams)

    mirror = make_mirror(cfg.mirror, obs, layout)
    net = apply_options(net, cfg)
    return net if mirror is None else MirroredCritic(net, mirror)


def with_traces(obs: ObsLayout, decays: Sequence[float], columns: Sequence[int]) -> ObsLayout:
    """Return the entries of a network that reads traces of some columns; without columns it reads none."""
    return replace(obs, traces=tuple(decays), traced=tuple(columns))


def value_layers(critic: TensorDictModule) -> list[nn.Linear]:
    """Return the layers of a critic whose output is the value."""
    net = critic.module
    if isinstance(net, RecurrentCritic):
        return net.value_heads
    return [member.head for member in getattr(net, "nets", [net])]
