"""Specs of what a `UnityEnv` gives and takes, as TorchRL wants them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torchrl.data import Binary, Bounded, Composite, MultiCategorical, Unbounded

from mappo_unity import keys
from mappo_unity.envs.rounds import BehaviorState


def make_specs(
    behaviors: Mapping[str, BehaviorState], entry_of: Mapping[str, str], action_limit: float
) -> tuple[Composite, Composite, Composite, Composite]:
    """Return the specs of observations, actions, rewards and ends, an entry ``[G, A, ...]`` a behavior."""
    observation, action, reward, done = {}, {}, {}, {}

    for behavior_name, behavior in behaviors.items():
        name = entry_of[behavior_name]
        shape = torch.Size((behavior.slots.num_teams, behavior.slots.team_size))

        entries: dict[str, Any] = {
            # arrays hold slots as [N, ...], entries as [G, A, ...]
            keys.SENSOR.format(i): Unbounded((*shape, *o.shape[1:]), dtype=torch.from_numpy(o).dtype)
            for i, o in enumerate(behavior.obs)
        }
        for key in (keys.ACTING, keys.PRESENT, keys.DEPARTED, keys.FIRST):
            entries[key] = Binary(1, (*shape, 1), dtype=torch.bool)

        # without discrete actions there is nothing to mask
        if behavior.mask.shape[1]:
            entries[keys.MASK] = Binary(
                behavior.mask.shape[1], (*shape, behavior.mask.shape[1]), dtype=torch.bool
            )

        observation[name] = Composite(entries, shape=shape)
        action[name] = Composite({keys.ACTION: _action_spec(behavior, shape, action_limit)}, shape=shape)

        rewards = {key: Unbounded((*shape, 1)) for key in (keys.REWARD, keys.GROUP_REWARD)}
        reward[name] = Composite(rewards, shape=shape)
        ends = {
            key: Binary(1, (*shape, 1), dtype=torch.bool)
            for key in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)
        }
        done[name] = Composite(ends, shape=shape)

    return Composite(observation), Composite(action), Composite(reward), Composite(done)


def _action_spec(behavior: BehaviorState, shape: torch.Size, limit: float) -> Any:
    spec = behavior.spec.action_spec
    size, branches = spec.continuous_size, spec.discrete_branches
    if not branches:
        return Bounded(-limit, limit, (*shape, size), dtype=torch.float32)
    if not size:
        return MultiCategorical(branches, (*shape, len(branches)), dtype=torch.int64)

    # both kinds in one tensor: branch indices are floats, below n so that cutting a random one is valid
    low = torch.tensor([-limit] * size + [0.0] * len(branches)).expand(*shape, -1)
    high = torch.tensor([limit] * size + [n - 1e-3 for n in branches]).expand(*shape, -1)

    return Bounded(low.clone(), high.clone(), dtype=torch.float32)
