"""The actors of all policy names as the one policy that a collector plays."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import ExplorationType, exploration_type

from mappo_unity import keys
from mappo_unity.learning.networks.actor_critic import UnityActor
from mappo_unity.learning.networks.encoders import update_norms
from mappo_unity.learning.networks.opponents import Opponents


def _written(actor: TensorDictModuleBase) -> list[str]:
    """Return the entries that `JointPolicy` writes for an actor."""
    written = [keys.ACTION, keys.LOG_PROB]
    if isinstance(actor, UnityActor):
        written += [keys.LOG_PROBS] * actor.keeps_components + [keys.MEMORY] * actor.has_memory
    return written


class JointPolicy(TensorDictModuleBase):
    """The actors of all policy names as one policy for the collector; it keeps the agents' memories.

    Args:
        actors: by policy name.
        opponents: who plays some of the teams instead; None: nobody does.
    """

    def __init__(self, actors: dict[str, TensorDictModuleBase], opponents: Opponents | None = None) -> None:
        super().__init__()
        self.actors = nn.ModuleDict({str(i): actor for i, actor in enumerate(actors.values())})

        self.names = list(actors)
        self.inputs = [[str(k) for k in actor.in_keys if k != keys.MEMORY] for actor in actors.values()]
        self.in_keys = [(name, k) for name, inputs in zip(self.names, self.inputs) for k in inputs]
        # all that is written: on a GPU the collector takes no other entries over from the policy's copy
        self.out_keys = [(name, k) for name, actor in actors.items() for k in _written(actor)]
        if opponents is not None:
            self.out_keys += [(name, key) for name in actors for key in (keys.PLAYER, keys.ACTING)]
        self.opponents = opponents
        self.memories: dict[str, Tensor] = {}  # states [..., A, M] before the next decisions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write every name's action and log-probability beside its observation."""
        draws = exploration_type() in (None, ExplorationType.RANDOM) and not torch.is_grad_enabled()

        for name, inputs, actor in zip(self.names, self.inputs, self.actors.values()):
            entries = tensordict.get(name)
            if self.opponents is not None:
                asked = self.opponents.take_places(name, entries)
            if isinstance(actor, UnityActor) and draws:
                update_norms(actor.moving_norms, entries)
            if isinstance(actor, UnityActor) and actor.has_memory:
                entries.set(keys.MEMORY, self._memory(name, actor.memory_size, entries))

            if isinstance(actor, UnityActor) and (draws or actor.has_memory):
                drawn = actor.draw(entries, deterministic=not draws)
                action, log_prob = drawn.action, drawn.log_prob
                if drawn.log_probs is not None:
                    entries.set(keys.LOG_PROBS, drawn.log_probs)
                if drawn.memory is not None:
                    # frozen while an agent is not asked
                    acting, before = entries.get(keys.ACTING), entries.get(keys.MEMORY)
                    self.memories[name] = torch.where(acting, drawn.memory, before)
            else:
                out = actor(entries.select(*inputs, strict=False))
                action, log_prob = out.get(keys.ACTION), out.get(keys.LOG_PROB)

            entries.set(keys.ACTION, action)
            entries.set(keys.LOG_PROB, log_prob)
            if self.opponents is not None:
                self.opponents.act(name, entries, asked)

        return tensordict

    def _memory(self, name: str, size: int, entries: TensorDictBase) -> Tensor:
        """Return the states under which agents act now: zero at an agent's first decision."""
        first = entries.get(keys.FIRST)
        memory = self.memories.get(name)
        if memory is None or memory.shape[:-1] != first.shape[:-1]:
            return torch.zeros(*first.shape[:-1], size, device=first.device)
        return torch.where(first, 0.0, memory)
