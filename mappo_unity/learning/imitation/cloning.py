"""Behavioral cloning: make what an expert did more likely.

As in ML-Agents (trainers/torch_entities/components/bc/module.py) cloning has an optimizer of its own and
follows each update of PPO. The loss is the negative log-likelihood of the expert's actions, for continuous
columns too, so that a policy takes over how much the expert's actions vary.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from mappo_unity.config.schema import BCConfig, PPOConfig
from mappo_unity.learning.advantage import share_left
from mappo_unity.learning.imitation.expert import Expert
from mappo_unity.learning.networks.actor_critic import UnityActor, bounded_actors
from mappo_unity.learning.networks.distributions import ActionDistribution
from mappo_unity.learning.optimizer import kind_of, load_optimizer


class Cloning:
    """Clone an expert, with a strength that may fall to 0.

    Args:
        actor: learns.
        expert: what it learns from.
        cfg: strength, and whether nothing else teaches the actor.
        ppo: epochs, minibatches, the optimizer's kind and weight decay and, if it is recurrent, the length of
            sequences.
        max_steps: agent decisions of the run.
    """

    def __init__(
        self, actor: UnityActor, expert: Expert, cfg: BCConfig, ppo: PPOConfig, max_steps: int = 0
    ) -> None:
        self._actor, self._expert, self.cfg, self._ppo = actor, expert, cfg, ppo
        self._max_steps = max_steps
        # epsilon stays torch's, as in ML-Agents
        self.optimizer = kind_of(ppo)(actor.parameters(), lr=ppo.lr, weight_decay=ppo.weight_decay)
        self._bounded = bounded_actors(actor)
        self._pieces = _cut(expert.first, ppo.sequence_length if actor.is_recurrent else 1)

    def learn(self, decisions: int, lr: float, progress: float) -> dict[str, float]:
        """Clone, as often as PPO learns from a batch; return metrics.

        Args:
            decisions: of the batch: an epoch takes at most as many of the expert's, or where nothing else
                teaches the actor just as many.
            lr: PPO's learning rate now.
            progress: share of the run that is over, 0 to 1.
        """
        left = share_left(self.cfg.steps, self._max_steps, progress)
        wanted = decisions if self.cfg.only else min(decisions, len(self._expert))
        # a side that pauses, or a behavior that was not asked, has no decision in a batch
        if left == 0.0 or not wanted:
            return {"bc_strength": self.cfg.strength * left}

        self.optimizer.param_groups[0]["lr"] = lr * self.cfg.strength * left
        losses = []
        states = None
        for epoch in range(self._ppo.epochs):
            # traces do not depend on the weights that learn
            if self._actor.is_recurrent or (self._actor.has_memory and not epoch):
                states = self._states()
            for pieces in self._draw(wanted):
                loss = self._loss(pieces, states)
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
                for net in self._bounded:
                    net.project()
                losses.append(loss.detach())
        return {"bc_strength": self.cfg.strength * left, "bc_loss": float(torch.stack(losses).mean())}

    def _draw(self, wanted: int) -> Iterator[Tensor]:
        """Yield minibatches of pieces in random order, together so many decisions."""
        sizes = self._pieces[:, 1]
        rounds = -(-wanted // int(sizes.sum()))
        order = torch.cat([torch.randperm(len(sizes)) for _ in range(rounds)])
        total = sizes[order].cumsum(0)
        order = order[: int((total < wanted).sum()) + 1]
        share = (sizes[order].cumsum(0) - 1) // self._ppo.minibatch_size
        for part in order.split(torch.bincount(share).tolist()):
            if len(part):
                yield part

    def _loss(self, pieces: Tensor, states: Tensor | None) -> Tensor:
        """Return the mean negative log-likelihood of the actions in these pieces."""
        steps, net = self._expert.steps, self._actor.module[0].module
        start, size = self._pieces[pieces].unbind(-1)
        # [B, L], padding repeats the last decision
        place = torch.arange(int(size.max())).unsqueeze(0)
        valid = place < size.unsqueeze(-1)
        index = (start.unsqueeze(-1) + torch.minimum(place, size.unsqueeze(-1) - 1)).to(steps.at.device)

        obs = [entry[steps.at[index]] for entry in steps.table]
        if states is None:
            params = net(*obs)
        else:
            params = net.unroll(*obs, states[index[:, 0]])

        mask = None if self._expert.mask is None else self._expert.mask[index]
        dist = ActionDistribution(params, self._actor.layout, mask)
        log_prob = dist.log_prob(steps.action[index])
        return -log_prob[valid.to(log_prob.device)].mean()

    @torch.no_grad()
    def _states(self) -> Tensor:
        """Return the memory's state before each decision ``[N, M]``, as the actor remembers now."""
        steps, net = self._expert.steps, self._actor.module[0].module
        episodes = _cut(self._expert.first, len(steps))
        start, size = episodes.unbind(-1)
        device = steps.at.device
        states = torch.zeros(len(steps), self._actor.memory_size, device=device)

        # all episodes side by side, as long as they last
        state = torch.zeros(len(episodes), self._actor.memory_size, device=device)
        for place in range(int(size.max())):
            going = (place < size).nonzero().squeeze(-1)
            index = (start[going] + place).to(device)
            states[index] = state[going.to(device)]
            obs = [entry[steps.at[index]] for entry in steps.table]
            state[going.to(device)] = net(*obs, states[index])[1]
        return states

    def state_dict(self) -> dict[str, Any]:
        """Return what resuming needs."""
        return self.optimizer.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        load_optimizer(self.optimizer, state)


def _cut(first: Tensor, length: int) -> Tensor:
    """Cut episodes into pieces: int64 ``[P, 2]``, where each begins and how many decisions it holds."""
    starts = first.cpu().nonzero().squeeze(-1)
    ends = torch.cat([starts[1:], torch.tensor([len(first)])])
    begins = torch.cat([torch.arange(int(a), int(b), length) for a, b in zip(starts, ends)])
    limits = torch.cat([torch.full((-(-int(b - a) // length),), int(b)) for a, b in zip(starts, ends)])
    return torch.stack([begins, torch.minimum(limits - begins, torch.tensor(length))], -1)
