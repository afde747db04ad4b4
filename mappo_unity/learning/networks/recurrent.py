"""Networks with a memory: one LSTM or GRU layer between the hidden layers and the heads.

The state belongs to an agent. It is zero at the agent's first decision, stays as it is while the agent is not
asked, and is dropped at its end. As in ML-Agents an LSTM's state is ``[h, c]`` side by side, so that
`model.memory_size` counts both (trainers/torch_entities/layers.py, LSTM).
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from mappo_unity.config.schema import MemoryKind, ModelConfig
from mappo_unity.learning.networks.mlp import linear
from mappo_unity.learning.networks.poca import PocaCritic

VALUE_STATE, BASELINE_STATE = "value_state", "baseline_state"
"""Entries of the critic's states, float32 [..., M]: a POCA critic's baseline remembers for itself."""


def output_size(kind: MemoryKind, memory_size: int) -> int:
    """Return the width of what a memory gives: an LSTM's state is half output, half cell."""
    return memory_size // 2 if kind is MemoryKind.lstm else memory_size


class Memory(nn.Module):
    """One recurrent layer that is asked for a single decision, or for sequences of them.

    Args:
        inputs: width of the features.
        kind: lstm or gru.
        memory_size: width M of the state; an LSTM's output is half as wide, a GRU's as wide.
    """

    def __init__(self, inputs: int, kind: MemoryKind, memory_size: int) -> None:
        super().__init__()
        self.is_lstm = kind is MemoryKind.lstm
        self.state_size = memory_size
        self.size = output_size(kind, memory_size)
        layer = nn.LSTM if self.is_lstm else nn.GRU
        self.layer = layer(inputs, self.size, batch_first=True)
        self._initialize()

    def forward(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Take one decision: return outputs ``[..., H]`` and the states ``[..., M]`` after it.

        Args:
            features: ``[..., F]``.
            state: ``[..., M]``, the states before it.
        """
        shape = features.shape[:-1]
        flat = features.reshape(-1, 1, features.shape[-1])
        out, after = self.layer(flat, self._unpack(state.reshape(-1, self.state_size)))
        return out.view(*shape, self.size), self._pack(after).view(*shape, self.state_size)

    def unroll(self, features: Tensor, state: Tensor) -> Tensor:
        """Return outputs ``[B, L, H]`` of sequences of features ``[B, L, F]`` from states ``[B, M]``."""
        return self.layer(features, self._unpack(state))[0]

    def _unpack(self, state: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        if not self.is_lstm:
            return state.unsqueeze(0).contiguous()
        hidden, cell = state.unsqueeze(0).split(self.size, -1)
        return hidden.contiguous(), cell.contiguous()

    def _pack(self, state: Tensor | tuple[Tensor, Tensor]) -> Tensor:
        return torch.cat(state, -1).squeeze(0) if isinstance(state, tuple) else state.squeeze(0)

    def _initialize(self) -> None:
        """Xavier for each gate, and at first little is forgotten.

        As ML-Agents (trainers/torch_entities/layers.py): the forget gate's bias is 1 in both bias vectors.
        """
        for name, parameter in self.layer.named_parameters():
            if "bias" in name:
                # the second gate of both kinds is the one that keeps: an LSTM's forget, a GRU's update gate
                nn.init.zeros_(parameter)
                parameter.data[self.size : 2 * self.size].fill_(1.0)
                continue
            for gate in parameter.data.split(self.size):
                nn.init.xavier_uniform_(gate)


class RecurrentActor(nn.Module):
    """An actor whose hidden layers are followed by a memory.

    Args:
        actor: `learning.networks.actor_critic.Actor`; its last layer is replaced.
        cfg: kind and size of the memory.
    """

    def __init__(self, actor: Any, cfg: ModelConfig) -> None:
        super().__init__()
        last = actor.net[-1]
        actor.net = actor.net[:-1]
        self.actor: Any = actor
        self.layout = actor.layout
        self.memory = Memory(last.in_features, cfg.memory, cfg.memory_size)
        self.head = linear(self.memory.size, last.out_features, 0.01)

    @property
    def state_size(self) -> int:
        """The width M of its state."""
        return self.memory.state_size

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return distribution parameters ``[..., P]`` and the states ``[..., M]`` after this decision.

        Args:
            *inputs: the observation entries ``[..., *]``, then the states before it.
        """
        *obs, state = inputs
        out, after = self.memory(self.actor.net(self.actor.encoder(*obs)), state)
        return self.actor.complete(self.head(out)), after

    def unroll(self, *inputs: Tensor) -> Tensor:
        """Return parameters ``[B, L, P]`` of observations ``[B, L, *]`` from states ``[B, M]``."""
        *obs, state = inputs
        out = self.memory.unroll(self.actor.net(self.actor.encoder(*obs)), state)
        return self.actor.complete(self.head(out))


class RecurrentCritic(nn.Module):
    """A critic with a memory for each member.

    Args:
        critic: any of `learning.networks.critics`, or a `PocaCritic` built for outputs of the memory's width.
        cfg: kind and size of the memory.
        sees_team: whether its inputs are those of the whole team.
    """

    def __init__(self, critic: Any, cfg: ModelConfig, sees_team: bool) -> None:
        super().__init__()
        self.sees_team, self.has_baseline = sees_team, isinstance(critic, PocaCritic)
        if isinstance(critic, PocaCritic):
            self.memory = Memory(critic.size, cfg.memory, cfg.memory_size)
        else:
            last = critic.net[-1]
            critic.net = critic.net[:-1]
            self.memory = Memory(last.in_features, cfg.memory, cfg.memory_size)
            self.head = linear(self.memory.size, last.out_features, 0.01)
        self.critic: Any = critic

    @property
    def value_heads(self) -> list[nn.Linear]:
        """The layers whose output is the value."""
        return [self.critic.head if isinstance(self.critic, PocaCritic) else self.head]

    @property
    def state_names(self) -> list[str]:
        """Entries of the states that it needs."""
        return [VALUE_STATE, BASELINE_STATE] if self.has_baseline else [VALUE_STATE]

    def features(self, inputs: list[Tensor], action: Tensor | None = None) -> dict[str, Tensor]:
        """Return what the memory of each state takes (and beside it the count, for POCA): ``[..., A, F]``.

        Without the mates' actions there is no baseline.
        """
        if not isinstance(self.critic, PocaCritic):
            return {VALUE_STATE: self.critic(*inputs)}
        if action is None:
            return {VALUE_STATE: self.critic.features(*inputs)}
        value, baseline = self.critic.both_features(*inputs, action)
        return {VALUE_STATE: value, BASELINE_STATE: baseline}

    def step(self, features: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Return what `values` takes of one decision ``[..., H]``, and the states ``[..., M]`` after it."""
        out, after = self.memory(features[..., : self.memory.layer.input_size], state)
        return self._with_count(out, features), after

    def values(self, out: Tensor) -> Tensor:
        """Return values ``[..., V]``."""
        return self.value_heads[0](out)

    def unroll(
        self, inputs: list[Tensor], action: Tensor | None, member: Tensor, states: TensorDictBase
    ) -> tuple[Tensor, Tensor | None]:
        """Return values ``[B, L, V]`` of sequences, and baselines where there are any.

        Args:
            inputs: the critic's entries ``[B, L, A, *]`` (``[B, L, *]`` if it sees the agent alone).
            action: ``[B, L, A, C + K]``, for baselines.
            member: int64 ``[B]``, the slot in its team of each sequence's agent.
            states: holds the states ``[B, M]`` at the sequences' beginnings, see `state_names`.
        """
        out = []
        for name, features in self.features(inputs, action).items():
            if self.sees_team:
                features = features[torch.arange(len(member), device=member.device), :, member]
            hidden = self.memory.unroll(features[..., : self.memory.layer.input_size], states.get(name))
            out.append(self.values(self._with_count(hidden, features)))
        return out[0], out[1] if self.has_baseline else None

    def _with_count(self, out: Tensor, features: Tensor) -> Tensor:
        return torch.cat([out, features[..., -1:]], -1) if self.has_baseline else out
